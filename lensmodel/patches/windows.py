"""The windows of a photo: what is known of each candidate, as arrays.

One pass over a plane sums over small blocks, from which any window is put together (`windows_of`). A few are
then looked at by themselves (`details_of`): their spectrum, periods, blocks and blobs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import fft, ndimage

from lensmodel.core.types import Frame, NoiseModel, Plane, StepHook
from lensmodel.patches.rmap import (
    GROUPS,
    R_BINS,
    WINDOW,
    automatic_threshold,
    gradient_noise,
    r_bin,
    r_of_gradients,
    smoothed_gradients,
)

ORIENTATIONS: Final = 8  # bins of gradient direction over half a turn, with edges enough in each (chosen)
BLOCKS_A_SIDE: Final = 4  # of a window, which starts at any: finer starts find nearly the same ones (chosen)
WIDTH_BINS: Final = 28
WIDTH_STEP_PX: Final = 0.2  # of a histogram of edge widths, 0 to 5.6 px (chosen: finer than photos differ)
# Of a gradient's noise: above, a pixel is an edge (one of 3000 by chance), or one whose width is measured,
# where noise must not move the edge's end (chosen)
EDGE_SIGMAS, WIDTH_SIGMAS = 4.0, 10.0
CLIP_SHARE: Final = 0.98  # noise and demosaicing leave clipped pixels a little below the level (chosen)
DARK_SNR: Final = 5.0  # level over noise below which a pixel is dark: ten is half a photo of 1 % noise
SLOPE_ORDER: Final = 2  # of the polynomial that is taken off first: a sky or shading is no detail
MIN_RIDGE_PIXELS: Final = 30  # fewer do not give a width: nine of them would lie below its quantile (chosen)
WIDTH_QUANTILE: Final = 0.3  # soft edges of the scene widen the upper half of the widths (chosen)

_MARGIN = 18  # half an r-map window and the smoothing
_STRIP_PIXELS = 2_000_000  # at once, 8 MB a plane of float32: the calls cost little beside the work (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Candidate windows of one photo; every array has one entry a window along axis 0."""

    size: int  # side of every window in pixels
    rows: NDArray[np.int64]  # (n,), top-left pixels
    cols: NDArray[np.int64]
    r: NDArray[np.float64]  # (n,), field position of the centres
    phi: NDArray[np.float64]
    # (n, ORIENTATIONS), edge energy where r is high enough, over that of noise
    directions: NDArray[np.float64]
    r_mean: NDArray[np.float64]  # (n,), mean r weighted by edge energy
    r_kept: NDArray[np.float64]  # (n,), share of the energy where r is high enough
    eigenvalues: NDArray[np.float64]  # (n, 2), of the structure tensor, smaller first, over that of noise
    contrast: NDArray[np.float64]  # (n,), variance of the signal, without slopes, over that of the noise
    level: NDArray[np.float64]  # (n,), mean level and the noise's standard deviation there
    sigma: NDArray[np.float64]
    # (n,), shares of the pixels above `CLIP_SHARE`, below `DARK_SNR`, and not finite
    clipped: NDArray[np.float64]
    dark: NDArray[np.float64]
    missing: NDArray[np.float64]
    width: NDArray[np.float64]  # (n,), of the sharper edges, sigma of a Gaussian in pixels; NaN where few
    widest: NDArray[np.float64]  # (n,), the same of the widest quarter: a depth step inside shows there
    elongation: NDArray[np.float64]  # (n, 2), cosine and sine of the squared width over twice the angle

    def __len__(self) -> int:
        return int(self.rows.size)

    def take(self, index: NDArray[np.integer] | NDArray[np.bool_]) -> Windows:
        """Return the windows that `index` picks."""
        parts = {name: getattr(self, name)[index] for name in self.__slots__ if name != "size"}
        return Windows(size=self.size, **parts)


