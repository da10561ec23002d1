"""From a wavefront to a PSF on pixels, fast: the transform of the pupil, integrated over pixels.

The PSF of a pupil P(x) = A(x) exp(2 pi i W(x) / lambda) of f-number N is the squared modulus of its Fourier
transform (J. W. Goodman, "Introduction to Fourier Optics", 3rd ed., 2005, section 6.3); its samples at half
of lambda N determine it. Integrating over square pixels is a product with sinc(f pitch) in frequency.
"""

from __future__ import annotations

from collections import OrderedDict
from functools import cache
from math import factorial
from typing import Final, Protocol, runtime_checkable

import numpy as np
import scipy.fft
import scipy.ndimage
from numpy.typing import NDArray

from lensmodel.neural.network import BLOCK, COARSE, FINE, SIDE

WAVELENGTHS_UM: Final = np.array([0.59, 0.63, 0.52, 0.555, 0.45, 0.485])  # two for each of r, g, b

TERMS: Final = tuple((n, m) for n in range(2, 11) for m in range(n % 2, min(n, 6) + 1, 2))
"""Zernike terms (n, m) of a wavefront; each has a cosine and a sine."""
COLUMNS: Final = 2 * len(TERMS)

_AIRY_RINGS: Final = 9.0  # beyond so many a perfect PSF has 2 % of its light, which is left out
_CENTRED: Final = 0.05  # pixels: how near to the middle the centre of mass must lie
_SIDES: Final = tuple(range(48, 257, 16)) + tuple(range(288, 577, 32))  # samples across the pupil


class PopulationLens(Protocol):
    """A lens of the population: its wavefronts at any place, wavelength and aperture."""

    @property
    def f_number(self) -> float:
        """Widest aperture."""

    @property
    def pitch_um(self) -> float:
        """Pixel pitch of the sensor behind it, micrometres."""

    @property
    def focal_mm(self) -> float:
        """Focal length."""

    def working(self, f_number: float | None = None) -> float:
        """F-number of the light at the sensor, of an aperture as it is called; None means widest."""

    def wavefronts(
        self, xy: NDArray[np.float64], wavelengths_um: NDArray[np.float64], f_number: float | None = None
    ) -> NDArray[np.floating]:
        """Coefficients (place, wavelength, COLUMNS) in micrometres, of terms of unit r.m.s."""

    def aperture(self, xy: NDArray[np.float64], f_number: float | None = None) -> NDArray[np.floating]:
        """Circles (place, circle, 3), as (x, y, radius) in pupil radii, that all light has passed."""


@runtime_checkable
class LateralColour(Protocol):
    """A lens that knows where its wavelengths land; see `kernels_of`."""

    def lateral_um(
        self, xy: NDArray[np.float64], wavelengths_um: NDArray[np.float64], f_number: float | None = None
    ) -> NDArray[np.floating]:
        """Shift (place, wavelength, 2) of the image in each wavelength against their mean."""


def draw_pitch_um(rng: np.random.Generator) -> float:
    """Pixel pitch: mostly of large sensors, some of small ones, a few of old cameras with large pixels."""
    lot = rng.random()
    if lot < 0.2:
        return float(rng.uniform(1.0, 3.5))
    return float(rng.uniform(6.6, 12.0) if lot > 0.88 else rng.uniform(3.3, 6.6))


