"""PSFs from photos of points: stars, pinholes, sparks on a steel ball.

Sampled at the pixels, a point between them is a sinc centred on its place. The kernel k of a cell of the
field turns all its points, each at its own phase, into the pixels that were measured:

    y_i(p) = f_i sum_u k(u) sinc(p - u - c_i) + b_i

So points at many phases are stacked without interpolating a photo, and pixels of a mosaic that saw another
colour are left out. Places c_i and fluxes f_i are refined as long as that explains more of the light; what is
left of it joins the expected error. A point with one saturated pixel is refused whole: its neighbours hold
what ran over. Each pixel is weighted by its own noise, from the sky and the light that the previous kernel
predicts there: most pixels of a point are dark, so that the mean noise is right for none of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import ClassVar, Final

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import ndimage, spatial

from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import centred
from lensmodel.core.types import CHANNELS, Channel, StepHook
from lensmodel.measured.measurer import (
    NEAR_CLIP,
    Found,
    Measurer,
    Prepared,
    Solved,
    Window,
    solve,
)
from lensmodel.photo import LinearPhoto

_FEWEST: Final = 2  # Lights a cell must have: one alone may be a double star
# Least share of lone bright spots (chosen: 30 photos have less than .04, stars .4; no command repeats it)
_ISOLATED: Final = 0.05
_MOST: Final = 12  # lights of a cell: more lower the noise no further (chosen)
_ROUNDS: Final = 3  # of stacking at improved centres: soon they rest (chosen)


@dataclass(frozen=True, slots=True)
class Points(Measurer):
    """PSFs from isolated, unsaturated points of light."""

    across: int = 7  # cells of the frame; the points of a cell are stacked
    down: int = 5

    name: ClassVar[str] = "points"
    floor: ClassVar[float] = 0.1  # three times that of one kernel, which may change in the cell (chosen)
    most: ClassVar[float] = 0.45
    nothing: ClassVar[str] = (
        "what looks like points of light gives no PSF: they are too faint, or parts of an ordinary scene; "
        "photograph stars or pinholes before a dark ground, and expose longer"
    )

    def _prepare(self, photos: Sequence[LinearPhoto], size: int, on_step: StepHook) -> Prepared:
        """Find points that are alone and unsaturated, by the cells of the frame."""
        photo = photos[0]
        plane = np.asarray(photo.planes[1], dtype=np.float64)
        spots = find_lights(plane)
        lights = isolated_lights(spots, size)
        usable = [(row, col) for row, col, _ in lights if _is_usable(photo, row, col, size)]
        cells: dict[tuple[int, int], list[tuple[float, float]]] = {}
        for row, col in usable:
            cell = int(row * self.down / photo.frame.height), int(col * self.across / photo.frame.width)
            cells.setdefault(cell, []).append((row, col))
        good = [cell for cell in cells.values() if len(cell) >= _FEWEST]
        if len(lights) < _ISOLATED * len(spots):
            raise NotEnoughEvidenceError(
                f"of {len(spots)} bright spots only {len(lights)} are isolated: this is no photo of points "
                "of light, or they are too close together; photograph stars or pinholes before a dark "
                "ground, and learn from ordinary photos with `lensmodel calibrate`"
            )
        if not good:
            raise NotEnoughEvidenceError(
                f"{len(lights)} isolated points of light, {len(usable)} of them unsaturated and whole, and "
                f"no part of the frame with {_FEWEST}; expose less, or photograph more points"
            )

        @cache
        def sky(channel: Channel) -> NDArray[np.float64]:
            return sky_of(np.asarray(photo.planes[CHANNELS.index(channel)], np.float64))[0]

        return good, lambda cell, channel: _cell_psf(photo, channel, cell[:_MOST], size, sky(channel))


def _is_usable(photo: LinearPhoto, row: float, col: float, size: int) -> bool:
    """Whether the window of a light lies in the frame, and nothing near it is saturated."""
    half, (height, width) = size // 2 + 1, photo.planes.shape[1:]
    if not (half <= row < height - half and half <= col < width - half):
        return False
    top, left = max(round(row) - 3, 0), max(round(col) - 3, 0)
    near = photo.planes[:, top : round(row) + 4, left : round(col) + 4]
    return all(bool((plane < NEAR_CLIP * clip).all()) for plane, clip in zip(near, photo.clip, strict=True))


@dataclass(frozen=True, slots=True, eq=False)
class _Stamp:
    """One light: its window, that without sky, where it is in it, and the sky's level."""

    window: Window
    observed: NDArray[np.float64]
    place: tuple[float, float]
    flux: float
    pixel: tuple[float, float]
    sky: float

    def latent(self, size: int) -> NDArray[np.float64]:
        """The light as a sinc, on the window with a margin of half a kernel."""
        side = self.observed.shape[0] + 2 * (size // 2)
        t = np.arange(side) - size // 2
        return self.flux * np.outer(np.sinc(t - self.place[0]), np.sinc(t - self.place[1]))

    def blurred(self, kernel: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the pixels of the window see of it behind a kernel."""
        return np.asarray(scipy.signal.fftconvolve(self.latent(len(kernel)), kernel, mode="valid"))

    def variance(self, light: NDArray[np.float64]) -> NDArray[np.float64]:
        """Variance of the noise of its pixels where they have so much light above the sky."""
        noise = self.window.noise
        return noise.shot * (self.sky + np.maximum(light, 0.0)) + noise.read


def _cell_psf(
    photo: LinearPhoto,
    channel: Channel,
    lights: Sequence[tuple[float, float]],
    size: int,
    sky: NDArray[np.float64],
) -> Found:
    """Stack the lights of a cell, and solve for their kernel."""
    stamps = [_stamp(photo, channel, light, size, sky) for light in lights]
    stamps = [stamp for stamp in stamps if stamp.flux > 0.0 and stamp.window.measured.sum() > size]
    if len(stamps) < _FEWEST:
        raise NotEnoughEvidenceError("fewer lights than a cell must have are seen in this colour")
    solved = _stacked(stamps, size, None)
    left = _unexplained(stamps, solved)
    for _ in range(_ROUNDS - 1):
        # sharper than pixels, lights are no sums of sincs, and the centres that suit sincs best are wrong
        moved = [_refined(stamp, solved.kernel) for stamp in stamps]
        again = _stacked(moved, size, solved.kernel)
        if (rest := _unexplained(moved, again)) >= left:
            break
        stamps, solved, left = moved, again, rest
    weights = np.array([stamp.flux for stamp in stamps])
    middle = np.average([stamp.pixel for stamp in stamps], axis=0, weights=weights)
    return Found(centred(solved.kernel), math.hypot(solved.error, left), middle, size)


def _stamp(
    photo: LinearPhoto, channel: Channel, pixel: tuple[float, float], size: int, sky: NDArray[np.float64]
) -> _Stamp:
    top, left = round(pixel[0]) - size // 2, round(pixel[1]) - size // 2
    window = Window.of(photo, channel, (top, left), size)
    behind = sky[top : top + size, left : left + size]
    observed, level = window.light - behind, max(float(behind.mean()), 0.0)
    place = pixel[0] - top, pixel[1] - left
    return _Stamp(window, observed, place, float(observed.sum()), pixel, level)


def _stacked(stamps: Sequence[_Stamp], size: int, kernel: NDArray[np.float64] | None) -> Solved:
    """Solve for the kernel of all stamps at once: they stand below each other, apart by what pads them.

    `kernel` is that of the round before, by which the noise of each pixel is known.
    """
    latent = np.concatenate([stamp.latent(size) for stamp in stamps])
    observed = np.zeros((latent.shape[0] - size + 1, size))
    measured, variance = np.zeros(observed.shape, dtype=bool), np.ones(observed.shape)
    for number, stamp in enumerate(stamps):
        rows = slice(number * (2 * size - 1), number * (2 * size - 1) + size)
        observed[rows], measured[rows] = stamp.observed, stamp.window.measured
        light = np.full((size, size), stamp.flux / size**2) if kernel is None else stamp.blurred(kernel)
        variance[rows] = stamp.variance(light)
    return solve(observed, latent, measured, variance, size, even=True)


def _unexplained(stamps: Sequence[_Stamp], solved: Solved) -> float:
    """Return what a kernel leaves of the lights beyond their noise, as a relative L2."""
    rest, power = 0.0, 0.0
    for stamp in stamps:
        good, light = stamp.window.measured, stamp.blurred(solved.kernel * solved.light)
        rest += float((np.square(stamp.observed - light) - stamp.variance(light))[good].sum())
        power += float(np.square(stamp.observed[good]).sum())
    return math.sqrt(max(rest, 0.0) / power)


def _refined(stamp: _Stamp, kernel: NDArray[np.float64]) -> _Stamp:
    """Move and scale a light so that the kernel explains its pixels best: one Gauss-Newton step."""
    step = 0.05

    def moved(row: float, col: float) -> _Stamp:
        return replace(stamp, place=(stamp.place[0] + row, stamp.place[1] + col))

    by_row, by_col = (
        (moved(*d).blurred(kernel) - moved(*np.negative(d)).blurred(kernel)) / (2 * step)
        for d in ((step, 0.0), (0.0, step))
    )
    predicted, good = stamp.blurred(kernel), stamp.window.measured
    basis = np.stack([predicted, by_row, by_col, np.ones_like(predicted)], axis=-1)[good]
    terms, *_ = np.linalg.lstsq(basis, stamp.observed[good], rcond=None)
    if not terms[0] > 0.0:
        return stamp
    row, col = np.clip(terms[1:3] / terms[0], -0.5, 0.5)
    return replace(moved(float(row), float(col)), flux=stamp.flux * float(terms[0]))


_SIGMAS: Final = 8.0  # of the sky's scatter, that a light stands out by: fainter ones add noise (chosen)
_NEIGHBOUR: Final = 0.1  # of its flux, that another light beside it may have: fainter is noise (chosen)
_SKY_CELL: Final = 64  # pixels of a cell in which the sky is one value, as SExtractor's default


def sky_of(plane: NDArray[np.floating]) -> tuple[NDArray[np.float64], float]:
    """Smooth background of a plane, and how much its pixels scatter (1.48 times the median deviation)."""
    shape = [max(n // _SKY_CELL, 1) for n in plane.shape]
    strips = np.array_split(plane, shape[0])
    cells = np.array([[np.median(part) for part in np.array_split(s, shape[1], axis=1)] for s in strips])
    cells = ndimage.median_filter(cells, 3, mode="nearest")
    factors = np.divide(plane.shape, cells.shape)
    sky = ndimage.zoom(cells, factors, order=1, mode="nearest", grid_mode=True)
    left = plane - sky
    scatter = 1.4826 * float(np.median(np.abs(left - np.median(left))))
    return sky, max(scatter, 1e-7)


def find_lights(plane: NDArray[np.floating]) -> NDArray[np.float64]:
    """Find points of light, brightest first: (n, 3), row, col and the peak above the sky.

    They are the highest of their 5 x 5 neighbours after a little smoothing, at the centroid of 5 x 5 pixels.
    """
    sky, scatter = sky_of(plane)
    clean = plane - sky
    smooth = ndimage.gaussian_filter(clean, 1.0)
    # smoothing by sigma 1 leaves 1 / (2 sqrt(pi)) of the scatter of white noise
    peaks = (smooth == ndimage.maximum_filter(smooth, 5)) & (
        smooth > _SIGMAS * scatter / (2 * np.sqrt(np.pi))
    )
    peaks[:2] = peaks[-2:] = False
    peaks[:, :2] = peaks[:, -2:] = False
    lights = []
    t = np.arange(-2, 3)
    for row, col in np.argwhere(peaks):
        part = np.maximum(smooth[row - 2 : row + 3, col - 2 : col + 3], 0.0)
        down, across = (float(part.sum(axis=axis) @ t / part.sum()) for axis in (1, 0))
        peak = float(clean[row - 1 : row + 2, col - 1 : col + 2].max())
        lights.append((row + down, col + across, peak))
    return np.array(sorted(lights, key=lambda light: -light[2])).reshape(-1, 3)


def isolated_lights(lights: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
    """Lights of `find_lights` that have no other beside them that would disturb, within `reach` pixels."""
    places, peaks = lights[:, :2], lights[:, 2]
    near = spatial.cKDTree(places).query_ball_point(places, reach, p=np.inf)
    alone = [(peaks[own] > _NEIGHBOUR * peak).sum() == 1 for own, peak in zip(near, peaks, strict=True)]
    return lights[np.array(alone, dtype=bool)]