def windows_of(
    plane: Plane, frame: Frame, noise: NoiseModel, side: int, clip: float, on_step: StepHook
) -> Windows:
    """Sum over centred blocks of `side` pixels; a window of `BLOCKS_A_SIDE` of them a side starts at each."""
    height, width = plane.shape
    n, m = height // side, width // side
    row, col = (height - n * side) // 2, (width - m * side) // 2
    sample = plane[::8, ::8][np.isfinite(plane[::8, ::8])]
    white = max(float(np.percentile(sample, 99.5)), 1e-3) if sample.size else 1.0
    step = max(1, _STRIP_PIXELS // (side * width))
    strips = []
    for first in range(0, n, step):  # memory does not grow with the plane
        last = min(first + step, n)
        rows, cols = slice(row + first * side, row + last * side), slice(col, col + m * side)
        strips.append(_strip_sums(plane, rows, cols, side, noise=noise, clip=clip, white=white))
        on_step(last, n)
    histogram = np.sum([strip.pop("histogram") for strip in strips], axis=0)
    blocks = {name: np.concatenate([strip[name] for strip in strips]) for name in strips[0]}

    size, area = BLOCKS_A_SIDE * side, (BLOCKS_A_SIDE * side) ** 2
    sums = {name: _flat(_square_sum(part, BLOCKS_A_SIDE)) for name, part in blocks.items()}
    down, along = (np.arange(count - BLOCKS_A_SIDE + 1) * side for count in (n, m))
    tops, lefts = (each.ravel() for each in np.meshgrid(row + down, col + along, indexing="ij"))
    r, phi = frame.polar(tops + (size - 1) / 2.0, lefts + (size - 1) / 2.0)
    level = sums["level"] / area
    variance = sums["square"] / area - level**2 - _slope_variance(blocks["level"] / side**2, side)
    noise_variance = np.maximum(noise.variance(level), 1e-12)
    gradient_power = noise_variance * gradient_noise() ** 2
    lowest = automatic_threshold(histogram, n * m * side**2, WINDOW**2)
    kept = sums["energy"][..., lowest:].sum(axis=-1)
    by_r = sums["energy"].sum(axis=1)
    total = np.maximum(by_r.sum(axis=-1), 1e-12)
    tensor = sums["tensor"][:, [[0, 1], [1, 2]]]
    return Windows(
        size=size,
        rows=tops,
        cols=lefts,
        r=r,
        phi=phi,
        # The mean square of the modulus is twice that of a component, shared by all directions.
        directions=kept / (2.0 * gradient_power * area / ORIENTATIONS)[:, None],
        r_mean=by_r @ ((np.arange(R_BINS) + 0.5) / R_BINS) / total,
        r_kept=kept.sum(axis=-1) / total,
        eigenvalues=np.maximum(np.linalg.eigvalsh(tensor), 0.0) / (area * gradient_power)[:, None],
        contrast=(variance - noise_variance) / noise_variance,
        level=level,
        sigma=np.sqrt(noise_variance),
        clipped=sums["clipped"] / area,
        dark=sums["dark"] / area,
        missing=sums["missing"] / area,
        width=_typical_width(sums["widths"]),
        widest=_widest_quarter(blocks["widths"]),
        elongation=_elongation(*np.moveaxis(sums["squared_widths"], -1, 0)),
    )


def _strip_sums(
    plane: Plane, rows: slice, cols: slice, side: int, *, noise: NoiseModel, clip: float, white: float
) -> dict[str, NDArray[Any]]:
    """Sums over the blocks of some rows, (n, m, ...), and a histogram of their edge pixels."""
    above, below = min(_MARGIN, rows.start), min(_MARGIN, plane.shape[0] - rows.stop)
    values = np.array(plane[rows.start - above : rows.stop + below], dtype=np.float32)
    finite = np.isfinite(values)
    values[~finite] = 0.0
    smooth, along_rows, along_cols = smoothed_gradients(values)
    size = np.hypot(along_rows, along_cols)
    r = r_of_gradients(along_rows, along_cols, size, white)

    inner = (slice(above, values.shape[0] - below), cols)
    level, gr, gc, modulus = values[inner], along_rows[inner], along_cols[inner], size[inner]
    n, m = level.shape[0] // side, level.shape[1] // side
    block = np.arange(n * m, dtype=np.int32).reshape(n, m).repeat(side, 0).repeat(side, 1).ravel()

    def block_sum(what: NDArray[np.generic]) -> NDArray[np.float64]:
        return what.reshape(n, side, m, side).sum(axis=(1, 3), dtype=np.float64)

    def by_bin(
        at: NDArray[np.intp], bins: NDArray[np.intp] | int, count: int, weights: Plane | None = None
    ) -> NDArray[Any]:
        return np.bincount(block[at] * count + bins, weights, n * m * count).reshape(n, m, count)

    sigma = np.sqrt(noise.variance(smooth[inner]))
    unit = sigma.astype(np.float32) * np.float32(gradient_noise())
    edges = np.flatnonzero(modulus > EDGE_SIGMAS * unit)
    gr_at, gc_at = gr.ravel()[edges], gc.ravel()[edges]
    orientation, r_bins = _orientation(gr_at, gc_at), r_bin(r[inner].ravel()[edges])
    energy = by_bin(edges, orientation * R_BINS + r_bins, ORIENTATIONS * R_BINS, modulus.ravel()[edges] ** 2)
    tensor = [by_bin(edges, 0, 1, product) for product in (gr_at * gr_at, gr_at * gc_at, gc_at * gc_at)]
    groups = orientation // (ORIENTATIONS // GROUPS) * R_BINS + r_bins

    ridges = np.flatnonzero(_ridge(along_rows, along_cols, size)[inner] & (modulus > WIDTH_SIGMAS * unit))
    square = _squared_widths(smooth, inner, modulus, ridges)
    across = _orientation(gr.ravel()[ridges], gc.ravel()[ridges])
    squared_widths = [by_bin(ridges, across, ORIENTATIONS, weights) for weights in (None, square)]
    return {
        "energy": energy.reshape(n, m, ORIENTATIONS, R_BINS).astype(np.float32),
        "tensor": np.concatenate(tensor, axis=2),
        "level": block_sum(level),
        "square": block_sum(np.square(level, dtype=np.float64)),
        "clipped": block_sum(level >= CLIP_SHARE * clip),
        "dark": block_sum(smooth[inner] < DARK_SNR * sigma),
        "missing": block_sum(~finite[inner]),
        "widths": by_bin(ridges, (np.sqrt(square) / WIDTH_STEP_PX).astype(np.intp), WIDTH_BINS),
        "squared_widths": np.stack(squared_widths, axis=-1),  # by direction: how many, and their sum
        "histogram": np.bincount(groups, minlength=GROUPS * R_BINS).reshape(GROUPS, R_BINS),
    }


def _ridge(along_rows: Plane, along_cols: Plane, modulus: Plane) -> NDArray[np.bool_]:
    """Where no neighbour across the edge is steeper; the rim has one neighbour only and is let through."""
    center, inside = modulus[1:-1, 1:-1], (slice(1, -1), slice(1, -1))
    ridge = np.ones(modulus.shape, dtype=np.bool_)
    ridge[inside] = np.where(
        np.abs(along_rows[inside]) > np.abs(along_cols[inside]),
        (center >= modulus[:-2, 1:-1]) & (center >= modulus[2:, 1:-1]),
        (center >= modulus[1:-1, :-2]) & (center >= modulus[1:-1, 2:]),
    )
    return ridge


def _squared_widths(
    smooth: Plane, inner: tuple[slice, slice], modulus: Plane, at: NDArray[np.intp]
) -> NDArray[np.float32]:
    """Squared width of the blur at pixels `at` on edge ridges, by the ratio R of gradients before and after.

    A step blurred by s is smoothed by 1 px, then by 1 px more::

        R² = (s² + 2) / (s² + 1),        s² = 1 / (R² - 1) - 1

    Source: S. Zhuo and T. Sim, "Defocus map estimation from a single image", Pattern Recognition 44, 2011,
    eq. (3) to (5).
    """
    again = np.asarray(ndimage.gaussian_filter(smooth, 1.0, truncate=3.0), dtype=np.float32)
    second = np.hypot(*(np.asarray(part)[inner] for part in np.gradient(again)))
    excess = np.square(modulus.ravel()[at] / np.maximum(second.ravel()[at], 1e-12)) - 1.0
    square = 1.0 / np.maximum(excess, 1e-3) - 1.0
    return np.clip(square, 0.0, (WIDTH_BINS * WIDTH_STEP_PX) ** 2 - 1e-3)


def _orientation(along_rows: NDArray[np.float32], along_cols: NDArray[np.float32]) -> NDArray[np.intp]:
    """Bin of the gradient's direction over half a turn, 0 = along columns, growing downwards."""
    angle = np.arctan2(along_rows, along_cols) * (ORIENTATIONS / np.pi)
    return np.floor(angle + 0.5).astype(np.intp) % ORIENTATIONS


def _square_sum(values: NDArray[np.generic], side: int) -> NDArray[np.float64]:
    """Sum of every square of `side` blocks, `(n, m, ...)` to `(n - side + 1, m - side + 1, ...)`."""
    out = np.asarray(values, dtype=np.float64)
    for axis in (0, 1):
        out = sliding_window_view(out, side, axis=axis).sum(axis=-1)
    return out


def _flat(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return values.reshape(-1, *values.shape[2:])


def _slope_variance(means: NDArray[np.float64], side: int) -> NDArray[np.float64]:
    """Variance of the polynomial of order `SLOPE_ORDER` that fits the means of a window's blocks.

    With M the polynomials without the constant averaged over blocks, G their covariance over the pixels and
    m the 16 means, c = M^+ m and the variance is c' G c.
    """
    basis = np.stack([part - part.mean() for part in _polynomials(BLOCKS_A_SIDE * side)[1:]])
    count, pixels = len(basis), basis[0].size
    averaged = basis.reshape(count, BLOCKS_A_SIDE, side, BLOCKS_A_SIDE, side).mean(axis=(2, 4))
    covariance = basis.reshape(count, -1) @ basis.reshape(count, -1).T / pixels
    sixteen = sliding_window_view(means, (BLOCKS_A_SIDE, BLOCKS_A_SIDE)).reshape(-1, BLOCKS_A_SIDE**2)
    fit = sixteen @ np.linalg.pinv(averaged.reshape(count, -1).T).T
    return np.asarray(np.einsum("ni,ij,nj->n", fit, covariance, fit))


def _polynomials(size: int) -> NDArray[np.float64]:
    """Polynomials up to `SLOPE_ORDER` over a window, the constant first, shape (count, size, size)."""
    t = np.linspace(-1.0, 1.0, size)
    orders = range(SLOPE_ORDER + 1)
    return np.stack([np.outer(t**i, t**j) for i in orders for j in orders if i + j <= SLOPE_ORDER])


def _typical_width(histogram: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quantile of binned widths, linear inside its bin."""
    total = histogram.sum(axis=1)
    below = histogram.cumsum(axis=1)
    at = np.minimum((below < WIDTH_QUANTILE * total[:, None]).sum(axis=1), WIDTH_BINS - 1)
    pick = np.arange(len(total))
    inside = np.maximum(histogram[pick, at], 1.0)
    part = 1.0 - (below[pick, at] - WIDTH_QUANTILE * total) / inside
    return np.where(total >= MIN_RIDGE_PIXELS, (at + np.clip(part, 0.0, 1.0)) * WIDTH_STEP_PX, np.nan)


def _widest_quarter(histograms: NDArray[np.int64]) -> NDArray[np.float64]:
    half = BLOCKS_A_SIDE // 2
    sums = _square_sum(histograms, half)
    n, m = sums.shape[0] - half, sums.shape[1] - half
    quarters = [sums[i : i + n, j : j + m] for i in (0, half) for j in (0, half)]
    return np.fmax.reduce([_typical_width(_flat(part)) for part in quarters])


def _elongation(count: NDArray[np.float64], square: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fit s² = a (1 + c cos 2t + s sin 2t) to the mean squared widths by direction."""
    angle = 2.0 * np.pi * np.arange(ORIENTATIONS) / ORIENTATIONS
    basis = np.stack([np.ones(ORIENTATIONS), np.cos(angle), np.sin(angle)], axis=1)
    # Directions weigh equally up to 20 pixels, so that one long edge does not decide alone.
    weight = np.minimum(count, 20.0)
    mean = square / np.maximum(count, 1.0)
    normal = np.einsum("nd,di,dj->nij", weight, basis, basis) + 1e-3 * np.eye(3)
    fit = np.linalg.solve(normal, np.einsum("nd,nd,di->ni", weight, mean, basis)[..., None])[..., 0]
    known = ((count >= 5.0).sum(axis=1) >= ORIENTATIONS // 2) & (fit[:, 0] > 1e-3)
    relative = fit[:, 1:] / np.maximum(fit[:, :1], 1e-3)
    relative /= np.maximum(np.hypot(*relative.T), 1.0)[:, None]
    return np.where(known[:, None], relative, 0.0)


# --- the second look -----------------------------------------------------------------------------

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


class Details(NamedTuple):
    """Second look at some windows; every array has one entry a window along axis 0."""

    information: NDArray[np.float64]  # (n, BANDS, SECTORS), natural logarithm of mean power over noise
    period: NDArray[np.float64]  # (n,), highest separate peak of the autocorrelation, 1 for a perfect period
    blockiness: NDArray[np.float64]  # (n,), steps on an 8 px grid over steps off it; 1 where there is none
    blob: NDArray[np.int64]  # (n,), pixels of the largest connected clipped area
    kurtosis: NDArray[np.float64]  # (n,), of differences; 3 for a Gaussian, more for isolated edges
    evidence: NDArray[np.float64]  # (n,), bits a frequency between 0.1 and 0.4 cycles/pixel; 0 for noise


def details_of(plane: Plane, windows: Windows, clip: float, coarse: NoiseModel | None = None) -> Details:
    """Look at windows of a plane; `coarse` is the noise between 0.1 and 0.4 cycles/pixel where it is more."""
    size = windows.size
    slopes = np.linalg.qr(_polynomials(size).reshape(-1, size * size).T)[0]
    hann = np.outer(*[np.hanning(size + 2)[1:-1]] * 2)
    taper = _correlation(np.square(np.abs(fft.rfft2(hann))), hann.shape)  # takes weight from long lags
    bands, evident = (_sectors(size, edges) for edges in (BAND_EDGES, EVIDENCE_EDGES))
    square = np.square(2.0 * np.pi * np.hypot(fft.fftfreq(size)[:, None], fft.rfftfreq(size)))
    of_gradients = square * np.exp(-2.0 * square)  # smoothed ones
    fine = np.square(windows.sigma)
    noise = fine if coarse is None else np.maximum(fine, coarse.variance(windows.level))
    rows = []
    for i, corner in enumerate(zip(windows.rows.tolist(), windows.cols.tolist(), strict=True)):
        values = np.array(plane[corner[0] :, corner[1] :][:size, :size], dtype=np.float64)
        detrended = (values.ravel() - slopes @ (values.ravel() @ slopes)).reshape(values.shape)
        # periodogram under a Hann window, scaled so that white noise gives its variance
        power = np.square(np.abs(fft.rfft2(detrended * hann))) / np.square(hann).sum()
        information = np.log(np.maximum(_means(power, bands)[0] / max(fine[i], 1e-12), 1e-3))
        gradients = _correlation(np.maximum(power - fine[i], 0.0) * of_gradients, hann.shape) / taper
        areas = ndimage.label(values >= CLIP_SHARE * clip)[0]
        squares = np.concatenate([np.diff(values, axis=axis).ravel() for axis in (0, 1)]) ** 2
        least = noise[i] + (NON_UNIFORMITY * values.mean()) ** 2 + (clip / DYNAMIC_RANGE) ** 2
        rows.append(
            (
                information.reshape(BANDS, SECTORS),
                1.0 if repeats(values) else _period(gradients),
                _blockiness(values, corner),
                np.bincount(areas.ravel())[1:].max(initial=0),
                np.mean(squares**2) / max(np.mean(squares) ** 2, 1e-30),
                _evidence(power, evident, least),
            )
        )
    return Details(*(np.array(column) for column in zip(*rows, strict=True)))


def _sectors(size: int, edges: tuple[float, ...]) -> NDArray[np.intp]:
    """Number of the band and sector of every frequency of `rfft2`, -1 outside."""
    fr, fc = fft.fftfreq(size)[:, None], fft.rfftfreq(size)[None, :]
    sector = np.floor(np.arctan2(fr, fc) * (SECTORS / np.pi) + 0.5).astype(np.intp) % SECTORS
    band = np.searchsorted(edges, np.hypot(fr, fc), side="right") - 1
    # Of the column fc = 0 the half spectrum holds both halves: one of them must not count.
    inside = (band >= 0) & (band < len(edges) - 1) & ((fc > 0.0) | (fr > 0.0))
    return np.where(inside, band * SECTORS + sector, -1)


def _means(
    power: NDArray[np.float64], number: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Mean power of each band and sector, and how many frequencies each holds."""
    inside = number >= 0
    count = np.bincount(number[inside])
    return np.bincount(number[inside], power[inside]) / np.maximum(count, 1), count


def _evidence(power: NDArray[np.float64], number: NDArray[np.intp], noise: float) -> float:
    """Bits a frequency: mean of log2(1 + max(P / N - 1, 0)) over the bands and sectors that blur empties.

    Source: C. E. Shannon, "Communication in the presence of noise", Proc. IRE 37, 1949.
    """
    mean, count = _means(power, number)
    signal = np.maximum(mean / max(noise, 1e-30) - 1.0, 0.0)
    return float(np.log2(1.0 + signal) @ count / count.sum())


def _correlation(power: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Autocorrelation of what has a power spectrum, at lags up to a third of the side, 1 in the middle."""
    reach = min(shape) // 3
    near = tuple(slice(n // 2 - reach, n // 2 + reach + 1) for n in shape)
    correlation = fft.fftshift(fft.irfft2(power, s=shape))[near]
    return np.asarray(correlation / max(float(correlation[reach, reach]), 1e-300))


@lru_cache(maxsize=4)  # it takes a sixteenth of the second look
def _lags(reach: int) -> NDArray[np.float64]:
    """Distance in pixels of the lags of `_correlation` from the middle."""
    t = np.arange(-reach, reach + 1)
    return np.hypot(t[:, None], t)


def repeats(patch: NDArray[np.floating]) -> bool:
    """Whether the autocorrelation of a patch falls far below zero and comes back nearly to one: a fence."""
    waves = fft.rfft2((patch - patch.mean()).astype(np.float64))
    correlation = _correlation(np.square(np.abs(waves)), patch.shape)
    reach = min(patch.shape) // 3
    lag = _lags(reach)
    valley, peak = (correlation[(lag > core) & (lag < reach)] for core in _CORE_PX)
    return bool(valley.min() < _REPEATS[0] and peak.max() > _REPEATS[1])


def _period(correlation: NDArray[np.float64]) -> float:
    """Highest peak of an autocorrelation that a valley of half its height parts from the middle."""
    reach = len(correlation) // 2
    highest = (correlation == ndimage.maximum_filter(correlation, 3)) & (correlation > 0.0)
    peaks = np.argwhere(highest & (_lags(reach) >= _MAIN_LOBE_PX))
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
    for start, turned in zip(corner, (values, values.T), strict=True):
        d = np.abs(np.diff(turned, axis=0))
        excess = np.abs(d[1:-1] - 0.5 * (d[:-2] + d[2:])).mean(axis=1)
        # Entry i belongs to the line between pixels i + 1 and i + 2 of the window.
        phase = (np.arange(excess.size) + 2 + start) % _JPEG_BLOCK
        by_phase = np.array([excess[phase == k].mean() for k in range(_JPEG_BLOCK)])
        ratios.append(by_phase[0] / max(float(np.median(by_phase[1:])), 1e-12))
    return float(np.mean(ratios))
