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
from numpy.typing import NDArray
from scipy import ndimage, signal, spatial

from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import centred
from lensmodel.core.types import CHANNELS, Channel, NoiseModel, StepHook
from lensmodel.measured.measurer import NEAR_CLIP, Found, Measurer, Prepared, Solved, Window, solve
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
    shows: ClassVar[str] = "many points of light, stars or pinholes, before a dark ground"

    def _prepare(self, photos: Sequence[LinearPhoto], size: int, on_step: StepHook) -> Prepared:
        """Find points that are alone and unsaturated, by the cells of the frame."""
        photo, half = photos[0], size // 2 + 1
        height, width = photo.planes.shape[1:]
        spots = find_lights(np.asarray(photo.planes[1], dtype=np.float64))
        lights = isolated_lights(spots, size)
        rows, cols = np.rint(lights[:, :2].T).astype(int)
        limits = NEAR_CLIP * np.array(photo.clip, dtype=np.float32)[:, None, None]
        clipped = ndimage.maximum_filter((photo.planes >= limits).any(axis=0), 7)[rows, cols]
        whole = (rows >= half) & (rows < height - half) & (cols >= half) & (cols < width - half)
        usable = lights[whole & ~clipped, :2]
        number = (usable * (self.down / height, self.across / width)).astype(int) @ (self.across, 1)
        cells = [usable[number == cell][:_MOST] for cell in np.unique(number)]
        good = [cell for cell in cells if len(cell) >= _FEWEST]
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

        return good, lambda cell, channel: _cell_psf(photo, channel, cell, size, sky(channel))


@dataclass(frozen=True, slots=True, eq=False)
class _Lights:
    """Lights of a cell in one colour, each in a window of its own."""

    noise: NoiseModel
    observed: NDArray[np.float64]  # (n, size, size), less the sky
    measured: NDArray[np.bool_]
    sky: NDArray[np.float64]  # (n, 1, 1), its level
    places: NDArray[np.float64]  # (n, 2), in the windows
    fluxes: NDArray[np.float64]  # (n,)

    def latent(self) -> NDArray[np.float64]:
        """Sincs, on the windows with a margin of half a kernel."""
        size = self.observed.shape[1]
        t = np.arange(2 * size - 1) - size // 2
        down, along = np.sinc(t - self.places.T[..., None])
        return self.fluxes[:, None, None] * down[:, :, None] * along[:, None, :]

    def blurred(self, kernel: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the pixels of the windows see of them behind a kernel."""
        return np.asarray(signal.fftconvolve(self.latent(), kernel[None], mode="valid", axes=(1, 2)))

    def variance(self, light: NDArray[np.float64]) -> NDArray[np.float64]:
        """Variance of the noise of pixels that have so much light above the sky."""
        return self.noise.shot * (self.sky + np.maximum(light, 0.0)) + self.noise.read


def _cell_psf(
    photo: LinearPhoto, channel: Channel, pixels: NDArray[np.float64], size: int, sky: NDArray[np.float64]
) -> Found:
    """Stack the lights of a cell, and solve for their kernel."""
    corners = np.rint(pixels).astype(int) - size // 2
    windows = [Window.of(photo, channel, (int(top), int(left)), size) for top, left in corners]
    behind = np.stack([sky[top : top + size, left : left + size] for top, left in corners])
    observed = np.stack([window.light for window in windows]) - behind
    measured = np.stack([window.measured for window in windows])
    fluxes = observed.sum(axis=(1, 2))
    seen = (fluxes > 0.0) & (measured.sum(axis=(1, 2)) > size)
    if seen.sum() < _FEWEST:
        raise NotEnoughEvidenceError("fewer lights than a cell must have are seen in this colour")
    level = np.maximum(behind.mean(axis=(1, 2), keepdims=True), 0.0)
    parts = observed, measured, level, pixels - corners, fluxes
    lights = _Lights(windows[0].noise, *(part[seen] for part in parts))
    solved, left = _stacked(lights, None)
    for _ in range(_ROUNDS - 1):
        # sharper than pixels, lights are no sums of sincs, and the centres that suit sincs best are wrong
        moved = _refined(lights, solved.kernel)
        again, rest = _stacked(moved, solved.kernel)
        if rest >= left:
            break
        lights, solved, left = moved, again, rest
    middle = np.average(pixels[seen], axis=0, weights=lights.fluxes)
    return Found(centred(solved.kernel), math.hypot(solved.error, left), middle)


def _stacked(lights: _Lights, kernel: NDArray[np.float64] | None) -> tuple[Solved, float]:
    """Solve for the kernel of all lights; say what it leaves of them beyond their noise, as a relative L2."""
    size, good = lights.observed.shape[1], lights.measured
    # the kernel of the round before tells the noise of each pixel
    even = np.broadcast_to(lights.fluxes[:, None, None] / size**2, lights.observed.shape)
    variance = lights.variance(even if kernel is None else lights.blurred(kernel))
    solved = solve(lights.observed, lights.latent(), good, variance, size)
    light = lights.blurred(solved.kernel * solved.light)
    rest = float((np.square(lights.observed - light) - lights.variance(light))[good].sum())
    return solved, math.sqrt(max(rest, 0.0) / float(np.square(lights.observed[good]).sum()))


def _refined(lights: _Lights, kernel: NDArray[np.float64]) -> _Lights:
    """Move and scale lights so that the kernel explains their pixels best: one Gauss-Newton step."""
    step = 0.05

    def moved(by: NDArray[np.float64]) -> NDArray[np.float64]:
        return replace(lights, places=lights.places + by).blurred(kernel)

    by_row, by_col = ((moved(by) - moved(-by)) / (2 * step) for by in step * np.eye(2))
    predicted = lights.blurred(kernel)
    basis = np.stack([predicted, by_row, by_col, np.ones_like(predicted)], axis=-1)
    places, fluxes = lights.places.copy(), lights.fluxes.copy()
    for i, good in enumerate(lights.measured):
        (scale, *change, _), *_ = np.linalg.lstsq(basis[i, good], lights.observed[i, good], rcond=None)
        if scale > 0.0:
            places[i] += np.clip(np.array(change) / scale, -0.5, 0.5)
            fluxes[i] *= scale
    return replace(lights, places=places, fluxes=fluxes)


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

    They are the highest of 5 x 5 pixels after a little smoothing, at the centroid of these.
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
