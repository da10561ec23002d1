"""The windows of a photo: what is known of each candidate, as arrays, and which were chosen.

One pass over a plane sums over small blocks, from which any window is put together (`Windows`). A few are
then looked at by themselves (`Details`): their spectrum, periods, blocks and blobs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from lensmodel.core.types import FieldPosition, Frame, NoiseModel, Plane, StepHook
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

Reason: TypeAlias = Literal[
    "border", "clipped", "dark", "flat", "one-directional", "periodic", "jpeg-blocks", "duplicate"
]
"""Why a window was not taken; `duplicate` means that a better one lies too near or the quota is full."""

MAX_REJECTIONS: Final = 2000  # a photo has ten thousand windows; a report needs no more than this


@dataclass(frozen=True, slots=True)
class Patch:
    """A window of a photo that tells about the PSF."""

    row: int  # top-left pixel
    col: int
    size: int  # side in pixels
    position: FieldPosition  # of the window's centre
    score: float  # how much it tells, 0 to 1
    cell: int  # number of the field cell; patches of one cell may share one kernel


@dataclass(frozen=True, slots=True)
class Rejection:
    """A window that was not taken, and why."""

    row: int
    col: int
    size: int
    reason: Reason


@dataclass(frozen=True, slots=True)
class Selection:
    """The outcome of patch selection on one plane."""

    patches: tuple[Patch, ...]  # ordered by cell, the best of each cell first
    # at most `MAX_REJECTIONS` of them, spread evenly over the photo and the reasons
    rejected: tuple[Rejection, ...]


ORIENTATIONS: Final = 8  # bins of gradient direction over half a turn, with edges enough in each (chosen)
BLOCKS_A_SIDE: Final = 4  # of a window, which starts at any: finer starts find nearly the same ones (chosen)
WIDTH_BINS: Final = 28
WIDTH_STEP_PX: Final = 0.2  # of a histogram of edge widths, 0 to 5.6 px (chosen: finer than photos differ)
EDGE_SIGMAS: Final = (
    4.0  # of a gradient's noise, above which a pixel is an edge: one of 3000 by chance (chosen)
)
WIDTH_SIGMAS: Final = (
    10.0  # the same where a width is measured: noise must not move where an edge ends (chosen)
)
CLIP_SHARE: Final = 0.98  # noise and demosaicing leave clipped pixels a little below the level (chosen)
DARK_SNR: Final = 5.0  # level over noise below which a pixel is dark: ten is half a photo of 1 % noise

_MARGIN = 18  # half an r-map window and the smoothing
_STRIP_PIXELS = 2_000_000  # at once, 8 MB a plane of float32: the calls cost little beside the work (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class BlockSums:
    """Sums over blocks; every array but the last starts with axes (block row, block column)."""

    side: int  # side of a block in pixels
    row: int  # top-left pixel of block (0, 0)
    col: int
    energy: NDArray[np.float32]  # (n, m, ORIENTATIONS, R_BINS), squared modulus of the edge gradients
    tensor: NDArray[np.float64]  # (n, m, 3), structure tensor of the edge gradients: rr, rc, cc
    level: NDArray[np.float64]  # (n, m), sums of the values and of their squares
    square: NDArray[np.float64]
    clipped: NDArray[np.float64]  # (n, m), pixels above `CLIP_SHARE`, below `DARK_SNR`, and not finite
    dark: NDArray[np.float64]
    missing: NDArray[np.float64]
    widths: NDArray[np.int64]  # (n, m, WIDTH_BINS), histogram of local edge widths
    width_sums: NDArray[np.float64]  # (n, m, ORIENTATIONS, 2), count and sum of squared widths by direction
    histogram: NDArray[np.int64]  # (GROUPS, R_BINS), edge pixels of the whole plane


def intensity_scale(plane: Plane) -> float:
    """Level that counts as white: the 99.5 percentile of every eighth pixel, never below 1e-3."""
    sample = np.asarray(plane[::8, ::8])
    sample = sample[np.isfinite(sample)]
    return max(float(np.percentile(sample, 99.5)), 1e-3) if sample.size else 1.0


def measure_blocks(plane: Plane, noise: NoiseModel, side: int, clip: float, on_step: StepHook) -> BlockSums:
    """Sum over whole blocks of `side` pixels, centred, in strips: memory does not grow with the plane."""
    height, width = plane.shape
    n, m = height // side, width // side
    row, col = (height - n * side) // 2, (width - m * side) // 2
    cols, scale = slice(col, col + m * side), intensity_scale(plane)
    step = max(1, _STRIP_PIXELS // (side * width))
    strips = []
    for first in range(0, n, step):
        last = min(first + step, n)
        rows = slice(row + first * side, row + last * side)
        strips.append(_strip_sums(plane, rows, cols, side, noise=noise, clip=clip, scale=scale))
        on_step(last, n)
    histogram = sum(strip.pop("histogram") for strip in strips)
    joined = {name: np.concatenate([strip[name] for strip in strips]) for name in strips[0]}
    return BlockSums(side, row, col, **joined, histogram=np.asarray(histogram))


def _strip_sums(
    plane: Plane, rows: slice, cols: slice, side: int, *, noise: NoiseModel, clip: float, scale: float
) -> dict[str, NDArray[Any]]:
    """Sums over the blocks of some rows, by the names of `BlockSums`."""
    above, below = min(_MARGIN, rows.start), min(_MARGIN, plane.shape[0] - rows.stop)
    values = np.array(plane[rows.start - above : rows.stop + below], dtype=np.float32)
    finite = np.isfinite(values)
    values[~finite] = 0.0
    smooth, along_rows, along_cols = smoothed_gradients(values)
    size = np.hypot(along_rows, along_cols)
    r = r_of_gradients(along_rows, along_cols, size, scale)

    inner = (slice(above, values.shape[0] - below), cols)
    level, gr, gc, modulus = values[inner], along_rows[inner], along_cols[inner], size[inner]
    n, m = level.shape[0] // side, level.shape[1] // side

    def block_sum(what: NDArray[np.generic]) -> NDArray[np.float64]:
        return what.reshape(n, side, m, side).sum(axis=(1, 3), dtype=np.float64)

    def by_bin(
        at: NDArray[np.intp], bins: NDArray[np.intp], count: int, weights: Plane | None = None
    ) -> NDArray[Any]:
        row, col = np.divmod(at, m * side)
        number = (row // side) * m + col // side
        return np.bincount(number * count + bins, weights, n * m * count).reshape(n, m, count)

    unit = np.sqrt(noise.variance(smooth[inner])).astype(np.float32) * np.float32(gradient_noise(1.0))
    edges = np.flatnonzero(modulus > EDGE_SIGMAS * unit)
    gr_at, gc_at = gr.ravel()[edges], gc.ravel()[edges]
    orientation, r_bins = _orientation(gr_at, gc_at), r_bin(r[inner].ravel()[edges])
    energy = by_bin(edges, orientation * R_BINS + r_bins, ORIENTATIONS * R_BINS, modulus.ravel()[edges] ** 2)
    groups = orientation // (ORIENTATIONS // GROUPS) * R_BINS + r_bins
    products = (gr_at * gr_at, gr_at * gc_at, gc_at * gc_at)
    none = np.zeros_like(edges)

    ridges = np.flatnonzero(_ridge(along_rows, along_cols, size)[inner] & (modulus > WIDTH_SIGMAS * unit))
    square = _squared_widths(smooth, inner, modulus, ridges)
    bins = (np.sqrt(square) / WIDTH_STEP_PX).astype(np.intp)
    across = _orientation(gr.ravel()[ridges], gc.ravel()[ridges])
    return {
        "energy": energy.reshape(n, m, ORIENTATIONS, R_BINS).astype(np.float32),
        "tensor": np.concatenate([by_bin(edges, none, 1, product) for product in products], axis=2),
        "level": block_sum(level),
        "square": block_sum(np.square(level, dtype=np.float64)),
        "clipped": block_sum(level >= CLIP_SHARE * clip),
        "dark": block_sum(smooth[inner] < _level_of_snr(noise, DARK_SNR)),
        "missing": block_sum(~finite[inner]),
        "widths": by_bin(ridges, bins, WIDTH_BINS),
        "width_sums": np.stack(
            [by_bin(ridges, across, ORIENTATIONS, weights) for weights in (None, square)], axis=-1
        ),
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


def _level_of_snr(noise: NoiseModel, snr: float) -> float:
    """Level whose ratio to its noise is `snr`: the positive root of l² = snr² (shot l + read)."""
    half = 0.5 * snr * snr * noise.shot
    return half + float(np.sqrt(half * half + snr * snr * noise.read))


SLOPE_ORDER: Final = 2  # of the polynomial that is taken off first: a sky or shading is no detail
MIN_RIDGE_PIXELS: Final = 30  # fewer do not give a width: nine of them would lie below its quantile (chosen)
WIDTH_QUANTILE: Final = 0.3  # soft edges of the scene widen the upper half of the widths (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Candidate windows of one photo; every array has one entry a window along axis 0."""

    size: int  # side of every window in pixels
    rows: NDArray[np.int64]  # (n,), top-left pixels
    cols: NDArray[np.int64]
    r: NDArray[np.float64]  # (n,), field position of the centres
    phi: NDArray[np.float64]
    directions: NDArray[
        np.float64
    ]  # (n, ORIENTATIONS), edge energy where r is high enough, over that of noise
    r_mean: NDArray[np.float64]  # (n,), mean r weighted by edge energy
    r_kept: NDArray[np.float64]  # (n,), share of the energy where r is high enough
    eigenvalues: NDArray[np.float64]  # (n, 2), of the structure tensor, smaller first, over that of noise
    contrast: NDArray[np.float64]  # (n,), variance of the signal, without slopes, over that of the noise
    level: NDArray[np.float64]  # (n,), mean level and the noise's standard deviation there
    sigma: NDArray[np.float64]
    clipped: NDArray[np.float64]  # (n,), shares of the pixels
    dark: NDArray[np.float64]
    missing: NDArray[np.float64]
    width: NDArray[np.float64]  # (n,), of the sharper edges, sigma of a Gaussian in pixels; NaN where few
    widest: NDArray[np.float64]  # (n,), the same of the widest quarter: a depth step inside shows there
    elongation: NDArray[np.float64]  # (n, 2), cosine and sine of the squared width over twice the angle

    def __len__(self) -> int:
        return int(self.rows.size)

    def take(self, index: NDArray[np.integer] | NDArray[np.bool_]) -> Windows:
        """Return the windows that `index` picks."""
        parts = {name: getattr(self, name) for name in self.__slots__ if name != "size"}
        return Windows(size=self.size, **{name: part[index] for name, part in parts.items()})


