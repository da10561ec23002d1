"""What a simulated camera looks at, in white-balanced linear light: photographs, and slanted-edge charts."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources
from itertools import product
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image, UnidentifiedImageError

from lensmodel.core.errors import InvalidInputError, NotAnImageError
from lensmodel.core.types import Direction, FieldPosition, Frame, Planes
from lensmodel.photo.colour import srgb_to_linear
from lensmodel.quality import Box, edge_area

DEMO_SCENES: Final = ("city", "colosseum", "lake", "spices", "tea-gardens")
"""Names of the photographs that come with the library, see lensmodel/demo_data/README.md."""

# Degrees: about the 5 of ISO 12233, both ways
_SLANTS_DEG: Final = (5.0, -5.0, 7.0, -7.0, 4.0, -4.0, 9.0, -9.0)
_MIN_TILE: Final = 72  # pixels: the crop of an edge and the blur around it


def load_scene(path: str | Path) -> Planes:
    """Load an sRGB photograph (PNG, JPEG, TIFF of 8 bits) as linear light."""
    try:
        with Image.open(path) as image:
            coded = np.asarray(image.convert("RGB"), dtype=np.uint8)
    except UnidentifiedImageError as error:
        raise NotAnImageError(f"{Path(path).name} is no image that can serve as a scene") from error
    table = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
    return np.ascontiguousarray(table[coded].transpose(2, 0, 1))


def demo_data_path(name: str) -> Path:
    """Path of a file of `lensmodel/demo_data`; see its README for origin and licences."""
    path = Path(str(resources.files("lensmodel") / "demo_data" / name))
    if not path.is_file():
        raise InvalidInputError(
            f"no demo file {name!r}; known scenes: {', '.join(DEMO_SCENES)}. An installed package has "
            "none: get the source tree and run `make demo` there"
        )
    return path


def demo_scene(name: str) -> Planes:
    """Photograph of `DEMO_SCENES` as linear light, `(3, H, W)`."""
    return load_scene(demo_data_path(f"{name}.jpg"))


@dataclass(frozen=True, slots=True)
class ChartEdge:
    """One slanted edge of a chart."""

    box: Box  # in the frame, which holds the edge and flat ground on both sides, nothing else
    normal: float  # angle of the edge's normal from dark to bright, radians, counter-clockwise from the right
    position: FieldPosition  # of the middle of the box
    direction: Direction  # contrast along u (tangential) or v (sagittal)


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """A chart and where its edges are."""

    scene: Planes  # (3, H + 2 margin, W + 2 margin), linear light
    edges: tuple[ChartEdge, ...]  # in coordinates of the frame, margin not counted


def edge_chart(frame: Frame, *, margin: int = 40, guard: int = 27) -> Chart:
    """Chart with edges in the centre, half way out and in all four corners, of both directions."""
    tile = min(frame.height // 6, frame.width // 8)
    box = tile - 2 * guard
    if tile < _MIN_TILE or box < _MIN_TILE // 3:
        raise InvalidInputError(
            f"the chart needs a frame of at least {6 * _MIN_TILE} x {8 * _MIN_TILE} pixels and tiles larger "
            f"than twice the guard, got {frame.height} x {frame.width} and a guard of {guard}"
        )
    dark, bright = 0.15, 0.75
    shape = (frame.height + 2 * margin, frame.width + 2 * margin)
    plane = np.full(shape, (dark + bright) / 2.0, dtype=np.float32)
    middle, edges = (tile - 1) / 2.0, []
    t = np.arange(tile) - middle
    for up, right, direction in _places(frame, tile):
        row, col = round(frame.center[0] - up - middle), round(frame.center[1] + right - middle)
        position = frame.position(row + middle, col + middle)
        normal = _slanted(position.phi + (math.pi / 2.0 if direction == "sagittal" else 0.0))
        top, left = row + margin, col + margin
        share = edge_area(t[:, None], t[None, :], normal)
        plane[top : top + tile, left : left + tile] = dark + (bright - dark) * share
        edges.append(ChartEdge((row + guard, col + guard, box, box), normal, position, direction))
    return Chart(np.ascontiguousarray(np.broadcast_to(plane, (3, *plane.shape))), tuple(edges))


def _places(frame: Frame, tile: int) -> Iterator[tuple[float, float, Direction]]:
    """Yield the middles of the tiles as (up, right) from the centre, with their direction."""
    yield 0.0, -0.55 * tile, "tangential"
    yield 0.0, 0.55 * tile, "sagittal"
    top, side = frame.height / 2.0, frame.width / 2.0
    for up, right in product((1.0, -1.0), (1.0, -1.0)):
        yield up * (top - 0.5 * tile), right * (side - 0.5 * tile), "tangential"
        yield up * (top - 1.5 * tile), right * (side - 0.5 * tile), "sagittal"
        yield up * (top - 1.5 * tile), right * side / 2.0, "tangential"
        yield up * (top - 2.5 * tile), right * side / 2.0, "sagittal"


def _slanted(angle: float) -> float:
    """Turn an angle so that the edge meets many phases of the pixels: of slope p / q it meets only q."""
    for slant in _SLANTS_DEG:
        turned = angle + math.radians(slant)
        slope = abs(math.tan(turned))
        slope = min(slope, 1.0 / slope)
        if all(abs(slope - p / q) > 0.03 for q in range(1, 4) for p in range(q + 1)):
            return turned
    return angle + math.radians(_SLANTS_DEG[0])
