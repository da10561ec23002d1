"""Kernels from a wavefront, with their derivatives, fast enough to be fitted.

With the pupil p (right, up; |p| <= 1), q = wavelength x f-number / pixel pitch, and W in waves::

    E(x) = sum_p A(p) exp(2 pi i W(p)) exp(-i pi p . x / q),     x in pixels
    k(pixel) = integral over the pixel of |E(x)|^2

The wavefront is written in blur: W = sum_k g_k B_k(p) / (2 q), so that a ray through p lands at
sum_k g_k grad B_k(p) pixels whatever the wavelength. The terms B_k are those that third-order
theory has at one place of the field::

    |p|^4,  px |p|^2,  py |p|^2,  |p|^2,  px^2 - py^2,  2 px py,  px,  py

The transform is a product of matrices (R. Soummer et al., "Fast computation of Lyot-style
coronagraph propagation", Optics Express 15, 2007, eq. 1): only the pixels that matter are computed,
and the derivatives dE = sum 2 pi i B A exp(2 pi i W) ... share its matrices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

TERMS: Final = 8
"""Number of wavefront terms; the last two are the tilts, which move the kernel."""

_MIN_ACROSS, _MAX_ACROSS = 40, 176  # samples across the transform: aliasing below, memory above (chosen)
_ALONE = 1.05  # period over the side of a kernel, at least: a twentieth between copies (chosen)
_PERIOD = 1.25  # of the discrete pupil over the side of the kernel: wings fade in between (chosen)
# Light is band limited to 1 / q cycles/pixel; its last tenth may alias, the pixel kills it (chosen)
_SAMPLING = 0.9
_MIN_FINE, _MAX_FINE = 3, 8
"""Samples per pixel: fewer cannot draw the rounded edges of a pixel, more than eight only cost memory
(chosen)."""
_RIM = 4  # samples: the pixel's box with its rounded edges


def largest_side(q: float) -> int:
    """Odd side of the largest kernel that shows no copy of the light beside it: one period of the pupil."""
    return max(2 * int(_MAX_ACROSS * q / 2.0 / _ALONE) - 1, 1)


def ray_gradients(px: Floats, py: Floats) -> tuple[Floats, Floats]:
    """Where rays land by each of the first six terms: grad B_k of X(p) = sum_k g_k grad B_k(p), pixels.

    Parameters
    ----------
    px, py : ndarray of float64, shape (n,)
        Points of the pupil, (right, up).

    Returns
    -------
    across, up : ndarray of float64, shape (6, n)
    """
    r2 = px * px + py * py
    across = np.stack([4 * r2 * px, r2 + 2 * px * px, 2 * px * py, 2 * px, 2 * px, 2 * py])
    up = np.stack([4 * r2 * py, 2 * px * py, r2 + 2 * py * py, 2 * py, -2 * py, 2 * px])
    return across, up


@dataclass(frozen=True, slots=True, eq=False)
class PupilGrid:
    """What is common to all kernels of one q and side.

    Parameters
    ----------
    q : float
        Wavelength x f-number / pixel pitch.
    size : int
        Odd side of the kernels.
    """

    q: float
    size: int
    px: NDArray[np.float32]
    py: NDArray[np.float32]
    step: float
    terms: NDArray[np.float32]  # (TERMS, m, m)
    rows: NDArray[np.complex64]  # (fine * size, m)
    cols: NDArray[np.complex64]  # (m, fine * size)
    fine: int
    stop: NDArray[np.float32]  # (m, m): radius 1, edge one sample wide
    powers: NDArray[np.float32]  # (m, 4): py^0 .. py^3 by row
    sideways: NDArray[np.float32]  # (m, 4): px^0 .. px^3 by column
    cosines: NDArray[np.float32]  # of pi p t / q for p and t from the middle on
    sines: NDArray[np.float32]

    @classmethod
    def of(cls, q: float, size: int) -> PupilGrid:
        """Lay out the pupil and the transform."""
        m = min(max(math.ceil(_PERIOD * size / q), _MIN_ACROSS), _MAX_ACROSS)
        fine = min(max(math.ceil(_SAMPLING / q), _MIN_FINE), _MAX_FINE)
        step = 2.0 / m
        p = ((np.arange(m) - (m - 1) / 2.0) * step).astype(np.float32)
        px, py = np.meshgrid(p, -p)
        rho2 = px * px + py * py
        terms = np.stack(
            [rho2 * rho2, px * rho2, py * rho2, rho2, px * px - py * py, 2.0 * px * py, px, py]
        ).astype(np.float32)
        t = (np.arange(fine * size) - (fine * size - 1) / 2.0) / fine
        # rows of the image grow downwards, py grows upwards
        rows = np.exp(-1j * np.pi / q * np.outer(-t, -p)).astype(np.complex64)
        cols = np.exp(-1j * np.pi / q * np.outer(p, t)).astype(np.complex64)
        stop = np.clip((1.0 - np.sqrt(rho2)) / step + 0.5, 0.0, 1.0).astype(np.float32)
        powers, sideways = np.vander(-p, 4, increasing=True), np.vander(p, 4, increasing=True)
        phase = np.pi / q * np.outer(t[len(t) // 2 :], p[m // 2 :].astype(np.float64))
        cosines, sines = np.cos(phase).astype(np.float32), np.sin(phase).astype(np.float32)
        if m % 2:
            cosines[:, 0] *= 0.5  # the middle is its own mirror image
        return cls(q, size, px, py, step, terms, rows, cols, fine, stop, powers, sideways, cosines, sines)

    def amplitude(self, radius: float, shift: tuple[float, float]) -> NDArray[np.float32]:
        """Stop of radius 1 cut by a second circle (cat's eye), edges one sample wide."""
        if radius >= 1.0 + math.hypot(*shift) + self.step:
            return self.stop
        apart = np.sqrt((self.px - shift[0]) ** 2 + (self.py - shift[1]) ** 2)
        return (self.stop * np.clip((radius - apart) / self.step + 0.5, 0.0, 1.0)).astype(np.float32)

    def fine_light(self, g: NDArray[np.float64], amplitude: NDArray[np.float32]) -> NDArray[np.float32]:
        """Light on the finer grid, shape (fine * size, fine * size).

        Pupil and grid are even about their middles: with the wave W split into parts that are even (e) and
        odd (o) along rows and columns, the transform takes real matrices a quarter as large::

            E(y, x) = C Wee C' - S Woo S' - i (C Weo S' + S Woe C'),    C, S = cos, sin(pi p t / q)

        and only the signs change in the other three quadrants of (y, x).
        """
        wave = self._wave(g, amplitude)
        rows = _folded(np.stack([wave.real, wave.imag]), axis=1)
        (ee, eo), (oe, oo) = (_folded(part, axis=2) for part in rows)
        c, s = self.cosines, self.sines
        a, b, d, e = c @ ee @ c.T, c @ eo @ s.T, s @ oe @ c.T, s @ oo @ s.T
        u, v, x, y = a - e, b + d, a + e, d - b
        across, middle = self.fine * self.size, self.fine * self.size // 2
        light = np.empty((across, across), dtype=np.float32)
        ahead, back = slice(middle, None), slice(across - middle - 1, None, -1)
        light[back, back] = (u[0] - v[1]) ** 2 + (u[1] + v[0]) ** 2
        light[back, ahead] = (x[0] - y[1]) ** 2 + (x[1] + y[0]) ** 2
        light[ahead, back] = (x[0] + y[1]) ** 2 + (x[1] - y[0]) ** 2
        light[ahead, ahead] = (u[0] + v[1]) ** 2 + (u[1] - v[0]) ** 2
        return light

    def binned(self, light: NDArray[np.float32], size: int, away: NDArray[np.float64]) -> NDArray[np.float64]:
        """Light in the pixels of a square of odd side `size` whose middle is `away` (down, right)."""
        grid = self.fine, self.size, size
        down, right = (_pixels(*grid, float(one)) if one else _whole_pixels(*grid) for one in away)
        return np.asarray(down @ light @ right.T, dtype=np.float64)

    def light(self, g: NDArray[np.float64], amplitude: NDArray[np.float32]) -> NDArray[np.float64]:
        """Light in each pixel, shape (size, size); its sum is not 1."""
        return self._binned(self.fine_light(g, amplitude))

    def with_derivatives(
        self,
        g: NDArray[np.float64],
        amplitude: NDArray[np.float32],
        others: tuple[NDArray[np.float32], ...] = (),
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Light, and its derivatives by g and by changes `others` of the amplitude.

        Returns
        -------
        light : ndarray, shape (size, size)
        derivatives : ndarray, shape (TERMS + len(others), size, size)
        """
        unit = self._wave(g, np.ones_like(amplitude))
        wave = unit * amplitude
        field = self._field(wave)
        factor = np.complex64(1j * math.pi / self.q)
        derivatives = []
        for term in self.terms:
            change = self._field(wave * term) * factor
            derivatives.append(self._binned(2.0 * (field.real * change.real + field.imag * change.imag)))
        for other in others:
            change = self._field(unit * other)
            derivatives.append(self._binned(2.0 * (field.real * change.real + field.imag * change.imag)))
        return self._binned(field.real**2 + field.imag**2), np.stack(derivatives)

    def centre(self, g: NDArray[np.float64], amplitude: NDArray[np.float32]) -> tuple[float, float]:
        """Where the rays' centre of mass lies, (right, up) pixels, tilts left out."""
        # m[i, j]: mean of py^i px^j over the light in the pupil
        m = np.asarray(self.powers.T @ (amplitude * amplitude) @ self.sideways, dtype=np.float64)
        m /= m[0, 0]
        x3, y3 = m[0, 3] + m[2, 1], m[3, 0] + m[1, 2]
        gx = 4 * g[0] * x3 + g[1] * (3 * m[0, 2] + m[2, 0]) + 2 * g[2] * m[1, 1]
        gx = gx + 2 * (g[3] + g[4]) * m[0, 1] + 2 * g[5] * m[1, 0]
        gy = 4 * g[0] * y3 + g[2] * (m[0, 2] + 3 * m[2, 0]) + 2 * g[1] * m[1, 1]
        gy = gy + 2 * (g[3] - g[4]) * m[1, 0] + 2 * g[5] * m[0, 1]
        return float(gx), float(gy)

    def _wave(self, g: NDArray[np.float64], amplitude: NDArray[np.float32]) -> NDArray[np.complex64]:
        angle = np.tensordot((g * (math.pi / self.q)).astype(np.float32), self.terms, axes=1)
        wave = np.empty(angle.shape, dtype=np.complex64)
        np.multiply(amplitude, np.cos(angle), out=wave.real)
        np.multiply(amplitude, np.sin(angle), out=wave.imag)
        return wave

    def _field(self, wave: NDArray[np.complex64]) -> NDArray[np.complex64]:
        return np.asarray(self.rows @ wave @ self.cols)

    def _binned(self, light: NDArray[np.floating]) -> NDArray[np.float64]:
        side = self.size
        return np.asarray(light.reshape(side, self.fine, side, self.fine).sum(axis=(1, 3)), dtype=np.float64)


def _folded(planes: NDArray[np.float32], axis: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Sum and difference of the half from the middle on and its mirror image, along an axis."""
    count = planes.shape[axis]
    before = (slice(None),) * axis
    there = planes[(*before, slice(count // 2, None))]
    back = planes[(*before, slice((count - 1) // 2, None, -1))]
    return there + back, there - back


@lru_cache(maxsize=8)
def _whole_pixels(fine: int, across: int, size: int) -> NDArray[np.float32]:
    """Those of a square that has not moved, as most have not."""
    return _pixels(fine, across, size, 0.0)


def _pixels(fine: int, across: int, size: int, away: float) -> NDArray[np.float32]:
    """Weights by which samples of a finer grid make pixels, shape (size, fine * across).

    Between samples light is Lagrange's cubic through four of them. A square may reach beyond the grid by two
    samples.
    """
    whole = math.floor(away * fine)
    t = away * fine - whole
    cubic = (
        -t * (t - 1.0) * (t - 2.0) / 6.0,
        (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0,
        -(t + 1.0) * t * (t - 2.0) / 2.0,
        (t + 1.0) * t * (t - 1.0) / 6.0,
    )
    taps = np.convolve(cubic, np.ones(fine))
    first = (across - size) // 2 * fine + whole - 1
    matrix = np.zeros((size, fine * across + 2 * _RIM), dtype=np.float32)
    cols = first + _RIM + fine * np.arange(size)[:, None] + np.arange(len(taps))
    matrix[np.arange(size)[:, None], cols] = taps
    return matrix[:, _RIM:-_RIM]
