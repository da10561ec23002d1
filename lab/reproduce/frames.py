"""Frames composed of sharp photographs.

The photographs of the held-out photo serve in no other. Where there are few of them, those that the lens is
learned from serve again, mirrored and in another place of the frame.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image

from lab.cases import list_photos, photo_half
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import Planes
from lensmodel.simulate import load_scene

MARGIN: Final = 28
"""Pixels that a scene reaches beyond the frame on every side: half a kernel."""

_GRIDS: Final = ((1, 1), (1, 2), (2, 2))  # rows and columns of photographs in a frame


@dataclass(frozen=True, slots=True)
class Layout:
    """How frames are made of photographs."""

    rows: int  # grid of photographs in one frame
    cols: int
    tile: tuple[int, int]  # (height, width) that is cut from the middle of each

    @property
    def frame(self) -> tuple[int, int]:
        """Largest (height, width) of a frame that still has its margin; even."""
        height, width = self.rows * self.tile[0] - 2 * MARGIN, self.cols * self.tile[1] - 2 * MARGIN
        return height // 2 * 2, width // 2 * 2


def scene_files(folder: Path | None) -> tuple[Path, ...]:
    """Photographs of the test half of a folder; all five of the library when there is no folder."""
    found = list_photos(folder)
    if folder is None:
        return found
    tested = tuple(path for path in found if photo_half(path.stem) == "test")
    if not tested:
        raise InvalidInputError(f"{folder} holds no photograph of the test half; add some")
    return tested


def layout_for(files: Sequence[Path], wanted: tuple[int, int] | None = None) -> Layout:
    """Decide how to make frames that cover `wanted` rows and columns; the largest where it is None."""
    grids = [(rows, cols) for rows, cols in _GRIDS if 2 * rows * cols <= len(files)]
    if not grids:
        raise InvalidInputError(f"two photographs are needed at least, there are {len(files)}")
    layouts = [_layout(files, grid) for grid in grids]
    for layout in layouts if wanted else layouts[-1:]:
        rows, cols = wanted or (0, 0)
        if layout.rows * layout.tile[0] >= rows and layout.cols * layout.tile[1] >= cols:
            return layout
    raise InvalidInputError(f"the photographs do not cover frames of {wanted}: give larger ones, or more")


def _layout(files: Sequence[Path], grid: tuple[int, int]) -> Layout:
    sizes = np.array([_turned_size(path, upright=grid[1] > grid[0]) for path in files])
    height, width = (int(n) // 2 * 2 for n in sizes.min(axis=0))
    return Layout(*grid, (height, width))


def frame_scene(files: Sequence[Path], layout: Layout, number: int | None) -> Planes:
    """Compose a frame from photographs in the given order."""
    per = layout.rows * layout.cols
    if number is None:
        parts = [_part(path, layout, 0) for path in files[:per]]
    else:
        others = files[per:]
        indices = range(number * per, (number + 1) * per)
        parts = [_part(others[i % len(others)], layout, i // len(others)) for i in indices]
    rows = [parts[i * layout.cols : (i + 1) * layout.cols] for i in range(layout.rows)]
    return np.ascontiguousarray(np.concatenate([np.concatenate(row, axis=2) for row in rows], axis=1))


def centred_cut(scene: Planes, height: int, width: int) -> Planes:
    """Cut the middle so that the scene exceeds `height` x `width` by twice the margin, or by less.

    What remains exceeds the frame by an even number, as the simulated camera wants it.
    """
    cut = []
    for have, want in zip(scene.shape[1:], (height, width), strict=True):
        if have < want:
            raise InvalidInputError(f"a scene of {scene.shape[1:]} does not cover {height} x {width}")
        spare = min((have - want) // 2, MARGIN)
        start = (have - want - 2 * spare) // 2
        cut.append(slice(start, start + want + 2 * spare))
    return np.ascontiguousarray(scene[:, cut[0], cut[1]])


def content_of(files: Sequence[Path]) -> str:
    """Hash of the photographs' bytes, in order."""
    total = hashlib.sha256()
    for path in files:
        total.update(hashlib.sha256(path.read_bytes()).digest())
    return total.hexdigest()[:16]


def _part(path: Path, layout: Layout, use: int) -> Planes:
    """The middle of a photograph; mirrored in another way each time that it is used."""
    scene = load_scene(path)
    if (scene.shape[1] > scene.shape[2]) != (layout.tile[0] > layout.tile[1]):
        scene = np.rot90(scene, axes=(1, 2))
    height, width = layout.tile
    top, left = (scene.shape[1] - height) // 2, (scene.shape[2] - width) // 2
    return scene[:, top : top + height, left : left + width][
        :, :: -1 if use & 2 else 1, :: -1 if use & 1 else 1
    ]


def _turned_size(path: Path, *, upright: bool) -> tuple[int, int]:
    with Image.open(path) as image:
        short, long = sorted(image.size)
    return (long, short) if upright else (short, long)