def windows_of(blocks: BlockSums, frame: Frame, noise: NoiseModel) -> Windows:
    """Put the windows together from block sums; windows start at every block."""
    size = blocks.side * BLOCKS_A_SIDE
    area = size * size
    level = _window_sum(blocks.level) / area
    variance = _window_sum(blocks.square) / area - level**2 - _slope_variance(blocks)
    noise_variance = np.maximum(noise.variance(level), 1e-12)
    gradient_power = noise_variance * gradient_noise(1.0) ** 2
    energy = _window_sum(blocks.energy)
    lowest = automatic_threshold(blocks.histogram, blocks.level.size * blocks.side**2, WINDOW**2)
    kept = energy[..., lowest:].sum(axis=-1)
    by_r = energy.sum(axis=1)
    total = np.maximum(by_r.sum(axis=-1), 1e-12)
    down, along = (np.arange(count - BLOCKS_A_SIDE + 1) for count in blocks.level.shape)
    rows = blocks.row + np.repeat(down, along.size) * blocks.side
    cols = blocks.col + np.tile(along, down.size) * blocks.side
    half = (size - 1) / 2.0
    r, phi = frame.polar(rows + half, cols + half)
    return Windows(
        size=size,
        rows=rows,
        cols=cols,
        r=r,
        phi=phi,
        # The mean square of the modulus is twice that of a component, shared by all directions.
        directions=kept / (2.0 * gradient_power * area / ORIENTATIONS)[:, None],
        r_mean=by_r @ ((np.arange(R_BINS) + 0.5) / R_BINS) / total,
        r_kept=kept.sum(axis=-1) / total,
        eigenvalues=_eigenvalues(_window_sum(blocks.tensor)) / (area * gradient_power)[:, None],
        contrast=(variance - noise_variance) / noise_variance,
        level=level,
        sigma=np.sqrt(noise_variance),
        clipped=_window_sum(blocks.clipped) / area,
        dark=_window_sum(blocks.dark) / area,
        missing=_window_sum(blocks.missing) / area,
        width=_typical_width(_window_sum(blocks.widths)),
        widest=_widest_quarter(blocks.widths),
        elongation=_elongation(_window_sum(blocks.width_sums)),
    )


