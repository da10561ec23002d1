"""PSFs from a photo of the known target: found, registered, its light and its tones fitted, solved.

The page is band-limited noise with a disc in each corner. Every sample of the noise is drawn on its own, so
that the page holds all spatial frequencies up to half a cycle a sample equally. It has no size of its own:
what must fit is the number of samples along its long side, about as many as the page takes pixels in the
photo. Fewer leave the finest blur unseen; more are finer than pixels and lost.

The discs give a homography for each way to turn each page that is known; that whose noise is in the photo is
the one. Windows are matched with it, and a polynomial takes what the lens bends. In a window the light that
falls on the page is a smooth function of the place, and the print has tones of its reflectance R:
light = E(p) (t1 R + t2 R² + t3 R³). A quadratic fitted to the light alone would follow the slow waves of the
noise itself, and a hundredth of wrong light becomes a tenth of wrong kernel. But what is printed is known:
with a kernel k that is nearly right

    y(p) = sum_j e_j (k * (q_j R))(p) + sum_j c_j q_j(p) + n(p)

is linear in e_j, the light, and c_j, what the lens and its reflections lay over it; q_j are `window_terms`.

Source of the idea: N. Joshi et al., "PSF estimation using sharp edge prediction", CVPR 2008, section 4;
M. Delbracio et al., IJCV 96, 2012, section 4, who show that white noise determines a PSF best.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageOps
from scipy import fft, ndimage, signal
from scipy.signal.windows import tukey

from lensmodel.core.errors import InvalidInputError, NotEnoughEvidenceError
from lensmodel.core.files import atomic
from lensmodel.core.types import Channel, Kernel, StepHook
from lensmodel.measured import measurer
from lensmodel.measured.measurer import SMALL, Found, Measurer, Prepared, Window
from lensmodel.measured.registration import CLEAR, Warp, find_marks, homography_of, match, matched
from lensmodel.photo import LinearPhoto

# --- the page ------------------------------------------------------------------------------------

# Printed dots a sample along each axis (chosen): what the printer leaves of it is smooth
DOTS: Final = 2
ASPECT: Final = 2**0.5  # Long side over short side, as A4 and A3 have it
# Samples along the long side that pages are made with; a photo is compared with each of them (chosen:
# factors of the root of two)
DETAILS: Final = (1000, 1400, 2000, 2800, 4000, 5600)
MEAN: Final = 0.5  # reflectance of the noise, halfway between ink, 0, and paper, 1
# Standard deviation of the noise as a share of the paper's white: 3 of them reach ink and paper
CONTRAST: Final = 0.17
_PAGE_SEED: Final = 20120  # any number: printed pages depend on it, so it stays


@dataclass(frozen=True)
class TargetPage:
    """A page, by its samples along the long side; places are in samples from the first one's middle."""

    detail: int  # samples along the long side

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
    def marks(self) -> NDArray[np.float64]:
        """Middles of the discs `(4, 2)`: top left, top right, bottom right, bottom left."""
        near = self.border + self.mark_side / 2.0 - 0.5
        bottom, right = (length - 1 - near for length in self.shape)
        return np.array([(near, near), (near, right), (bottom, right), (bottom, near)])

    @cached_property
    def samples(self) -> NDArray[np.float32]:
        """Reflectance at the samples, noise only, `shape`, ink 0 to paper 1."""
        rng = np.random.default_rng([_PAGE_SEED, self.detail])
        noise = MEAN + CONTRAST * rng.standard_normal(self.shape)
        return np.clip(noise, 0.02, 0.98).astype(np.float32)

    @cached_property
    def raster(self) -> NDArray[np.float32]:
        """The printed page, `DOTS` dots a sample; dot `d` lies at sample `d / DOTS`."""
        fine = self.samples
        for axis, length in enumerate(self.shape):  # band-limited
            fine = signal.resample(fine, length * DOTS, axis=axis)
        fine = np.clip(fine, 0.0, 1.0)
        rows, cols = (np.arange(n, dtype=np.float32) / DOTS for n in fine.shape)
        fine[~self._within(rows[:, None], cols, self.border - 0.25)] = 1.0
        for mark in self.marks:
            half = self.mark_side / 2.0
            box = tuple(slice(round((at - half) * DOTS), round((at + half) * DOTS) + 1) for at in mark)
            away = np.hypot(rows[box[0], None] - mark[0], cols[box[1]] - mark[1])
            # the rim falls over one sample: a step would have frequencies that no pixel resolves
            fine[box] = 1.0 - np.clip(self.mark_side / 4.0 + 0.5 - away, 0.0, 1.0)
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
        half = self.mark_side / 2.0 + 1.0
        marked = [(np.abs(rows - row) < half) & (np.abs(cols - col) < half) for row, col in self.marks]
        return bool((self._within(rows, cols, self.border + 1.0) & ~np.any(marked, axis=0)).all())

    def _within(
        self, rows: NDArray[np.floating], cols: NDArray[np.floating], border: float
    ) -> NDArray[np.bool_]:
        """Whether places are as far as a border from the sides of the page."""
        height, width = self.shape
        down = (rows > border) & (rows < height - 1 - border)
        return np.asarray(down & (cols > border) & (cols < width - 1 - border))


