"""A page where it lies in a photo: what its windows show, in what light, and in what tones it was printed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.types import CHANNELS, Channel
from lensmodel.estimation.measure.light import Illumination, fitted_light
from lensmodel.estimation.measure.page import MEAN, TargetPage
from lensmodel.estimation.measure.smooth import quadratic
from lensmodel.estimation.measure.solve import Solved
from lensmodel.estimation.measure.warp import Warp
from lensmodel.estimation.measure.windows import (
    SMALL,
    Latent,
    even_variance,
    measured_pixels,
    roughly,
    window_psf,
)
from lensmodel.photo import LinearPhoto

TONE_SPREAD: Final = 0.3
"""Standard deviation of q and c, see `tones_of`: what tones a print of unknown making may have (chosen:
a gamma of 1.3 has a q of 0.3)."""

_POWERS: Final = ((1.0, 0.0, 0.0), (-2.0 * MEAN, 1.0, 0.0), (3.0 * MEAN**2, -3.0 * MEAN, 1.0))
"""z, z² and z³ of `tones_of` in powers of R, less their constants."""
_TINY: Final = 1e-20  # keeps a division finite
_FINE: Final = 2
"""Samples a pixel that the page is drawn with before it is cut at the pixels' frequencies: at 1, its dots
would alias, more costs time (chosen)."""
_SPARE: Final = 16
"""Pixels around a window, where the taper is: half of the largest kernel comes nearly as far (chosen)."""
_LIGHT_ROUNDS: Final = 2
"""Of fitting light and tones in turn: the second corrects what the first took for the other (chosen)."""


@dataclass(frozen=True, slots=True, eq=False)
class PlacedPage:
    """A page where it lies in a photo.

    Parameters
    ----------
    page : TargetPage
    warp : Warp
        Pixels of the photo to samples of the page.
    tones : tuple of float
        t1, t2, t3 of the print.
    """

    page: TargetPage
    warp: Warp
    tones: tuple[float, float, float] = (1.0, 0.0, 0.0)

    def window(self, row: float, col: float, shape: tuple[int, int]) -> NDArray[np.float32]:
        """Light of the page as pixels would see it that are points; no frequency beyond theirs."""
        # turned or aslant, a page has frequencies along the pixels' axes that pixels do not hold
        high, wide = (fft.next_fast_len(n + 2 * _SPARE, real=True) for n in shape)
        rows = row - _SPARE + np.arange(high * _FINE) / _FINE
        cols = col - _SPARE + np.arange(wide * _FINE) / _FINE
        light = self._toned(self.page.at(*self.warp(*np.meshgrid(rows, cols, indexing="ij"))))
        spectrum = fft.rfft2((light - MEAN) * _taper(high * _FINE)[:, None] * _taper(wide * _FINE))
        coarse = np.zeros((high, wide // 2 + 1), dtype=spectrum.dtype)
        up, down, across = (high + 1) // 2, (high - 1) // 2, (wide + 1) // 2
        coarse[:up, :across] = spectrum[:up, :across]
        coarse[-down:, :across] = spectrum[-down:, :across]
        plane = fft.irfft2(coarse, s=(high, wide)) / _FINE**2 + MEAN
        return np.ascontiguousarray(
            plane[_SPARE : _SPARE + shape[0], _SPARE : _SPARE + shape[1]], dtype=np.float32
        )

    def holds(self, row: int, col: int, side: int, margin: int) -> bool:
        """Whether a window of the photo, with its margin, shows noise and nothing else."""
        steps = np.linspace(-margin, side - 1 + margin, 9)
        return self.page.holds_noise(*self.warp(*np.meshgrid(row + steps, col + steps, indexing="ij")))

    def _toned(self, reflectance: NDArray[np.float32]) -> NDArray[np.float32]:
        first, second, third = (np.float32(t) for t in self.tones)
        toned = reflectance * (first + reflectance * (second + reflectance * third))
        return np.asarray(toned, dtype=np.float32)


@cache
def _taper(length: int) -> NDArray[np.float32]:
    """1 in the middle, falling to 0 within the spare samples at both ends: the rim makes no frequencies."""
    return np.asarray(scipy.signal.windows.tukey(length, 2.0 * _SPARE * _FINE / length), dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class SolvedWindow:
    """A solved window: kernel, the solution it came from, how far the page was moved, and its light."""

    kernel: NDArray[np.float64]
    solved: Solved
    shift: tuple[float, float]
    light: Illumination
    side: int


def solve_window(
    photo: LinearPhoto,
    placed: PlacedPage,
    channel: Channel,
    corner: tuple[int, int],
    side: int,
    size: int,
) -> SolvedWindow:
    """Find the light and the kernel of size `size` of a window of the page.

    Raises
    ------
    NotEnoughEvidenceError
        If the window does not determine a kernel.
    """
    light = _light_on(photo, placed, channel, corner, side)
    kernel, solved, shift = window_psf(
        photo, channel, corner, (side, side), _lit(placed, light, corner, side), size
    )
    return SolvedWindow(kernel, solved, shift, light, side)


def _light_on(
    photo: LinearPhoto, placed: PlacedPage, channel: Channel, corner: tuple[int, int], side: int
) -> Illumination:
    """Light and a small kernel of a window, each found with the other."""
    row, col = corner
    measured = measured_pixels(photo, channel, row, col, (side, side))
    plane = photo.planes[CHANNELS.index(channel), row : row + side, col : col + side]
    observed = np.asarray(plane, dtype=np.float64)
    variance = even_variance(photo, channel, observed, measured)
    light, page = Illumination.even(side), _lit(placed, Illumination.even(side), corner, side)
    for _ in range(_LIGHT_ROUNDS):
        rough, shift = roughly(observed, measured, variance, _lit(placed, light, corner, side))
        light = fitted_light(observed, measured, page(shift, SMALL // 2), rough.kernel)
    return light


def _lit(placed: PlacedPage, light: Illumination, corner: tuple[int, int], side: int) -> Latent:
    """Return what a window shows without blur in some light."""

    def latent(shift: tuple[float, float], margin: int) -> NDArray[np.floating]:
        shape = side + 2 * margin, side + 2 * margin
        page = placed.window(corner[0] - margin - shift[0], corner[1] - margin - shift[1], shape)
        return page * light(margin)

    return latent


def tones_of(
    photo: LinearPhoto, placed: PlacedPage, corners: Sequence[tuple[int, int]], side: int
) -> tuple[float, float, float]:
    """Fit the tones of the print where the lens is sharpest: how the photo follows R.

    With z = R - `MEAN`, tones are  a (z + q z² + c z³)  and a constant, which is light like any other that is
    laid over a window. What windows say of (q, c) is joined by its precision, and with the prior: behind much
    blur, z, z² and z³ look alike, and nothing is known.
    """
    precision, weighted = np.eye(2) / TONE_SPREAD**2, np.zeros(2)
    windows = 0
    for corner in corners:
        try:
            information, bent = _tones_in(photo, placed, corner, side)
        except NotEnoughEvidenceError:
            continue
        precision, weighted, windows = precision + information, weighted + information @ bent, windows + 1
    if windows < 2:
        raise NotEnoughEvidenceError("the page is too blurred to be measured; focus on it")
    q, c = np.linalg.solve(precision, weighted)
    return float(1.0 - 2.0 * q * MEAN + 3.0 * c * MEAN**2), float(q - 3.0 * c * MEAN), float(c)


def _tones_in(
    photo: LinearPhoto, placed: PlacedPage, corner: tuple[int, int], side: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Precision (2, 2) and value (2,) of (q, c) in one window."""
    half = 7
    window = solve_window(photo, placed, "g", corner, side, 2 * half + 1)
    light, kernel = window.light(half), window.kernel
    start = corner[0] - half - window.shift[0], corner[1] - half - window.shift[1]
    shape = side + 2 * half, side + 2 * half
    columns = [
        scipy.signal.fftconvolve(
            replace(placed, tones=tones).window(*start, shape) * light, kernel, mode="valid"
        )
        for tones in _POWERS
    ]
    t = np.linspace(-1.0, 1.0, side)
    columns += list(np.moveaxis(quadratic(t[:, None], t[None, :]), -1, 0))
    good = measured_pixels(photo, "g", *corner, (side, side))
    plane = photo.planes[1, corner[0] : corner[0] + side, corner[1] : corner[1] + side]
    basis = np.stack([column[good] for column in columns], axis=-1)
    observed = np.asarray(plane[good], dtype=np.float64)
    terms, *_ = np.linalg.lstsq(basis, observed, rcond=None)
    if not terms[0] > 0.0:
        raise NotEnoughEvidenceError("a window shows a negative of the page")
    left = float(np.square(observed - basis @ terms).sum()) / max(observed.size - terms.size, 1)
    # only the part of the two columns that the others cannot explain determines q and c
    others = np.delete(basis, (1, 2), axis=1)
    separable = basis[:, 1:3] - others @ np.linalg.lstsq(others, basis[:, 1:3], rcond=None)[0]
    return separable.T @ separable * terms[0] ** 2 / max(left, _TINY), np.asarray(terms[1:3] / terms[0])
