"""What is printed to measure lenses: the known target, and the chart of slanted edges.

The target is a page of band-limited noise with a disc in each corner. Every sample of the noise is drawn on
its own, so that the page holds all spatial frequencies up to half a cycle a sample equally, in both
directions, and says the same of the lens everywhere. It is printed in 64 greys (noise does not compress, and
more make the file larger still), with twice as many dots as samples, so that what the printer leaves of it is
smooth.

The page has no size of its own: printed on A4 or A2 it is the same picture, and the registration finds
where it lies. What must fit is the number of samples along its long side: about as many as the page
takes pixels in the photo. Fewer leave the finest blur unseen; more are finer than pixels and lost.

Source of the idea: N. Joshi et al., "PSF estimation using sharp edge prediction", CVPR 2008, section 4;
M. Delbracio et al., IJCV 96, 2012, section 4, who show that white noise is the target that determines
a PSF best.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageOps
from PIL.PdfParser import PdfName, PdfParser
from scipy import ndimage, signal

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import atomic

DOTS: Final = 2  # Printed dots a sample along each axis
ASPECT: Final = 2**0.5  # Long side over short side, as A4 and A3 have it
# Samples along the long side that pages are made with; a photo is compared with each of them (chosen:
# factors of the root of two)
DETAILS: Final = (1000, 1400, 2000, 2800, 4000, 5600)
MEAN: Final = 0.5  # reflectance of the noise, halfway between ink, 0, and paper, 1
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
        fine = self.samples
        for axis, length in enumerate(self.shape):  # band-limited
            fine = signal.resample(fine, length * DOTS, axis=axis)
        fine = np.clip(fine, 0.0, 1.0)
        height, width = fine.shape
        rows = np.arange(height, dtype=np.float32)[:, None] / DOTS
        cols = np.arange(width, dtype=np.float32)[None, :] / DOTS
        fine[~self._within(rows, cols, self.border - 0.25)] = 1.0
        for row, col in self.marks:
            half = self.mark_side / 2.0
            box = _slice(row, half, height), _slice(col, half, width)
            fine[box] = 1.0
            away = np.hypot(rows[box[0]] - row, cols[:, box[1]] - col)
            # the rim falls over one sample: a step would have frequencies that no pixel resolves
            fine[box] -= np.clip(self.mark_radius + 0.5 - away, 0.0, 1.0).astype(np.float32)
        return fine

    @cached_property
    def _spline(self) -> NDArray[np.float32]:
        return np.asarray(ndimage.spline_filter(self.raster, order=3, output=np.float32, mode="mirror"))

    def at(self, rows: NDArray[np.floating], cols: NDArray[np.floating]) -> NDArray[np.float32]:
        """Reflectance at places of the page, in samples; white beyond it."""
        reflectance = ndimage.map_coordinates(
            self._spline, np.stack([rows, cols]) * DOTS,
            order=3, prefilter=False, mode="constant", cval=1.0, output=np.float32,
        )  # fmt: skip
        return np.asarray(reflectance, dtype=np.float32)

    def holds_noise(self, rows: NDArray[np.floating], cols: NDArray[np.floating]) -> bool:
        """Whether noise, and nothing else, lies at all of these places."""
        if not bool(self._within(rows, cols, self.border + 1.0).all()):
            return False
        half = self.mark_side / 2.0 + 1.0
        return all(
            not bool(((np.abs(rows - row) < half) & (np.abs(cols - col) < half)).any())
            for row, col in self.marks
        )

    def _within(
        self, rows: NDArray[np.floating], cols: NDArray[np.floating], border: float
    ) -> NDArray[np.bool_]:
        """Whether places are as far as a border from the sides of the page."""
        height, width = self.shape
        down = (rows > border) & (rows < height - 1 - border)
        return np.asarray(down & (cols > border) & (cols < width - 1 - border))


def _slice(middle: float, half: float, length: int) -> slice:
    return slice(max(round((middle - half) * DOTS), 0), min(round((middle + half) * DOTS) + 1, length))


# Width and height in millimetres, lying (ISO 216, ANSI/ASME Y14.1)
PAPERS: Final = {
    "a2": (594.0, 420.0),
    "a3": (420.0, 297.0),
    "a4": (297.0, 210.0),
    "letter": (279.4, 215.9),
    "tabloid": (431.8, 279.4),
}
_GREYS: Final = 64  # levels of print: finer than a printer renders, and a small file (chosen)


def print_target(path: str | Path, page: TargetPage, *, paper: str = "a3") -> None:
    """Write a page to print on a paper of `PAPERS`, as a PDF file."""
    path = Path(path)
    width, height = _on_paper(path, paper)
    name = f"lensmodel target, detail {page.detail}, {paper.upper()}"
    steps = np.rint(page.raster * (_GREYS - 1)) * (255.0 / (_GREYS - 1))
    picture = Image.fromarray(np.rint(steps).astype(np.uint8))
    place = (picture.width // 2, picture.height - page.border * DOTS // 2)
    words, size = f"{name}: print at full size, grey, unsharpened", max(page.border * DOTS // 2, 10)
    ImageDraw.Draw(picture).text(place, words, fill=96, font_size=size, anchor="mm")
    if abs(width / height / ASPECT - 1.0) >= 0.01:  # white at two sides where the paper has another shape
        wide, high = round(picture.height * width / height), round(picture.width * height / width)
        picture = ImageOps.pad(picture, (max(wide, picture.width), max(high, picture.height)), color=255)
    with atomic(path) as file:
        # at its best JPEG errs by one of 255 levels, a quarter of the distance between two greys
        picture.save(file, "PDF", resolution=picture.width / (width / 25.4), quality=100, title=name)


def _on_paper(path: Path, paper: str) -> tuple[float, float]:
    """Width and height in millimetres of a paper of `PAPERS`, lying; refuse other papers and files."""
    if path.suffix.lower() != ".pdf":
        raise InvalidInputError(f"{path.name}: what is to be printed is written as .pdf")
    if paper not in PAPERS:
        raise InvalidInputError(f"no paper {paper!r}; known: {', '.join(sorted(PAPERS))}")
    return PAPERS[paper]


# The chart of slanted edges: dark squares, all turned by five degrees. They are drawn as shapes, not as
# pixels: a printer draws their edges as finely as it can. They are black, since printers make greys of dots,
# which a photo would show along the edges.
ROWS: Final = 5
COLS: Final = 7
LEAN_DEG: Final = 5.0
# Side of a square over the distance of two (chosen: a crop on each edge holds flat ground)
_FILL: Final = 0.6
_MARGIN_MM: Final = 7.0  # of white around the squares: printers leave up to 6 mm (chosen)
_POINTS: Final = 72.0 / 25.4  # of PDF, a millimetre


def chart_squares(width: float, height: float, margin: float) -> NDArray[np.float64]:
    """Return the corners (35, 4, 2) of the squares on a page as (x, y), y upwards, in the unit of the page.

    The outermost touch the margin.
    """
    c, s = math.cos(math.radians(LEAN_DEG)), math.sin(math.radians(LEAN_DEG))
    right, up = (COLS - 1) / 2.0, (ROWS - 1) / 2.0
    reach = np.array([right * c + up * s, up * c + right * s]) + _FILL / 2.0 * (c + s)
    spacing = float(np.min((np.array([width, height]) / 2.0 - margin) / reach))
    j, i = np.meshgrid(np.arange(COLS) - right, up - np.arange(ROWS))
    middles = np.stack([j, i], axis=-1).reshape(-1, 1, 2)
    corners = _FILL / 2.0 * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    turned = (middles + corners) @ np.array([[c, s], [-s, c]])
    return np.asarray(turned * spacing + (width / 2.0, height / 2.0))


def print_chart(path: str | Path, *, paper: str = "a3") -> None:
    """Write the chart to print on a paper of `PAPERS`, as a PDF file."""
    path = Path(path)
    width, height = (side * _POINTS for side in _on_paper(path, paper))
    name = f"lensmodel edges, {paper.upper()}"
    shapes = [
        " l ".join(f"{x:.3f} {y:.3f}" for x, y in square).replace(" l ", " m ", 1) + " l h f"
        for square in chart_squares(width, height, _MARGIN_MM * _POINTS)
    ]
    # turned counter-clockwise, the squares leave room below on the right
    words = f"BT /F 7 Tf {0.6 * width:.0f} 8 Td ({name}: print at full size, black, on matte paper) Tj ET"
    letters = {"Type": PdfName("Font"), "Subtype": PdfName("Type1"), "BaseFont": PdfName("Helvetica")}
    with atomic(path) as file:
        pdf = PdfParser(f=file)
        pdf.info[b"Title"] = name.encode()
        page, drawing = (pdf.next_object_id(0) for _ in range(2))
        pdf.pages.append(page)
        pdf.write_header()
        pdf.write_catalog()
        box = [0, 0, round(width, 2), round(height, 2)]
        pdf.write_page(page, MediaBox=box, Contents=drawing, Resources={"Font": {"F": letters}})
        pdf.write_obj(drawing, stream="\n".join([*shapes, words]).encode("ascii"))
        pdf.write_xref_and_trailer()
