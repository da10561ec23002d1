"""What speaks against a window: its own spectrum, periods, blocks and blobs.

And whether the chosen patches of a photo are enough, and spread out enough, to tell about its lens.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from lensmodel.core.errors import NoUsablePatchesError
from lensmodel.core.types import FieldPosition, NoiseModel, Plane, zone_of
from lensmodel.patches.windows import CLIP_SHARE, Patch, Windows, polynomials

SECTORS: Final = 8  # of 22.5 degrees: a line lies in one or two
BAND_EDGES: Final = (0.03, 0.1, 0.2, 0.35)  # cycles/pixel (chosen): coarse, middle and fine detail
BANDS: Final = len(BAND_EDGES) - 1  # the intervals between them
# bands that blur takes away: lenses leave nearly all below 0.1, demosaicing little above 0.4
EVIDENCE_EDGES: Final = (0.1, 0.2, 0.3, 0.4)

NON_UNIFORMITY: Final = 0.005  # relative deviation of the gain of pixels: 0.3 to 1 percent by EMVA 1288
DYNAMIC_RANGE: Final = 2.0**14.8  # of the best sensors: less noise was eaten by rounding or denoising

_JPEG_BLOCK = 8  # pixels: ITU-T T.81
_MAIN_LOBE_PX = 8  # pixels: nearer peaks of the autocorrelation are the blur itself (chosen)
_ON_THE_WAY = 24  # points from a peak to the middle: a valley is wider than a twentieth of it (chosen)
_CORE_PX = (2, 4)  # nearer than this neighbours are alike: for the valley, for the peak
_REPEATS = (-0.4, 0.9)  # correlation at the valley and the peak of what repeats


@dataclass(frozen=True, slots=True, eq=False)
class Details:
    """Second look at some windows; every array has one entry a window along axis 0."""

    information: NDArray[np.float64]  # (n, BANDS, SECTORS), natural logarithm of power over noise
    period: NDArray[np.float64]  # (n,), highest separate peak of the autocorrelation, 1 for a perfect period
    blockiness: NDArray[np.float64]  # (n,), steps on an 8 px grid over steps off it; 1 where there is none
    blob: NDArray[np.int64]  # (n,), pixels of the largest connected clipped area
    kurtosis: NDArray[np.float64]  # (n,), of differences; 3 for a Gaussian, more for isolated edges
    evidence: NDArray[np.float64]  # (n,), bits a frequency between 0.1 and 0.4 cycles/pixel; 0 for noise

    def take(self, index: NDArray[np.integer] | NDArray[np.bool_]) -> Details:
        """Return the entries that `index` picks."""
        return Details(*(getattr(self, name)[index] for name in self.__slots__))


def repeats(patch: Plane) -> bool:
    """Whether the autocorrelation of a patch falls far below zero and comes back nearly to one: a fence."""
    power = np.abs(fft.rfft2((patch - patch.mean()).astype(np.float64))) ** 2
    correlation = fft.irfft2(power, s=patch.shape)
    if not correlation[0, 0] > 0:
        return False
    correlation /= correlation[0, 0]
    rows, cols = (np.minimum(np.arange(n), n - np.arange(n)) for n in patch.shape)
    gap = np.hypot(rows[:, None], cols[None, :])
    reach = gap < min(patch.shape) // 3
    valley = float(correlation[(gap > _CORE_PX[0]) & reach].min())
    peak = float(correlation[(gap > _CORE_PX[1]) & reach].max())
    return valley < _REPEATS[0] and peak > _REPEATS[1]


def details_of(plane: Plane, windows: Windows, clip: float, coarse: NoiseModel | None = None) -> Details:
    """Look at windows of a plane; `coarse` is the noise between 0.1 and 0.4 cycles/pixel where it is more."""
    size, parts = windows.size, []
    for i, (row, col) in enumerate(zip(windows.rows.tolist(), windows.cols.tolist(), strict=True)):
        patch = np.array(plane[row : row + size, col : col + size])
        more = 0.0 if coarse is None else float(np.sqrt(coarse.variance(windows.level[i])))
        parts.append(look_at(patch, float(windows.sigma[i]), clip, (row, col), more))
    return Details(*(np.concatenate([getattr(p, name) for p in parts]) for name in Details.__slots__))


def look_at(
    patch: Plane, sigma: float, clip: float, corner: tuple[int, int], coarse_sigma: float = 0.0
) -> Details:
    """Look at one window."""
    values = np.asarray(patch, dtype=np.float64)
    grids, flat = _grids(values.shape[0]), values.ravel()
    detrended = (flat - grids.slopes @ (flat @ grids.slopes)).reshape(values.shape)
    # periodogram under a Hann window, scaled so that white noise gives its variance
    power = np.square(np.abs(fft.rfft2(detrended * grids.hann))) / float(np.square(grids.hann).sum())
    areas = ndimage.label(values >= CLIP_SHARE * clip)[0]
    squares = np.concatenate([np.diff(values, axis=0).ravel(), np.diff(values, axis=1).ravel()]) ** 2
    noise = max(sigma, coarse_sigma) ** 2
    noise += (NON_UNIFORMITY * values.mean()) ** 2 + (clip / DYNAMIC_RANGE) ** 2
    return Details(
        information=_information(power, sigma)[None],
        period=np.array([1.0 if repeats(patch) else _period(power, sigma)]),
        blockiness=np.array([_blockiness(values, corner)]),
        blob=np.bincount(areas.ravel())[1:].max(initial=0, keepdims=True),
        kurtosis=np.array([float(np.mean(squares**2)) / max(float(np.mean(squares)) ** 2, 1e-30)]),
        evidence=np.array([_evidence(power, noise)]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Grids:
    """What depends on the side of a window alone."""

    slopes: NDArray[np.float64]  # (size^2, count), orthonormal polynomials up to `SLOPE_ORDER`
    hann: NDArray[np.float64]  # (size, size)
    bands: NDArray[np.intp]  # (size, size // 2 + 1), number of band and sector of a frequency, -1 outside
    evidence: NDArray[np.intp]  # the same of `EVIDENCE_EDGES`
    gradient: NDArray[np.float64]  # (size, size // 2 + 1), weights of the power of smoothed gradients
    taper: NDArray[np.float64]  # the Hann window's own autocorrelation at `_near_lags`, 1 in the middle
    far: NDArray[np.bool_]  # which of these lie beyond the core


@lru_cache(maxsize=4)
def _grids(size: int) -> _Grids:
    fr, fc = fft.fftfreq(size)[:, None], fft.rfftfreq(size)[None, :]
    radius = np.hypot(fr, fc)
    sector = np.floor(np.arctan2(fr, fc) * (SECTORS / np.pi) + 0.5).astype(np.intp) % SECTORS

    def numbers(edges: tuple[float, ...]) -> NDArray[np.intp]:
        band = np.searchsorted(edges, radius, side="right") - 1
        # Of the column fc = 0 the half spectrum holds both halves: one of them must not count.
        inside = (band >= 0) & (band < len(edges) - 1) & ((fc > 0.0) | (fr > 0.0))
        return np.where(inside, band * SECTORS + sector, -1)

    hann = np.outer(*[np.hanning(size + 2)[1:-1]] * 2)
    square = (2.0 * np.pi * radius) ** 2
    autocorrelation = fft.fftshift(fft.irfft2(np.square(np.abs(fft.rfft2(hann))), s=(size, size)))
    lag = np.hypot(*np.ogrid[-(size // 3) : size // 3 + 1, -(size // 3) : size // 3 + 1])
    return _Grids(
        slopes=np.linalg.qr(polynomials(size).reshape(-1, size * size).T)[0],
        hann=hann,
        bands=numbers(BAND_EDGES),
        evidence=numbers(EVIDENCE_EDGES),
        gradient=square * np.exp(-2.0 * square),
        taper=_near_lags(autocorrelation) / autocorrelation[size // 2, size // 2],
        far=lag >= _MAIN_LOBE_PX,
    )


def _near_lags(correlation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lags up to a third of the window to each side."""
    middle, reach = len(correlation) // 2, len(correlation) // 3
    return correlation[middle - reach : middle + reach + 1, middle - reach : middle + reach + 1]