def radial(n: int, m: int, rho: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radial polynomial of Zernike, scaled so that the term has unit r.m.s. on the disc."""
    total = np.zeros_like(rho)
    for k in range((n - m) // 2 + 1):
        part = factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k)
        total = total + (-1) ** k * factorial(n - k) / part * rho ** (n - 2 * k)
    return total * np.sqrt((n + 1) * (2 if m else 1))


def basis(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """All terms at points of the pupil, shape (COLUMNS, *x.shape)."""
    rho, angle = np.hypot(x, y), np.arctan2(y, x)
    columns = []
    for n, m in TERMS:
        r = radial(n, m, rho)
        columns += [r * np.cos(m * angle), r * np.sin(m * angle) if m else np.zeros_like(r)]
    return np.array(columns)


@cache
def _pupil(n: int) -> tuple[tuple[NDArray[np.intp], ...], NDArray[np.float32], NDArray[np.float32]]:
    """Rows and columns of the points of the unit disc on a grid of n x n, (x, y), and the terms there."""
    g = (np.arange(n) + 0.5) / n * 2.0 - 1.0
    y, x = np.meshgrid(-g, g, indexing="ij")
    inside = np.nonzero(x * x + y * y <= 1.0)
    x, y = x[inside], y[inside]
    return inside, np.array([x, y], np.float32), basis(x, y).astype(np.float32)


def _inner(n: int, most: float) -> NDArray[np.float64]:
    """Points (x, y) of a grid of n x n over the pupil up to a squared radius."""
    g = (np.arange(n) + 0.5) / n * 2.0 - 1.0
    y, x = np.meshgrid(g, g, indexing="ij")
    inside = x * x + y * y <= most
    return np.array([x[inside], y[inside]])


@cache
def _slopes() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """A coarse grid of the pupil and the terms' derivatives there, by central differences."""
    (x, y), h = _inner(20, 0.98), 1e-4
    return x, y, (basis(x + h, y) - basis(x - h, y)) / (2 * h), (basis(x, y + h) - basis(x, y - h)) / (2 * h)


def stopped_down(ratio: float) -> NDArray[np.float64]:
    """Matrix by which rows of coefficients become those of the inner part, `ratio` of the radius."""
    x, y = _inner(40, 1.0)
    flat = np.vstack([basis(x, y), np.ones_like(x)[None], x[None], y[None]])
    return np.linalg.lstsq(flat.T, basis(ratio * x, ratio * y).T, rcond=None)[0][:COLUMNS].T


def spots(
    coefficients: NDArray[np.floating], f_number: float, circles: NDArray[np.floating] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Centroid (n, 2) and r.m.s. radius along one axis (n,) of ray spots, micrometres."""
    x, y, dx, dy = _slopes()
    rays = np.stack([coefficients @ dx, coefficients @ dy], -1) * (2.0 * f_number)
    weight = np.ones(rays.shape[:2])
    if circles is not None:
        weight *= _within(x, y, circles)
    weight /= np.maximum(weight.sum(1, keepdims=True), 1.0)
    centre = (rays * weight[..., None]).sum(1)
    spread = ((rays - centre[:, None]) ** 2 * weight[..., None]).sum((1, 2))
    return centre, np.sqrt(spread / 2.0)


def _within(
    x: NDArray[np.floating], y: NDArray[np.floating], circles: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """Which points lie in all of some circles (..., circle, 3)."""
    cx, cy, radius = np.moveaxis(circles[..., None], -2, 0)
    inside: NDArray[np.bool_] = ((x - cx) ** 2 + (y - cy) ** 2 <= radius**2).all(-2)
    return inside


class Renderer:
    """Makes kernels of one pixel pitch and f-number; keeps the matrices that integrate over pixels."""

    def __init__(self, f_number: float, pitch_um: float) -> None:
        self._f_number, self._pitch = f_number, pitch_um
        self._matrices: OrderedDict[tuple[int, float, int], NDArray[np.float32]] = OrderedDict()

    def kernel(
        self,
        coefficients: NDArray[np.floating],
        circles: NDArray[np.floating],
        wavelength_um: float,
        offset_px: NDArray[np.floating] | tuple[float, float] = (0.0, 0.0),
    ) -> NDArray[np.float32]:
        """Kernel (SIDE, SIDE), its centre of mass so far right and up; sum 1 of what falls inside."""
        x, y, dx, dy = _slopes()
        rays = np.stack([coefficients @ dx, coefficients @ dy], -1) * (2.0 * self._f_number)
        open_ = _within(x, y, circles)
        if not open_.any():
            open_[:] = True
        centre = rays[open_].mean(0) - np.asarray(offset_px) * self._pitch
        step = wavelength_um * self._f_number  # um: period of the PSF is n steps
        reach = 1.12 * np.abs(rays[open_] - centre).max() + _AIRY_RINGS * step + self._pitch
        side = SIDE if reach > 0.45 * FINE * self._pitch else FINE
        period = min(2.0 * reach, 1.06 * side * self._pitch)
        n = next((s for s in _SIDES if s * step >= period), _SIDES[-1])
        where, pupil, terms = _pupil(n)
        inside = _within(pupil[0], pupil[1], circles)
        path = coefficients.astype(np.float32) @ terms
        matrix = self._matrix(n, wavelength_um, side)
        at = np.arange(side) - (side - 1) / 2.0
        for _ in range(3):  # tails outside the window move the centre of mass: the second pass mends that
            tilt = (centre[0] * pupil[0] + centre[1] * pupil[1]) / np.float32(2.0 * self._f_number)
            phase = (path - tilt) * np.float32(2.0 * np.pi / wavelength_um)
            field = np.zeros((n, 2 * n), np.complex64)
            wave = np.empty(phase.shape, np.complex64)  # quicker than a complex exponential
            wave.real, wave.imag = inside * np.cos(phase), inside * np.sin(phase)
            field[where] = wave
            # a ray at +2 N grad W: the transform with exp(-i) moves light towards the slope
            amplitude = scipy.fft.fft(scipy.fft.fft(field, axis=1).T.copy(), 2 * n, axis=1).T
            kernel = np.maximum(matrix @ (amplitude.real**2 + amplitude.imag**2) @ matrix.T, 0.0)
            kernel /= kernel.sum()
            off = np.array([kernel.sum(0) @ at, -(kernel.sum(1) @ at)]) - offset_px
            if np.abs(off).max() < _CENTRED:
                break
            centre = centre + off * self._pitch
        out = np.zeros((SIDE, SIDE), np.float32)
        margin = (SIDE - side) // 2
        out[margin : SIDE - margin, margin : SIDE - margin] = kernel
        return out

    def _matrix(self, n: int, wavelength_um: float, side: int) -> NDArray[np.float32]:
        """Integrals over `side` pixels of the trigonometric interpolation of 2n samples, one row a pixel."""
        key = (n, wavelength_um, side)
        if key not in self._matrices:
            period = n * wavelength_um * self._f_number
            at = (np.arange(side) - (side - 1) / 2.0) * self._pitch
            samples = np.arange(2 * n) * period / (2 * n)
            f = np.arange(1, n) / period
            gain = np.sinc(f * self._pitch)
            a, b = 2 * np.pi * np.outer(at, f), 2 * np.pi * np.outer(samples, f)
            matrix = 1.0 + 2.0 * ((np.cos(a) * gain) @ np.cos(b).T + (np.sin(a) * gain) @ np.sin(b).T)
            matrix[np.abs(at) + 0.5 * self._pitch > 0.5 * period] = 0.0  # there the next period begins
            self._matrices[key] = matrix.astype(np.float32)
            if len(self._matrices) > 24:
                self._matrices.popitem(last=False)
        return self._matrices[key]


def kernels_of(
    lens: PopulationLens, xy: NDArray[np.float64], f_number: float | None = None
) -> NDArray[np.float32]:
    """Kernels of a lens, shape (place, 3, SIDE, SIDE): red, green, blue; each centred on its own centroid."""
    used = lens.working(f_number)
    wavelengths = WAVELENGTHS_UM
    coefficients = lens.wavefronts(xy, wavelengths, f_number)
    circles = lens.aperture(xy, f_number)
    if isinstance(lens, LateralColour):  # light of one channel lands side by side: a blur along the radius
        rays = np.stack([spots(coefficients[:, w], used, circles)[0] for w in range(len(wavelengths))], 1)
        at = (lens.lateral_um(xy, wavelengths, f_number) + rays) / lens.pitch_um
        pairs = at.reshape(len(xy), -1, 2, 2)
        offsets = (pairs - pairs.mean(2, keepdims=True)).reshape(at.shape)
    else:
        offsets = np.zeros((len(xy), len(wavelengths), 2))
    renderer = Renderer(used, lens.pitch_um)
    out = np.zeros((len(xy), 3, SIDE, SIDE), np.float32)
    for p in range(len(xy)):
        for w, wavelength in enumerate(wavelengths):
            out[p, w // 2] += 0.5 * renderer.kernel(
                coefficients[p, w], circles[p], float(wavelength), offsets[p, w]
            )
    return out


def behind_sensor(kernels: NDArray[np.float32], separation: float, diffusion: float) -> NDArray[np.float32]:
    """Kernels (..., SIDE, SIDE) behind a low-pass filter and charge that spreads, centred as before.

    The filter's four spots have cos(pi d fx) cos(pi d fy) (J. E. Greivenkamp, Applied Optics 29, 1990).
    """
    if not separation and not diffusion:
        return kernels
    side = SIDE + 15  # nothing comes back from the other edge
    fx, fy = np.fft.rfftfreq(side)[None], np.fft.fftfreq(side)[:, None]
    transfer = np.cos(np.pi * separation * fx) * np.cos(np.pi * separation * fy)
    transfer = transfer * np.exp(-2 * (np.pi * diffusion) ** 2 * (fx * fx + fy * fy))
    spectrum = scipy.fft.rfft2(kernels, (side, side)) * transfer.astype(np.float32)
    blurred = np.maximum(scipy.fft.irfft2(spectrum, (side, side))[..., :SIDE, :SIDE], 0.0)
    return blurred / blurred.sum((-1, -2), keepdims=True)


def coarse_of(kernels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sums over cells of `BLOCK` x `BLOCK` pixels: (..., SIDE, SIDE) to (..., COARSE, COARSE)."""
    shape = (*kernels.shape[:-2], COARSE, BLOCK, COARSE, BLOCK)
    return kernels.reshape(shape).sum((-3, -1))


def fine_of(kernels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Inner part: (..., SIDE, SIDE) to (..., FINE, FINE)."""
    margin = (SIDE - FINE) // 2
    return kernels[..., margin : SIDE - margin, margin : SIDE - margin]


def scaled(kernels: NDArray[np.floating], scale: float) -> NDArray[np.float64]:
    """Kernels (..., SIDE, SIDE) drawn out by a factor about their middle; sum 1."""
    at = (np.arange(SIDE) - SIDE // 2) / scale + SIDE // 2
    columns = [scipy.ndimage.map_coordinates(row, [at], order=3, mode="constant") for row in np.eye(SIDE)]
    weights = np.stack(columns, 1)  # of each pixel in each drawn one, by cubic splines
    drawn = np.maximum(weights @ np.asarray(kernels, np.float64) @ weights.T, 0.0)
    total: NDArray[np.float64] = drawn / drawn.sum((-2, -1), keepdims=True)
    return total
