"""Scenes and paths that hurt: what is in front of the lens, and what the photo goes through."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage

from lab.scenes import dead_leaves, out_of_focus
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import Planes

Container = Literal["dng", "tiff", "jpeg"]
Scenery = Callable[[Planes, np.random.Generator], Planes]

BASE: Final = "base"
_DISC_PX = 4.0  # radius of a point out of focus (chosen)
_TRAIL_PX = 11  # way of what moves while the shutter is open (chosen)
_NIGHT = 0.05  # share of the light by night (chosen)
_LAMPS = 60  # of a picture (chosen)


@dataclass(frozen=True, slots=True)
class Condition:
    """What is different from a photo of a photograph, in raw, at base ISO.

    Parameters
    ----------
    title : str
        For people.
    full_well_electrons, read_noise : float
        Of the sensor at the photo's ISO, electrons.
    container : {"dng", "tiff", "jpeg"}
        The file that is uploaded; TIFF (16 bits) and JPEG (quality 92) are the developed DNG in sRGB.
    scenery : callable or None
        Changes what is photographed, `(scene, rng) -> scene`.
    with_chart : bool
        Whether the chart is photographed and corrected too.
    """

    title: str
    full_well_electrons: float = 50_000.0
    read_noise: float = 50.0
    container: Container = "dng"
    scenery: Scenery | None = None
    with_chart: bool = False

    @property
    def suffix(self) -> str:
        """Of its files."""
        return {"dng": ".dng", "tiff": ".tif", "jpeg": ".jpg"}[self.container]


def condition(name: str) -> Condition:
    """Return a condition by name.

    Raises
    ------
    InvalidInputError
        If there is none of that name.
    """
    if name not in CONDITIONS:
        raise InvalidInputError(f"no condition {name!r}; known: {', '.join(CONDITIONS)}")
    return CONDITIONS[name]


def two_depths(scene: Planes, rng: np.random.Generator) -> Planes:
    """Near objects out of focus: two fifths of the picture, in a few large shapes."""
    return out_of_focus(scene, _DISC_PX, _shapes(scene.shape[1:], rng, 0.4))


def moving(scene: Planes, rng: np.random.Generator) -> Planes:
    """Objects that moved 11 pixels while the shutter was open: two fifths of the picture."""
    mask = _shapes(scene.shape[1:], rng, 0.4)
    angle = float(rng.uniform(0.0, math.pi))
    steps = np.linspace(-0.5, 0.5, _TRAIL_PX) * _TRAIL_PX

    def trail(plane: NDArray[np.float32]) -> NDArray[np.float32]:
        total = np.zeros(plane.shape, dtype=np.float32)
        for step in steps:
            by = (step * math.sin(angle), step * math.cos(angle))
            total += ndimage.shift(plane, by, order=1, mode="nearest", prefilter=False)
        return total / np.float32(len(steps))

    matte = trail(mask.astype(np.float32))
    planes = [(1.0 - matte) * plane + trail(plane * mask) for plane in scene]
    return np.ascontiguousarray(np.stack(planes), dtype=np.float32)


def night(scene: Planes, rng: np.random.Generator) -> Planes:
    """A twentieth of the light, and lamps that clip."""
    dark = scene * np.float32(_NIGHT)
    height, width = scene.shape[1:]
    rows, cols = rng.integers(3, height - 3, _LAMPS), rng.integers(3, width - 3, _LAMPS)
    for row, col in zip(rows, cols, strict=True):
        size = int(rng.integers(1, 3))
        colour = rng.uniform(3.0, 12.0) * np.array([1.0, 0.8, 0.55])
        dark[:, row : row + size, col : col + size] = colour[:, None, None]
    return np.ascontiguousarray(dark, dtype=np.float32)


def sky(scene: Planes, rng: np.random.Generator) -> Planes:
    """Smooth sky over the upper three fifths, down to a ragged horizon."""
    height, width = scene.shape[1:]
    ragged = ndimage.gaussian_filter1d(rng.normal(size=width), 12.0, mode="wrap")
    horizon = height * (0.6 + 0.03 * ragged / max(float(np.abs(ragged).max()), 1e-9))
    rows = np.arange(height)[:, None]
    above = np.clip(horizon[None, :] - rows + 0.5, 0.0, 1.0)
    fall = rows / height
    colours = [0.25 + 0.35 * fall, 0.40 + 0.30 * fall, 0.75 + 0.10 * fall]
    planes = [above * c + (1.0 - above) * plane for c, plane in zip(colours, scene, strict=True)]
    return np.ascontiguousarray(np.stack(planes), dtype=np.float32)


def snow(scene: Planes, rng: np.random.Generator) -> Planes:
    """Bright and flat: a fifth of the contrast, lifted until the brightest parts clip."""
    del rng
    return np.ascontiguousarray(0.82 + 0.22 * scene, dtype=np.float32)


def text(scene: Planes, rng: np.random.Generator) -> Planes:
    """A printed page in several sizes, made of random words."""
    height, width = scene.shape[1:]
    over = 2  # drawn larger and averaged, so that the letters are sampled by area
    page = Image.new("L", (width * over, height * over), 235)
    pen, row = ImageDraw.Draw(page), 8
    while row < page.height:
        size = int(rng.choice([18, 22, 28, 40, 64]))
        font = ImageFont.load_default(size)
        words = (rng.integers(97, 123, rng.integers(2, 10)) for _ in range(400))
        line = " ".join(bytes(word.astype(np.uint8)).decode("ascii") for word in words)
        pen.text((8, row), line[: int(page.width / (0.45 * size))], fill=20, font=font)
        row += int(1.35 * size)
    cells = np.asarray(page, dtype=np.float32).reshape(height, over, width, over).mean(axis=(1, 3)) / 255.0
    return np.ascontiguousarray(np.stack([cells**2.2] * 3), dtype=np.float32)


def foliage(scene: Planes, rng: np.random.Generator) -> Planes:
    """Small leaves over the whole picture, in greens: fine detail without long edges."""
    height, width = scene.shape[1:]
    leaves = dead_leaves(-(-height // 3), -(-width // 3), rng, smallest=1.0, largest=14.0, oversampling=2)
    # nine tiles of it, each turned or mirrored another way: leaves look alike, and take long to draw
    ways = [leaves, leaves[:, ::-1], leaves[:, :, ::-1], leaves[:, ::-1, ::-1]]
    rows = [np.concatenate([ways[(3 * i + j) % 4] for j in range(3)], axis=2) for i in range(3)]
    whole = np.concatenate(rows, axis=1)[:, :height, :width]
    return np.ascontiguousarray(whole * np.array([0.6, 1.0, 0.35], dtype=np.float32)[:, None, None])


def _shapes(shape: tuple[int, ...], rng: np.random.Generator, share: float) -> NDArray[np.bool_]:
    """Mask of a few large shapes that cover a share of the picture."""
    reach = min(shape) / 8.0
    coarse = rng.normal(size=(max(shape[0] // 8, 2), max(shape[1] // 8, 2)))
    smooth = ndimage.gaussian_filter(coarse, reach / 8.0, mode="nearest")
    grown = ndimage.zoom(smooth, (shape[0] / smooth.shape[0], shape[1] / smooth.shape[1]), order=1)
    return np.asarray(grown > np.quantile(grown, 1.0 - share))


CONDITIONS: Final[Mapping[str, Condition]] = {
    BASE: Condition("raw at base ISO (50,000 electrons, read noise 0.001)", with_chart=True),
    "high-iso": Condition("high ISO (2,500 electrons, read noise 0.003)", 2500.0, 7.5, with_chart=True),
    "tiff": Condition("16-bit TIFF in sRGB", container="tiff", with_chart=True),
    "jpeg": Condition("JPEG only, quality 92", container="jpeg", with_chart=True),
    "depth": Condition("depth: near things out of focus", scenery=two_depths),
    "motion": Condition("motion: things that moved", scenery=moving),
    "night": Condition("night: lamps that clip", scenery=night),
    "sky": Condition("sky: little detail", scenery=sky),
    "snow": Condition("snow: bright and flat", scenery=snow),
    "text": Condition("text", scenery=text),
    "foliage": Condition("foliage", scenery=foliage),
}
"""By name; `base` is what tables are made of."""

PATHS: Final = ("high-iso", "tiff", "jpeg")
SCENES_THAT_HURT: Final = ("depth", "motion", "night", "sky", "snow", "text", "foliage")