# Width and height in millimetres, lying (ISO 216, ANSI/ASME Y14.1)
PAPERS: Final = {
    "a2": (594.0, 420.0),
    "a3": (420.0, 297.0),
    "a4": (297.0, 210.0),
    "letter": (279.4, 215.9),
    "tabloid": (431.8, 279.4),
}
# Levels of print (chosen): finer than a printer renders; noise does not compress, and more make a large file
_GREYS: Final = 64


def print_target(path: str | Path, page: TargetPage, *, paper: str = "a3") -> None:
    """Write a page to print on a paper of `PAPERS`, as a PDF file."""
    path = Path(path)
    if path.suffix.lower() != ".pdf":
        raise InvalidInputError(f"{path.name}: what is to be printed is written as .pdf")
    if paper not in PAPERS:
        raise InvalidInputError(f"no paper {paper!r}; known: {', '.join(sorted(PAPERS))}")
    width, height = PAPERS[paper]
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


# --- its PSFs ------------------------------------------------------------------------------------

_TOO_SMALL: Final = "the page is too small in the photo; go nearer until it nearly fills the frame"
_SIDE: Final = 144  # pixels of a window: wide enough for the largest kernel, small enough for one (chosen)
_FEWEST: Final = 64  # pixels of a window to fit its light to: five to ten for each term (chosen)
_TONE_WINDOWS: Final = 6  # in the middle of the frame, where the lens is sharpest (chosen)
_TRIED: Final = 6  # windows looked at along each axis for one that is measured: the page may end anywhere