def _means(
    power: NDArray[np.float64], number: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Mean power of each band and sector, and how many frequencies each holds."""
    inside = number >= 0
    count = np.bincount(number[inside])
    return np.bincount(number[inside], power[inside]) / np.maximum(count, 1), count


def _evidence(power: NDArray[np.float64], noise: float) -> float:
    """Bits a frequency: mean of log2(1 + max(P / N - 1, 0)) over the bands and sectors that blur empties.

    Source: C. E. Shannon, "Communication in the presence of noise", Proc. IRE 37, 1949.
    """
    mean, count = _means(power, _grids(power.shape[0]).evidence)
    signal = np.maximum(mean / max(noise, 1e-30) - 1.0, 0.0)
    return float(np.log2(1.0 + signal) @ count / count.sum())


def _information(power: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
    """Mean log of power over noise: at which frequencies and directions the window carries signal."""
    mean, _ = _means(power, _grids(power.shape[0]).bands)
    return np.log(np.maximum(mean / max(sigma * sigma, 1e-12), 1e-3)).reshape(BANDS, SECTORS)


def _period(power: NDArray[np.float64], sigma: float) -> float:
    """Highest peak of the autocorrelation of the gradients that a valley of half its height parts from 0."""
    size = power.shape[0]
    grids, middle, reach = _grids(size), size // 2, size // 3
    signal = np.maximum(power - sigma * sigma, 0.0) * grids.gradient
    correlation = fft.fftshift(fft.irfft2(signal, s=(size, size)))
    if correlation[middle, middle] <= 0.0:
        return 0.0
    # The window's own autocorrelation takes weight from long lags; give it back up to a third.
    correlation = _near_lags(correlation / correlation[middle, middle]) / grids.taper
    highest = ndimage.maximum_filter(correlation, 3)
    peaks = np.argwhere((correlation == highest) & grids.far & (correlation > 0.0))
    heights = correlation[peaks[:, 0], peaks[:, 1]]
    t = np.linspace(0.0, 1.0, _ON_THE_WAY)[:, None]
    for at in np.argsort(heights)[::-1][:6]:
        way = np.rint(reach + (peaks[at] - reach) * t).astype(int)
        if float(correlation[way[:, 0], way[:, 1]].min()) < 0.5 * heights[at]:
            return min(float(heights[at]), 1.0)
    return 0.0


def _blockiness(values: NDArray[np.float64], corner: tuple[int, int]) -> float:
    """Mean step across the lines of an 8 px grid over that elsewhere, less what neighbours predict."""
    ratios = []
    for axis in (0, 1):
        d = np.abs(np.diff(values, axis=axis))
        d = d if axis == 0 else d.T
        excess = np.abs(d[1:-1] - 0.5 * (d[:-2] + d[2:])).mean(axis=1)
        # Entry i belongs to the line between pixels i + 1 and i + 2 of the window.
        phase = (np.arange(excess.size) + 2 + corner[axis]) % _JPEG_BLOCK
        by_phase = np.array([excess[phase == k].mean() for k in range(_JPEG_BLOCK)])
        ratios.append(by_phase[0] / max(float(np.median(by_phase[1:])), 1e-12))
    return float(np.mean(ratios))


LEAST_PATCHES: Final = 6  # that lie apart: a plane over the field has three unknowns, as many tell if it fits
LEAST_PARTS: Final = 3  # of the picture that they lie in: three places off one line determine a plane
PARTS: Final = 9  # the centre, the four quarters of the picture around it, and the outer end of each


def part_of(position: FieldPosition) -> int:
    """Number of the part of the picture that a place lies in, 0 to `PARTS` - 1, the centre first."""
    zone = zone_of(position.r)
    if zone == "center":
        return 0
    quarter = math.floor(position.phi / (math.pi / 2.0)) % 4
    return 1 + quarter + (4 if zone == "corner" else 0)


def require_enough(patches: Sequence[Patch], *, least: int = LEAST_PATCHES) -> None:
    """Refuse a photo whose detail is too little, or all in one place."""
    single: list[Patch] = []  # those half a side or more from each other
    for patch in patches:
        if all(max(abs(patch.row - k.row), abs(patch.col - k.col)) >= patch.size / 2 for k in single):
            single.append(patch)
    parts = len({part_of(patch.position) for patch in single})
    if len(single) < least:
        places = "one place" if len(single) == 1 else f"{len(single)} places"
        raise NoUsablePatchesError(
            f"fine detail in focus was found in only {places}, and a photo counts from {least} on; take a "
            "scene full of detail, at a low ISO, and give the photo in its full size"
        )
    if parts < min(LEAST_PARTS, least):
        raise NoUsablePatchesError(
            f"fine detail in focus was found in only {parts} of {PARTS} parts of the picture (the centre, "
            f"four quarters and their outer ends), and a photo counts from {LEAST_PARTS} on; take "
            "a scene with detail all over"
        )
