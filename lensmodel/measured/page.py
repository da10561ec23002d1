"""The known target: a page of band-limited noise with a disc in each corner.

Every sample of the noise is drawn on its own, so that the page holds all spatial frequencies up to half
a cycle a sample equally, in both directions, and says the same of the lens everywhere. It is printed in
grey, with twice as many dots as samples, so that what the printer leaves of it is smooth.

The page has no size of its own: printed on A4 or A2 it is the same picture, and the registration finds
where it lies. What must fit is the number of samples along its long side: about as many as the page
takes pixels in the photo. Fewer leave the finest blur unseen; more are finer than pixels and lost.

Source of the idea: N. Joshi et al., "PSF estimation using sharp edge prediction", CVPR 2008, section 4;
M. Delbracio et al., IJCV 96, 2012, section 4, who show that white noise is the target that determines
a PSF best.

It is printed from a PNG or PDF, in 64 greys: noise does not compress, and more make the file larger still.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageOps
from scipy import ndimage, signal

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import atomic

DOTS: Final = 2  # Printed dots a sample along each axis
ASPECT: Final = 2**0.5  # Long side over short side, as A4 and A3 have it
# Samples along the long side that pages are made with; a photo is compared with each of them (chosen:
# factors of the root of two)
DETAILS: Final = (1000, 1400, 2000, 2800, 4000, 5600)
PAPER: Final = 1.0  # reflectance, that of white by definition
INK: Final = 0.0  # reflectance, that of black by definition
MEAN: Final = 0.5  # of the noise: halfway between ink and paper
# Standard deviation of the noise as a share of the paper's white: 3 of them reach ink and paper
CONTRAST: Final = 0.17
_SEED: Final = 20120  # any number: printed pages depend on it, so it stays
# Samples along the long side: 0.07 mm each on the largest paper, about as fine as greys are printed (chosen)
_LARGEST: Final = 8000
# Samples along the long side: coarser noise holds no frequency that a lens takes away (chosen)
_SMALLEST: Final = 200


@dataclass(frozen=True)
class TargetPage:
    """A page, by the number of its samples along the long side.

    Coordinates of the page are `(y, x)` in samples; (0, 0) is the middle of its top left sample.
    """

    detail: int  # samples along the long side

    def __post_init__(self) -> None:
        if not _SMALLEST <= self.detail <= _LARGEST:
            raise InvalidInputError(
                f"a page has {_SMALLEST} to {_LARGEST} samples along its long side, not {self.detail}"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """Samples down and across."""
        return round(self.detail / ASPECT), self.detail

    @property
    def border(self) -> int:
        """Width of the white border in samples: printers leave one anyway."""
        return max(self.detail // 50, 8)

    @property
    def mark_side(self) -> int:
        """Side in samples of the white square around a corner's disc."""
        return self.detail // 16

    @property
    def mark_radius(self) -> float:
        """Radius of the discs in samples."""
        return self.mark_side / 4.0

    @property
    def marks(self) -> NDArray[np.float64]:
        """Middles of the discs `(4, 2)`: top left, top right, bottom right, bottom left."""
        near = self.border + self.mark_side / 2.0 - 0.5
        top, left = near, near
        bottom, right = (length - 1 - near for length in self.shape)
        return np.array([(top, left), (top, right), (bottom, right), (bottom, left)], dtype=np.float64)

    @cached_property
    def samples(self) -> NDArray[np.float32]:
        """Reflectance at the samples, noise only, `shape`, ink 0 to paper 1."""
        rng = np.random.default_rng([_SEED, self.detail])
        noise = MEAN + CONTRAST * rng.standard_normal(self.shape)
        return np.clip(noise, 0.02, 0.98).astype(np.float32)

    @cached_property
    def raster(self) -> NDArray[np.float32]:
        """The printed page, `DOTS` dots a sample; dot `d` lies at sample `d / DOTS`."""
        fine = np.clip(_finer(self.samples), INK, PAPER)
        height, width = fine.shape
        rows = np.arange(height, dtype=np.float32)[:, None] / DOTS
        cols = np.arange(width, dtype=np.float32)[None, :] / DOTS
        last = self.shape[0] - 1, self.shape[1] - 1
        edge = self.border - 0.25
        outside = (rows < edge) | (rows > last[0] - edge) | (cols < edge) | (cols > last[1] - edge)
        fine[outside] = PAPER
        for row, col in self.marks:
            half = self.mark_side / 2.0
            box = _slice(row, half, height), _slice(col, half, width)
            fine[box] = PAPER
            away = np.hypot(rows[box[0]] - row, cols[:, box[1]] - col)
            # the rim falls over one sample: a step would have frequencies that no pixel resolves
            fine[box] -= (PAPER - INK) * np.clip(self.mark_radius + 0.5 - away, 0.0, 1.0).astype(np.float32)
        return fine

    @cached_property
    def _spline(self) -> NDArray[np.float32]:
        return np.asarray(ndimage.spline_filter(self.raster, order=3, output=np.float32, mode="mirror"))

    def at(self, rows: NDArray[np.floating], cols: NDArray[np.floating]) -> NDArray[np.float32]:
        """Reflectance at places of the page, in samples; white beyond it."""
        reflectance = ndimage.map_coordinates(
            self._spline, np.stack([rows, cols]) * DOTS,
            order=3, prefilter=False, mode="constant", cval=PAPER, output=np.float32,
        )  # fmt: skip
        return np.asarray(reflectance, dtype=np.float32)

    def holds_noise(self, rows: NDArray[np.floating], cols: NDArray[np.floating]) -> bool:
        """Whether noise, and nothing else, lies at all of these places."""
        last = self.shape[0] - 1, self.shape[1] - 1
        edge = self.border + 1.0
        inside = (rows > edge) & (rows < last[0] - edge) & (cols > edge) & (cols < last[1] - edge)
        if not bool(inside.all()):
            return False
        half = self.mark_side / 2.0 + 1.0
        return all(
            not bool(((np.abs(rows - row) < half) & (np.abs(cols - col) < half)).any())
            for row, col in self.marks
        )


