"""What can be seen of a corrected picture beside its original, with no truth and none of the product's code.

Pictures are as shown, sRGB-encoded, because a fault counts by how it looks. Nothing here imports the library.
"""

from __future__ import annotations

from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Shown: TypeAlias = NDArray[np.floating]  # a picture `(row, col, 3)`, sRGB-encoded, 0 to 1
STANDS_OUT: Final = 0.06  # fifteen of 255: chosen as what one sees at a glance on an even ground
COLOURED: Final = 0.12  # distance of chromaticity (chosen): a cast that one names without comparison
HUE_REACH: Final = 3  # pixels around a place whose colours it may take: as far as lateral colour moves them

# least curvature that a point of contrast 1 leaves when it is blurred, after a Gaussian of one pixel: behind
# one of s pixels it is 1 / (2 pi (1 + s^2)^2): .072 at s = .7, .027 at 1.2, .0064 at 2
TRACE: Final = 0.006

BANDS: Final = {"coarse": (0.06, 0.15), "middle": (0.15, 0.3), "fine": (0.3, 0.5)}  # cycles per pixel
_FAR: Final = 2.0  # ranges beyond the range of a dot (chosen): with 1.5 correct twigs and letters had dots
_HINT: Final = 0.1  # share of a colour that the original must have there for its line to be traced (chosen)

_LUMA: Final = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601
_BLOCK: Final = 32  # pixels of a square whose grain is taken: holds two periods of `BANDS` (chosen)
# power density of coarse over fine: white noise has 1, demosaiced noise 2 to 5, a scene (1/f^2) about 20
_SPECTRUM_OF_GRAIN: Final = 8.0
_FLAT_SHARE: Final = 0.1  # of the squares, the flattest; so many at least (chosen: medians of fewer jump)
_FLAT_BLOCKS: Final = 8
_LEAST_GRAIN: Final = 1e-3  # standard deviation below which a place holds rounding to eight bits


_EDGE_GRID: Final = 16  # pixels of a square, of which one edge is taken at most (chosen)
_REACH: Final = 12  # pixels of a profile to either side; from `_PLATEAU` on it must be even (chosen)
_PLATEAU: Final = 7
_STEP: Final = 0.2  # least step of an edge, full scale is 1 (chosen: 50 of 255)
_EVEN: Final = 0.06  # standard deviation of a plateau beside an edge over the step (chosen): half of the bar
_HALO: Final = 5.0
"""Percent of the step beyond its plateaus at an edge that counts (chosen): with 25 the truth overshoots."""
_LEAST_EDGES: Final = 50  # chosen: below it the 99th percentile is the worst edge


def luma(picture: Shown) -> NDArray[np.float64]:
    """Lightness of a picture, `(row, col)` (weights of ITU-R BT.601)."""
    return np.asarray(picture, dtype=np.float64) @ _LUMA


def chromaticity(picture: Shown) -> NDArray[np.float32]:
    """Coordinates in the plane of colours without lightness, `(row, col, 2)`; the origin is grey.

    c1 = (R - G) / sqrt 2, c2 = (R + G - 2 B) / sqrt 6: an orthonormal basis beside (1, 1, 1).
    """
    r, g, b = (np.asarray(picture[..., k], dtype=np.float32) for k in range(3))
    return np.stack([(r - g) / np.float32(2**0.5), (r + g - 2 * b) / np.float32(6**0.5)], axis=-1)


def dots(before: Shown, after: Shown, truth: Shown | None = None) -> NDArray[np.bool_]:
    """Pixels that stand alone where the original has no such value and nothing that could become one.

    At most one of a dot's eight neighbours goes with it: what is sharpened along an edge or a line has two. A
    true point that was blurred left a bump, see `TRACE`. What a known truth has within a pixel is none.
    """
    found = np.zeros(before.shape[:2], dtype=bool)
    for k in range(3):
        old, new = (np.asarray(picture[..., k], dtype=np.float32) for picture in (before, after))
        for sign in (np.float32(1.0), np.float32(-1.0)):
            dot = _dots(sign * old, sign * new)
            if truth is not None:
                dot &= sign * new > ndimage.maximum_filter(sign * truth[..., k], 3) + STANDS_OUT
            found |= dot
    return found


