"""The windows of a photo: what is known of each candidate, as arrays.

One pass over a plane sums over small blocks, from which any window is put together (`windows_of`). The
spectra of a few are then looked at by themselves (`details_of`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.types import Frame, NoiseModel, Plane, StepHook
from lensmodel.patches.rmap import (
    GROUPS,
    R_BINS,
    WINDOW,
    automatic_threshold,
    gradient_noise,
    r_of_gradients,
    smoothed_gradients,
)

# --- the first look ------------------------------------------------------------------------------

ORIENTATIONS: Final = 8  # bins of gradient direction over half a turn, with edges enough in each (chosen)
BLOCKS_A_SIDE: Final = 4  # of a window, which starts at any: finer starts find nearly the same ones (chosen)
EDGE_SIGMAS: Final = 4.0  # of a gradient's noise: above, a pixel is an edge (one of 3000 by chance)
CLIP_SHARE: Final = 0.98  # noise and demosaicing leave clipped pixels a little below the level (chosen)
DARK_SNR: Final = 5.0  # level over noise below which a pixel is dark: ten is half a photo of 1 % noise
SECTORS: Final = 8  # of 22.5 degrees: a line lies in one or two
BAND_EDGES: Final = (0.03, 0.1, 0.2, 0.35)  # cycles/pixel (chosen): coarse, middle and fine detail
BANDS: Final = len(BAND_EDGES) - 1  # the intervals between them
SLOPE_ORDER: Final = 2  # of the polynomial that is taken off first: a sky or shading is no detail

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
    # (n,), shares of the pixels above `CLIP_SHARE` and below `DARK_SNR`
    clipped: NDArray[np.float64]
    dark: NDArray[np.float64]
    # what `details_of` finds: (n, BANDS, SECTORS), natural logarithm of mean power over noise
    information: NDArray[np.float64]
    # (n,), bits a frequency, log2(1 + signal / noise), in the bands that blur takes away, all but the first;
    # 0 for noise: C. E. Shannon, "Communication in the presence of noise", Proc. IRE 37, 1949
    evidence: NDArray[np.float64]

    def __len__(self) -> int:
        return int(self.rows.size)

    def take(self, index: NDArray[np.integer] | NDArray[np.bool_]) -> Windows:
        """Return the windows that `index` picks."""
        parts = {name: getattr(self, name)[index] for name in self.__slots__ if name != "size"}
        return Windows(size=self.size, **parts)


def windows_of(plane: Plane, noise: NoiseModel, side: int, clip: float, on_step: StepHook) -> Windows:
    """Sum over centred blocks of `side` pixels; a window of `BLOCKS_A_SIDE` of them a side starts at each."""
    height, width = plane.shape
    n, m = height // side, width // side
    row, col = (height - n * side) // 2, (width - m * side) // 2
    white = max(float(np.percentile(plane[::8, ::8], 99.5)), 1e-3)
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
    sums = {name: _square_sum(part, BLOCKS_A_SIDE) for name, part in blocks.items()}
    down, along = (np.arange(count - BLOCKS_A_SIDE + 1) * side for count in (n, m))
    tops, lefts = (each.ravel() for each in np.meshgrid(row + down, col + along, indexing="ij"))
    r, phi = Frame(*plane.shape).polar(tops + (size - 1) / 2.0, lefts + (size - 1) / 2.0)
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
        information=np.zeros((tops.size, BANDS, SECTORS)),
        evidence=np.zeros(tops.size),
    )


def _strip_sums(
    plane: Plane, rows: slice, cols: slice, side: int, *, noise: NoiseModel, clip: float, white: float
) -> dict[str, NDArray[Any]]:
    """Sums over the blocks of some rows, (n, m, ...), and a histogram of their edge pixels."""
    above, below = min(_MARGIN, rows.start), min(_MARGIN, plane.shape[0] - rows.stop)
    values = np.array(plane[rows.start - above : rows.stop + below], dtype=np.float32)
    smooth, along_rows, along_cols = smoothed_gradients(values)
    size = np.hypot(along_rows, along_cols)
    r = r_of_gradients(along_rows, along_cols, size, white)

    inner = (slice(above, values.shape[0] - below), cols)
    level, gr, gc, modulus = values[inner], along_rows[inner], along_cols[inner], size[inner]
    n, m = level.shape[0] // side, level.shape[1] // side
    block = np.arange(n * m, dtype=np.int32).reshape(n, m).repeat(side, 0).repeat(side, 1).ravel()

    def block_sum(what: NDArray[np.generic]) -> NDArray[np.float64]:
        return what.reshape(n, side, m, side).sum(axis=(1, 3), dtype=np.float64)

    sigma = np.sqrt(noise.variance(smooth[inner]))
    unit = sigma.astype(np.float32) * np.float32(gradient_noise())
    edges = np.flatnonzero(modulus > EDGE_SIGMAS * unit)
    gr_at, gc_at = gr.ravel()[edges], gc.ravel()[edges]
    turn = np.arctan2(gr_at, gc_at) * (ORIENTATIONS / np.pi)  # 0 is along columns, growing downwards
    orientation = np.floor(turn + 0.5).astype(np.intp) % ORIENTATIONS
    r_bins = np.minimum((r[inner].ravel()[edges] * R_BINS).astype(np.intp), R_BINS - 1)

    def by_bin(bins: NDArray[np.intp] | int, count: int, weights: NDArray[np.float32]) -> NDArray[Any]:
        return np.bincount(block[edges] * count + bins, weights, n * m * count).reshape(n, m, count)

    energy = by_bin(orientation * R_BINS + r_bins, ORIENTATIONS * R_BINS, modulus.ravel()[edges] ** 2)
    tensor = [by_bin(0, 1, product) for product in (gr_at * gr_at, gr_at * gc_at, gc_at * gc_at)]
    groups = orientation // (ORIENTATIONS // GROUPS) * R_BINS + r_bins
    return {
        "energy": energy.reshape(n, m, ORIENTATIONS, R_BINS).astype(np.float32),
        "tensor": np.concatenate(tensor, axis=2),
        "level": block_sum(level),
        "square": block_sum(np.square(level, dtype=np.float64)),
        "clipped": block_sum(level >= CLIP_SHARE * clip),
        "dark": block_sum(smooth[inner] < DARK_SNR * sigma),
        "histogram": np.bincount(groups, minlength=GROUPS * R_BINS).reshape(GROUPS, R_BINS),
    }


def _square_sum(values: NDArray[np.generic], side: int) -> NDArray[np.float64]:
    """Sum of every square of `side` blocks, `(n, m, ...)` to `((n - side + 1) (m - side + 1), ...)`."""
    out = np.asarray(values, dtype=np.float64)
    for axis in (0, 1):
        out = sliding_window_view(out, side, axis=axis).sum(axis=-1)
    return out.reshape(-1, *out.shape[2:])


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


# --- the second look -----------------------------------------------------------------------------

NON_UNIFORMITY: Final = 0.005  # relative deviation of the gain of pixels: 0.3 to 1 percent by EMVA 1288
DYNAMIC_RANGE: Final = 2.0**14.8  # of the best sensors: less noise was eaten by rounding or denoising


def details_of(plane: Plane, windows: Windows, clip: float, coarse: NoiseModel | None = None) -> Windows:
    """Look at windows of a plane; `coarse` is that of coarse detail where it is more."""
    size = windows.size
    slopes = np.linalg.qr(_polynomials(size).reshape(-1, size * size).T)[0]
    fr, fc = fft.fftfreq(size)[:, None], fft.rfftfreq(size)[None, :]
    sector = np.floor(np.arctan2(fr, fc) * (SECTORS / np.pi) + 0.5).astype(np.intp) % SECTORS
    band = np.searchsorted(BAND_EDGES, np.hypot(fr, fc), side="right") - 1
    # Of the column fc = 0 the half spectrum holds both halves: one of them must not count.
    inside = (band >= 0) & (band < BANDS) & ((fc > 0.0) | (fr > 0.0))
    number = (band * SECTORS + sector)[inside]
    count = np.bincount(number, minlength=BANDS * SECTORS).reshape(BANDS, SECTORS)
    fine = np.square(windows.sigma)
    noise = fine if coarse is None else np.maximum(fine, coarse.variance(windows.level))
    information, evidence = windows.information.copy(), windows.evidence.copy()
    for i, corner in enumerate(zip(windows.rows.tolist(), windows.cols.tolist(), strict=True)):
        values = np.array(plane[corner[0] :, corner[1] :][:size, :size], dtype=np.float64)
        detrended = (values.ravel() - slopes @ (values.ravel() @ slopes)).reshape(values.shape)
        power = np.bincount(number, periodogram(detrended)[inside], count.size).reshape(count.shape)
        mean = power / np.maximum(count, 1)
        information[i] = np.log(np.maximum(mean / max(fine[i], 1e-12), 1e-3))
        least = noise[i] + (NON_UNIFORMITY * values.mean()) ** 2 + (clip / DYNAMIC_RANGE) ** 2
        bits = np.log2(1.0 + np.maximum(mean[1:] / max(least, 1e-30) - 1.0, 0.0))
        evidence[i] = np.average(bits, weights=count[1:])
    return replace(windows, information=information, evidence=evidence)


def periodogram(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Power at the frequencies of `rfft2` under a Hann window, by which white noise has its variance."""
    hann = np.outer(*(np.hanning(n + 2)[1:-1] for n in values.shape))
    return np.square(np.abs(fft.rfft2(values * hann))) / np.square(hann).sum()