def _slice(middle: float, half: float, length: int) -> slice:
    return slice(max(round((middle - half) * DOTS), 0), min(round((middle + half) * DOTS) + 1, length))


def _finer(samples: NDArray[np.float32]) -> NDArray[np.float32]:
    """Band-limited interpolation to `DOTS` dots a sample."""
    for axis, length in enumerate(samples.shape):
        samples = signal.resample(samples, length * DOTS, axis=axis)
    return samples


# Width and height in millimetres, lying (ISO 216, ANSI/ASME Y14.1)
PAPERS: Final = {
    "a2": (594.0, 420.0),
    "a3": (420.0, 297.0),
    "a4": (297.0, 210.0),
    "letter": (279.4, 215.9),
    "tabloid": (431.8, 279.4),
}
SUFFIXES: Final = (".pdf", ".png")
_GREYS: Final = 64  # levels of print: finer than a printer renders, and a small file (chosen)


def print_target(path: str | Path, page: TargetPage, *, paper: str = "a3") -> None:
    """Write a page to print on a paper of `PAPERS`, as a file whose suffix is one of `SUFFIXES`."""
    path = Path(path)
    width, height = require_paper(paper)
    if path.suffix.lower() not in SUFFIXES:
        raise InvalidInputError(f"{path.name}: a target is written as {', '.join(SUFFIXES)}")
    picture = _on_paper(_greys(page, paper), width / height)
    dpi = picture.width / (width / 25.4)
    with atomic(path) as file:
        if path.suffix.lower() == ".png":
            picture.save(file, "PNG", dpi=(dpi, dpi))
        else:  # at its best JPEG errs by one of 255 levels, a quarter of the distance between two greys
            picture.save(file, "PDF", resolution=dpi, quality=100, title=_name(page, paper))


def require_paper(paper: str) -> tuple[float, float]:
    """Return width and height of a paper of `PAPERS`, lying, in millimetres; refuse an unknown one."""
    if paper not in PAPERS:
        raise InvalidInputError(f"no paper {paper!r}; known: {', '.join(sorted(PAPERS))}")
    return PAPERS[paper]


def _on_paper(picture: Image.Image, aspect: float) -> Image.Image:
    """Put white at two sides of a page where the paper is not of its shape."""
    if abs(aspect / ASPECT - 1.0) < 0.01:
        return picture
    width, height = picture.size
    size = max(width, round(height * aspect)), max(height, round(width / aspect))
    return ImageOps.pad(picture, size, color=255)


def _name(page: TargetPage, paper: str) -> str:
    return f"lensmodel target, detail {page.detail}, {paper.upper()}"


def _greys(page: TargetPage, paper: str) -> Image.Image:
    """The raster with its name in the lower border."""
    steps = np.rint(page.raster * (_GREYS - 1)) * (255.0 / (_GREYS - 1))
    picture = Image.fromarray(np.rint(steps).astype(np.uint8))
    text = f"{_name(page, paper)}: print at full size, grey, unsharpened"
    height = max(page.border * DOTS // 2, 10)
    place = (page.shape[1] * DOTS // 2, picture.height - page.border * DOTS // 2)
    ImageDraw.Draw(picture).text(place, text, fill=96, font_size=height, anchor="mm")
    return picture