def _dots(old: NDArray[np.float32], new: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Bright dots of a channel."""
    found = np.zeros(old.shape, dtype=bool)
    high = ndimage.maximum_filter(old, 5)
    margin = np.maximum(_FAR * (high - ndimage.minimum_filter(old, 5)), STANDS_OUT)
    rows, cols = np.nonzero(new > high + margin)
    if rows.size == 0:
        return found
    padded = np.pad(new, 1, mode="reflect")
    around = [
        padded[rows + 1 + dr, cols + 1 + dc] for dr in (-1, 0, 1) for dc in (-1, 0, 1) if (dr, dc) != (0, 0)
    ]
    alone = new[rows, cols] > np.sort(np.stack(around), axis=0)[-2] + STANDS_OUT
    rows, cols = rows[alone], cols[alone]
    down, across, mixed = _second_derivatives(old)
    weakest = -((down + across) / 2.0 + np.hypot((down - across) / 2.0, mixed))
    bump = ndimage.maximum_filter(weakest, 3)[rows, cols]
    dot = bump < TRACE * (new - high)[rows, cols]
    found[rows[dot], cols[dot]] = True
    return found


def hue_flips(before: Shown, after: Shown, truth: Shown | None = None) -> NDArray[np.bool_]:
    """Pixels whose hue the original has nowhere within `HUE_REACH` pixels, and no trace of it either.

    Its chromaticity exceeds the largest part of any around along it by `COLOURED` and by half of itself. A
    small thing that blur has washed out left a tenth of its colour, and a ridge.
    """
    old, new = chromaticity(before), chromaticity(after)
    size = np.linalg.norm(new, axis=-1)
    rows, cols = np.nonzero((size > COLOURED) & (np.linalg.norm(new - old, axis=-1) > COLOURED))
    own = size[rows, cols]
    most = _most_along(old, rows, cols, new[rows, cols] / np.maximum(own, COLOURED)[:, None], HUE_REACH)
    flips = own - most > np.maximum(COLOURED, 0.5 * own)
    found = np.zeros(before.shape[:2], dtype=bool)
    rows, cols, own = rows[flips], cols[flips], own[flips]
    if rows.size == 0:
        return found
    towards = new[rows, cols] / own[:, None]
    bends = [
        np.stack(pair, axis=-1)
        for pair in zip(*(_second_derivatives(old[..., k]) for k in (0, 1)), strict=True)
    ]
    ridge = np.full(rows.size, -np.inf)
    for dr, dc in np.ndindex(3, 3):
        at = np.clip(rows + dr - 1, 0, old.shape[0] - 1), np.clip(cols + dc - 1, 0, old.shape[1] - 1)
        down, across, mixed = ((bend[at] * towards).sum(axis=-1) for bend in bends)
        np.maximum(ridge, np.hypot((down - across) / 2.0, mixed) - (down + across) / 2.0, out=ridge)
    traced = (ridge >= TRACE * own) & (_most_along(old, rows, cols, towards, 1) >= _HINT * own)
    if truth is not None:
        colours = np.pad(chromaticity(truth), ((1, 1), (1, 1), (0, 0)), mode="reflect")
        for dr, dc in np.ndindex(3, 3):
            away = np.linalg.norm(new[rows, cols] - colours[rows + dr, cols + dc], axis=-1)
            traced |= away <= COLOURED
    found[rows[~traced], cols[~traced]] = True
    return found


def _most_along(
    colours: NDArray[np.float32],
    rows: NDArray[np.intp],
    cols: NDArray[np.intp],
    towards: NDArray[np.floating],
    reach: int,
) -> NDArray[np.float64]:
    """Largest part along a direction that any chromaticity around a pixel has."""
    padded = np.pad(colours, ((reach, reach), (reach, reach), (0, 0)), mode="reflect")
    most = np.full(rows.size, -np.inf)
    for dr, dc in np.ndindex(2 * reach + 1, 2 * reach + 1):
        np.maximum(most, (padded[rows + dr, cols + dc] * towards).sum(axis=-1), out=most)
    return most


def _second_derivatives(plane: NDArray[np.floating]) -> tuple[NDArray[np.float32], ...]:
    """Second derivatives of a plane by rows, by columns and mixed, after a Gaussian of one pixel."""
    orders = ((2, 0), (0, 2), (1, 1))
    return tuple(ndimage.gaussian_filter(plane.astype(np.float32), 1.0, order=order) for order in orders)


def overshoots(before: Shown, after: Shown, truth: Shown | None = None) -> NDArray[np.float64]:
    """Overshoot beside each clean edge of the original, in both pictures.

    The mean of five lines across it leaves the plateaus 1 to 6 pixels away by so many percent of the step.
    Edges beside which the truth has a line that blur hid are left out.
    """
    old, new = luma(before), luma(after)
    if min(old.shape) < 3 * _REACH:
        return np.empty((0, 2))
    slope = np.stack([ndimage.gaussian_filter(old, 1.5, order=order) for order in ((1, 0), (0, 1))])
    rows, cols = _steepest(np.hypot(*slope))
    direction = slope[:, rows, cols]
    direction = direction / np.maximum(np.hypot(*direction), 1e-12)
    pictures = [old, new] if truth is None else [old, new, luma(truth)]
    profiles = [_profiles(picture, rows, cols, direction) for picture in pictures]
    t = np.arange(-_REACH, _REACH + 1)
    low_side, high_side = t <= -_PLATEAU, t >= _PLATEAU
    original = profiles[0]
    step = original[:, high_side].mean(axis=1) - original[:, low_side].mean(axis=1)
    uneven = np.maximum(original[:, high_side].std(axis=1), original[:, low_side].std(axis=1))
    clean = (step >= _STEP) & (uneven <= _EVEN * step)
    beyond = []
    for profile in profiles:
        low, high = profile[:, low_side].mean(axis=1), profile[:, high_side].mean(axis=1)
        above = profile[:, (t >= 1) & ~high_side].max(axis=1) - high
        below = low - profile[:, (t <= -1) & ~low_side].min(axis=1)
        beyond.append(np.maximum(np.maximum(above, below), 0.0) / np.maximum(high - low, 0.5 * step + 1e-12))
    percent = 100.0 * np.stack(beyond, axis=1)
    for own in (0, *range(2, len(pictures))):
        clean &= percent[:, own] <= _HALO
    return percent[clean, :2]


def _steepest(slope: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Place of the steepest pixel of each square, where it is steep enough for a step to be there."""
    inner = slope[_REACH + 2 : -_REACH - 2, _REACH + 2 : -_REACH - 2]
    height, width = (n // _EDGE_GRID * _EDGE_GRID for n in inner.shape)
    down, across = height // _EDGE_GRID, width // _EDGE_GRID
    squares = inner[:height, :width].reshape(down, _EDGE_GRID, across, _EDGE_GRID)
    flat = squares.transpose(0, 2, 1, 3).reshape(down, across, _EDGE_GRID**2)
    at = flat.argmax(axis=-1)
    steep = np.nonzero(flat.max(axis=-1) > _STEP / (2 * _REACH))
    best = at[steep]
    inside = np.array(steep) * _EDGE_GRID + np.divmod(best, _EDGE_GRID) + _REACH + 2
    return inside[0], inside[1]


def _profiles(
    picture: NDArray[np.float64],
    rows: NDArray[np.intp],
    cols: NDArray[np.intp],
    direction: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Lightness across each edge from its dark to its light side, `(n, 2 reach + 1)`."""
    t = np.arange(-_REACH, _REACH + 1)[None, :]
    total = np.zeros((rows.size, t.size))
    for along in range(-2, 3):
        places = (
            rows[:, None] + t * direction[0][:, None] - along * direction[1][:, None],
            cols[:, None] + t * direction[1][:, None] + along * direction[0][:, None],
        )
        total += ndimage.map_coordinates(picture, places, order=1, mode="nearest")
    return total / 5.0


def grain(before: Shown, after: Shown, truth: Shown | None = None) -> NDArray[np.float64]:
    """Noise power of lightness in each even place and band of frequency, in both pictures.

    Squares with a spectrum of grain (`_SPECTRUM_OF_GRAIN`), more of it than rounding; where a known truth has
    as much in a band, it is texture. Which of them are the flattest `grain_ratio` decides.
    """
    height, width = (n // _BLOCK for n in before.shape[:2])
    lights = [None if p is None else luma(p) for p in (before, after, truth)]
    found = []
    for down in range(height):
        for across in range(width):
            window = tuple(slice(n * _BLOCK, (n + 1) * _BLOCK) for n in (down, across))
            if not (before[window].min() > 0.02 and before[window].max() < 0.98):
                continue
            old, new, true = (None if p is None else _detrended(p[window]) for p in lights)
            assert old is not None
            assert new is not None
            variance, powers = float(np.square(old).mean()), _powers(old)
            if variance < _LEAST_GRAIN**2 or powers[0] > _SPECTRUM_OF_GRAIN * powers[-1]:
                continue
            if true is not None and any(t >= p for t, p in zip(_powers(true), powers, strict=True)):
                continue
            found.append([variance, *powers, *_powers(new)])
    return np.array(found).reshape(-1, 1 + 2 * len(BANDS))


def grain_ratio(places: NDArray[np.float64]) -> dict[str, float] | None:
    """Noise power of the corrected picture over the original's in each band; None where nothing is flat."""
    count = max(round(_FLAT_SHARE * len(places)), _FLAT_BLOCKS)
    if len(places) < count:
        return None
    flattest = places[np.argsort(places[:, 0])[:count], 1:]
    old, new = np.median(flattest[:, : len(BANDS)], axis=0), np.median(flattest[:, len(BANDS) :], axis=0)
    return {name: float(n / o) for name, n, o in zip(BANDS, new, old, strict=True)}


def percentile_of_edges(found: NDArray[np.float64]) -> tuple[float, float] | None:
    """99th percentile of the overshoot, of the original and of the corrected picture; None for few edges."""
    if len(found) < _LEAST_EDGES:
        return None
    old, new = np.percentile(found, 99.0, axis=0)
    return float(old), float(new)


def _detrended(block: NDArray[np.float64]) -> NDArray[np.float64]:
    """A square less its plane of best fit."""
    t = np.arange(_BLOCK) - (_BLOCK - 1) / 2.0
    scale = float(np.square(t).sum()) * _BLOCK
    block = block - block.mean()
    down, across = (block.sum(axis=1) @ t) / scale, (block.sum(axis=0) @ t) / scale
    return np.asarray(block - t[:, None] * down - t[None, :] * across)


def _powers(block: NDArray[np.float64]) -> list[float]:
    """Mean power density of a square in each band."""
    spectrum = np.square(np.abs(np.fft.fft2(block * _WINDOW)))
    return [float(spectrum[mask].mean()) for mask in _MASKS]


_WINDOW: Final = np.outer(np.hanning(_BLOCK), np.hanning(_BLOCK))
_RADIUS: Final = np.hypot(np.fft.fftfreq(_BLOCK)[:, None], np.fft.fftfreq(_BLOCK)[None, :])
_MASKS: Final = tuple((low <= _RADIUS) & (high > _RADIUS) for low, high in BANDS.values())