@dataclass(frozen=True, slots=True)
class Target(Measurer):
    """Non-blind PSFs from one photo of the printed target."""

    # places along the sides of the frame; fewer where windows would overlap by more than a quarter
    across: int = 9
    down: int = 6
    side: int = _SIDE  # side of a window in pixels
    details: tuple[int, ...] = DETAILS  # pages that it may be, by the samples along their long side

    name: ClassVar[str] = "target"
    floor: ClassVar[float] = 0.02  # of the models of light, tones and place (chosen)
    most: ClassVar[float] = 0.3
    shows: ClassVar[str] = "the page that `lensmodel target` writes"

    def _prepare(self, photos: Sequence[LinearPhoto], size: int, on_step: StepHook) -> Prepared:
        """Find the page, its tones, and windows all over it."""
        photo = photos[0]
        placed = self.find(photo, on_step)
        height, width = photo.planes.shape[1:]
        down = min(self.down, max(height // (3 * self.side // 4), 2))
        across = min(self.across, max(width // (3 * self.side // 4), 2))
        held = placed.corners(self.side, _TRIED * across, _TRIED * down, size // 2)
        if not held:
            raise NotEnoughEvidenceError(_TOO_SMALL)
        corners = _spread(held, across, down)
        middle = sorted(corners, key=lambda c: np.hypot(*(np.add(c, self.side / 2) - photo.frame.center)))
        tones = _tones_of(photo, placed, middle[:_TONE_WINDOWS], self.side, on_step)
        placed = replace(placed, tones=tones)

        def psf_in(corner: tuple[int, int], channel: Channel) -> Found:
            window = Window.of(photo, channel, corner, self.side)
            solved, *_ = _solved(window, placed, size)
            return Found(solved.kernel, solved.error, window.middle)

        return corners, psf_in

    def find(self, photo: LinearPhoto, on_step: StepHook) -> PlacedPage:
        """Find the page in a photo and register it to a fraction of a pixel."""
        plane, side = np.asarray(photo.planes[1]), self.side
        placed = self._identified(photo, on_step)
        corners = placed.corners(side, 12, 8, 0)
        warp = placed.warp

        def shown(bent: Warp, corner: tuple[int, int], shape: tuple[int, int]) -> NDArray[np.float32]:
            return replace(placed, warp=bent).window(*corner, shape)

        for degree in (1, 3, 5, 5):
            warp = matched(warp, shown, plane, corners, side, degree, on_step)
        return replace(placed, warp=warp)

    def _identified(self, photo: LinearPhoto, on_step: StepHook) -> PlacedPage:
        """Say which page it is and which way up, by the noise near the middle of the page."""
        best: tuple[float, PlacedPage] | None = None
        plane = photo.planes[1]
        marks = find_marks(plane)
        middle = marks.mean(axis=0)
        row, col = np.rint(middle - _SIDE / 2).astype(int)
        seen = plane[max(row, 0) : row + _SIDE, max(col, 0) : col + _SIDE]
        if seen.shape != (_SIDE, _SIDE):
            raise NotEnoughEvidenceError(_TOO_SMALL)
        for page, turn in product(map(TargetPage, self.details), range(4)):
            on_step(0, 1)
            warp = Warp(homography_of(np.roll(marks, -turn, axis=0), page.marks), photo.frame)
            if 0.3 < warp.scale(*middle) < 3.0:  # else pixels do not resolve the noise
                placed = PlacedPage(page, warp)
                _, clarity = match(seen, placed.window(row, col, seen.shape))
                if best is None or clarity > best[0]:
                    best = clarity, placed
        if best is None or best[0] < CLEAR:
            raise NotEnoughEvidenceError(
                "no known target is seen; photograph the page that `lensmodel target` writes, printed "
                "without stretching it, whole and in focus"
            )
        return best[1]


def _spread(held: Sequence[tuple[int, int]], across: int, down: int) -> list[tuple[int, int]]:
    """Choose of all windows that show noise those nearest to an even grid over them."""
    places = np.array(held)
    first, last = places.min(axis=0), places.max(axis=0)
    parts = [np.linspace(0.0, 1.0, count) if count > 1 else np.array([0.5]) for count in (down, across)]
    wanted = first + (last - first) * np.stack(np.meshgrid(*parts, indexing="ij"), axis=-1).reshape(-1, 2)
    return sorted({held[int(np.argmin(np.hypot(*(places - place).T)))] for place in wanted})


# Standard deviation of q and c, see `_tones_of` (chosen: a gamma of 1.3 has a q of 0.3)
TONE_SPREAD: Final = 0.3
# z, z² and z³ of `_tones_of` in powers of R, less their constants
_POWERS: Final = ((1.0, 0.0, 0.0), (-2.0 * MEAN, 1.0, 0.0), (3.0 * MEAN**2, -3.0 * MEAN, 1.0))
_TINY: Final = 1e-20  # keeps a division finite
_FINE: Final = 2  # samples a pixel that the page is drawn with: at 1, its dots would alias (chosen for time)
_SPARE: Final = 16  # pixels around a window, where the taper is: as far as half of a kernel (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class PlacedPage:
    """A page where it lies in a photo."""

    page: TargetPage
    warp: Warp  # pixels of the photo to samples of the page
    tones: tuple[float, float, float] = (1.0, 0.0, 0.0)  # t1, t2, t3 of the print

    def window(self, row: float, col: float, shape: tuple[int, int]) -> NDArray[np.float32]:
        """Light of the page as pixels would see it that are points; no frequency beyond theirs."""
        # turned or aslant, a page has frequencies along the pixels' axes that pixels do not hold
        sides = [fft.next_fast_len(n + 2 * _SPARE, real=True) for n in shape]
        places = [at - _SPARE + np.arange(n * _FINE) / _FINE for at, n in zip((row, col), sides, strict=True)]
        shown = self.page.at(*self.warp(*np.meshgrid(*places, indexing="ij")))
        first, second, third = (np.float32(t) for t in self.tones)
        plane = shown * (first + shown * (second + shown * third)) - MEAN
        # falling to 0 within the spare samples at both ends, the rim makes no frequencies
        down, along = (tukey(n * _FINE, 2.0 * _SPARE / n).astype(np.float32) for n in sides)
        plane *= down[:, None] * along
        for axis, n in enumerate(sides):
            plane = signal.resample(plane, n, axis=axis)
        inner = plane[_SPARE : _SPARE + shape[0], _SPARE : _SPARE + shape[1]]
        return np.ascontiguousarray(inner + MEAN, dtype=np.float32)

    def corners(self, side: int, across: int, down: int, margin: int) -> list[tuple[int, int]]:
        """Corners of the windows spread over the photo that show noise and nothing else, with a margin."""
        steps, frame = np.linspace(-margin, side - 1 + margin, 9), self.warp.frame
        return [
            (row, col)
            for row, col in measurer.window_corners((frame.height, frame.width), side, across, down, 0)
            if self.page.holds_noise(*self.warp(*np.meshgrid(row + steps, col + steps, indexing="ij")))
        ]


def _solved(
    window: Window, placed: PlacedPage, size: int
) -> tuple[measurer.Solved, tuple[float, float], NDArray[np.float64]]:
    """Kernel of a window of the page, how far the page was moved, and terms (6,) of its light."""
    (row, col), side = window.corner, len(window.light)

    def page(shift: tuple[float, float], margin: int) -> NDArray[np.float32]:
        outer = side + 2 * margin, side + 2 * margin
        return placed.window(row - margin - shift[0], col - margin - shift[1], outer)

    def lit(shift: tuple[float, float], margin: int) -> NDArray[np.floating]:
        return page(shift, margin) * (measurer.window_terms(side, margin) @ light)

    light = np.eye(6)[0]
    rough, shift = measurer.roughly(window, lit)
    light = _fitted_light(window, page(shift, SMALL // 2), rough)
    solved, shift = measurer.window_psf(window, lit, size, varying=True)
    return solved, shift, light


def _tones_of(
    photo: LinearPhoto, placed: PlacedPage, corners: Sequence[tuple[int, int]], side: int, on_step: StepHook
) -> tuple[float, float, float]:
    """Fit the tones of the print where the lens is sharpest: how the photo follows R.

    With z = R - `MEAN`, tones are  a (z + q z² + c z³)  and a constant, which is light like any other that is
    laid over a window. What windows say of (q, c) is joined by its precision, and with the prior: behind much
    blur, z, z² and z³ look alike, and nothing is known.
    """
    precision, weighted = np.eye(2) / TONE_SPREAD**2, np.zeros(2)
    windows = 0
    for corner in corners:
        on_step(0, 1)
        try:
            information, bent = _tones_in(Window.of(photo, "g", corner, side), placed)
        except NotEnoughEvidenceError:
            continue
        precision, weighted, windows = precision + information, weighted + information @ bent, windows + 1
    if windows < 2:
        raise NotEnoughEvidenceError("the page is too blurred to be measured; focus on it")
    q, c = np.linalg.solve(precision, weighted)
    return float(1.0 - 2.0 * q * MEAN + 3.0 * c * MEAN**2), float(q - 3.0 * c * MEAN), float(c)


def _tones_in(window: Window, placed: PlacedPage) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Precision (2, 2) and value (2,) of (q, c) in one window."""
    side, half, (row, col), good = len(window.light), SMALL // 2, window.corner, window.measured
    solved, shift, terms = _solved(window, placed, SMALL)
    light, outer = measurer.window_terms(side, half) @ terms, (side + 2 * half,) * 2
    start = row - half - shift[0], col - half - shift[1]
    pages = [replace(placed, tones=tones).window(*start, outer) * light for tones in _POWERS]
    basis, terms = _explained(window, pages, solved.kernel)
    if not terms[0] > 0.0:
        raise NotEnoughEvidenceError("a window shows a negative of the page")
    left = float(np.square(window.light[good] - basis @ terms).sum()) / max(len(basis) - terms.size, 1)
    # only the part of the two columns that the others cannot explain determines q and c
    others = np.delete(basis, (1, 2), axis=1)
    separable = basis[:, 1:3] - others @ np.linalg.lstsq(others, basis[:, 1:3], rcond=None)[0]
    return separable.T @ separable * terms[0] ** 2 / max(left, _TINY), np.asarray(terms[1:3] / terms[0])


def _fitted_light(window: Window, page: NDArray[np.floating], kernel: Kernel) -> NDArray[np.float64]:
    """Terms (6,) of a quadratic in row and column, whose mean over its square window is 1."""
    side = len(window.light)
    if int(window.measured.sum()) < _FEWEST:
        raise NotEnoughEvidenceError("nearly all pixels of a window are clipped; expose less")
    lit = page * np.moveaxis(measurer.window_terms(side, len(kernel) // 2), -1, 0)
    terms = _explained(window, lit, kernel)[1][:6]
    light = measurer.window_terms(side) @ terms
    if not float(light.min()) > 0.0:
        raise NotEnoughEvidenceError("a window of the page is black, or does not show the page; light it")
    return np.asarray(terms / float(light.mean()))


def _explained(
    window: Window, pages: Iterable[NDArray[np.floating]], kernel: Kernel
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Columns of blurred pages and of light laid over them at the measured pixels, and the share of each."""
    blurred = [signal.fftconvolve(page, kernel, mode="valid")[window.measured] for page in pages]
    basis = np.column_stack([*blurred, measurer.window_terms(len(window.light))[window.measured]])
    return basis, np.linalg.lstsq(basis, window.light[window.measured], rcond=None)[0]