def _square_sum(values: NDArray[np.generic], side: int) -> NDArray[np.float64]:
    """Sum of every square of `side` blocks, `(n, m, ...)` to `(n - side + 1, m - side + 1, ...)`."""
    out = np.asarray(values, dtype=np.float64)
    for axis in (0, 1):
        out = np.lib.stride_tricks.sliding_window_view(out, side, axis=axis).sum(axis=-1)
    return out


def _window_sum(values: NDArray[np.generic]) -> NDArray[np.float64]:
    """Sum over every window, windows flattened: `(n, m, ...)` to `(windows, ...)`."""
    out = _square_sum(values, BLOCKS_A_SIDE)
    return out.reshape(-1, *out.shape[2:])


def _slope_variance(blocks: BlockSums) -> NDArray[np.float64]:
    """Variance of the polynomial of order `SLOPE_ORDER` that fits the means of a window's blocks.

    With M the polynomials without the constant averaged over blocks, G their covariance over the pixels and
    m the 16 means, c = M^+ m and the variance is c' G c.
    """
    averaged, covariance = _slopes(blocks.side)
    means = np.asarray(blocks.level, dtype=np.float64) / blocks.side**2
    view = np.lib.stride_tricks.sliding_window_view(means, (BLOCKS_A_SIDE, BLOCKS_A_SIDE))
    fit = view.reshape(-1, BLOCKS_A_SIDE**2) @ np.linalg.pinv(averaged).T
    return np.asarray(np.einsum("ni,ij,nj->n", fit, covariance, fit))


@lru_cache(maxsize=4)
def _slopes(side: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    size = side * BLOCKS_A_SIDE
    basis = np.stack([part - part.mean() for part in polynomials(size)[1:]])
    averaged = basis.reshape(-1, BLOCKS_A_SIDE, side, BLOCKS_A_SIDE, side).mean(axis=(2, 4))
    flat = basis.reshape(len(basis), -1)
    return averaged.reshape(len(basis), -1).T, flat @ flat.T / size**2


def polynomials(size: int) -> NDArray[np.float64]:
    """Polynomials up to `SLOPE_ORDER` over a window, the constant first, shape (count, size, size)."""
    t = np.linspace(-1.0, 1.0, size)
    orders = range(SLOPE_ORDER + 1)
    return np.stack([np.outer(t**i, t**j) for i in orders for j in orders if i + j <= SLOPE_ORDER])


def _eigenvalues(tensor: NDArray[np.float64]) -> NDArray[np.float64]:
    rr, rc, cc = tensor.T
    mean, spread = (rr + cc) / 2.0, np.hypot((rr - cc) / 2.0, rc)
    return np.stack([np.maximum(mean - spread, 0.0), mean + spread], axis=1)


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
    quarters = [sums[i : i + n, j : j + m].reshape(n * m, -1) for i in (0, half) for j in (0, half)]
    widths = np.stack([_typical_width(part) for part in quarters])
    return np.where(np.isnan(widths).all(axis=0), np.nan, np.nan_to_num(widths).max(axis=0))


def _elongation(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fit s² = a (1 + c cos 2t + s sin 2t) to the mean squared widths by direction."""
    angle = 2.0 * np.pi * np.arange(ORIENTATIONS) / ORIENTATIONS
    basis = np.stack([np.ones(ORIENTATIONS), np.cos(angle), np.sin(angle)], axis=1)
    count, square = sums[..., 0], sums[..., 1]
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
