"""One pass: a linear filter of each colour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.numerics import jit
from lensmodel.core.types import Plane, Planes
from lensmodel.correction.blur import (
    ONE,
    ZERO,
    Canvas,
    Complex,
    Real,
    UniformBlur,
    block_sums,
    interpolated,
    smooth,
    to_plane,
    to_spectrum,
    transfers,
)
from lensmodel.correction.deconvolver import Sensor, Solution
from lensmodel.correction.expected_gain import frequency_squared, noise_power, ring_power, scene_law
from lensmodel.correction.posterior import GRID
from lensmodel.correction.richardson_lucy import Lights, fill_canvas

_TEXTURE: Final = np.float32(0.87)  # t, see `DirectFilter` (chosen as `cell._SHARE` is)
_LIGHT_STEPS, _OUTSIDE_STEPS = 15, 10
"""Steps that estimate the light of clipped pixels, and that from beyond the frame (chosen)."""
_FLOOR: Final = np.float32(1e-3)
"""Squared error of K within a cell (chosen: without it strong frequencies come back as ripples)."""

_SURE: Final = np.float32(2.0)
"""Times what a change costs in noise up to which none is made (chosen: less leaves grain in shadows)."""
_CAREFUL: Final = 3.0
"""Times its noise that a cell is filtered for (chosen: of 1, 3 and 8 the most that costs no gain)."""
_EVERY: Final = 4  # of the rows and columns suffices for a mean
_BLOCK: Final = 4  # pixels over which a change is compared with its noise: coarser than detail (chosen)
_AROUND: Final = np.array([1.0, 4.0, 4.0, 4.0, 1.0], dtype=np.float32)  # of blocks: 16 pixels (chosen)


@dataclass(frozen=True, slots=True)
class DirectFilter:
    r"""Wiener's filter of each colour (N. Wiener, 1949), with a part of the grain that it takes.

    With S = c |f|^-a the power of the scene in the very cell (`expected_gain.scene_law`) and n its noise::

        X = G Y,    G = W + t ( 1 - K W ),    W = conj(K) S / ( |K|² S + n )

    A cell has calm places beside busy ones. The share w of the change x - y with the least expected error is
    1 - n mean( |G|² - Re G ) / mean (x - y)², by means over all frequencies and around each place, if the
    scene changes as it should; twice that cost in noise is reckoned with::

        result = y + w ( x - y ),    w within 0..1

    Of a mosaic, what demosaicing made of it is filtered.
    """

    cell_factor = 2
    """Cells may be larger: a filter that is quick has no use for kernels that are exact everywhere."""

    def deconvolve(self, blurred: Plane, blur: UniformBlur, *, sensor: Sensor) -> Plane:
        """Deconvolve one plane; see `Deconvolver`."""
        return self.deconvolve_planes(blurred[None], [blur], [sensor]).planes[0]

    def deconvolve_planes(
        self, blurred: Planes, blurs: Sequence[UniformBlur], sensors: Sequence[Sensor]
    ) -> Solution:
        """Restore the colours together; see `restore_planes`."""
        lights = Lights.of(blurred, blurs, sensors, _LIGHT_STEPS)
        photo, blurred = blurred, np.ascontiguousarray(blurred if lights is None else lights.rest)
        canvas = Canvas.around(blurred, blurs, surrounded=all(sensor.surrounded for sensor in sensors))
        K, _ = transfers(blurs, canvas.shape, 1.0)
        unit = np.ones(len(blurred), dtype=np.float32)
        x = fill_canvas(canvas, blurred, unit, K, blurs, sensors, _OUTSIDE_STEPS)
        part = blurred[:, ::_EVERY, ::_EVERY]
        noise = np.array([s.noise.variance(p).mean() for s, p in zip(sensors, part, strict=True)])
        # of the usual part of the cell, not of its lamps
        usual = np.exp(np.log(np.maximum(ring_power(blurred), 1e-12)).mean(axis=1))
        powers = [noise_power(n, c, mosaic=sensors[c].measured is not None) for c, n in enumerate(noise)]
        passed = [np.abs(blur.spectrum(GRID)) ** 2 for blur in blurs]
        laws = np.array([scene_law(*each) for each in zip(usual, passed, powers, strict=True)])
        slope = round(2.0 * laws[:, 1].mean()) / 2.0  # few enough to keep their powers
        over = (_CAREFUL * np.maximum(noise, 1e-12) / laws[:, 0]).astype(np.float32)
        amplified = np.empty(len(x), dtype=np.float32)
        _filter(x, K, over, _rise(canvas.shape, slope), amplified)
        shot, read = np.array([[s.noise.shot, s.noise.read] for s in sensors], dtype=np.float32).T * amplified
        restored = _where_it_stands_out(blurred, x[:, *canvas.data], shot, read)
        return Solution(restored if lights is None else lights.put_back(photo, restored))


@jit
def _filter(x: Real, K: Complex, over: Real, rise: Real, amplified: Real) -> None:
    """Filter planes in place; `over` times `rise` is n / S, and `amplified` receives mean( |G|² - Re G )."""
    height, half = rise.shape
    X = np.empty((height, half), np.complex64)
    for c in range(x.shape[0]):
        to_spectrum(x[c], X)
        mean = X[0, 0]
        amplified[c] = ZERO
        for i in range(height):
            changed = ZERO
            for j in range(half):
                k, ratio = K[c, i, j], over[c] * rise[i, j]
                scale = ONE / (k.real * k.real + k.imag * k.imag + _FLOOR + ratio)
                gain = (np.conj(k) + _TEXTURE * ratio) * scale
                changed += gain.real * gain.real + gain.imag * gain.imag - gain.real
                X[i, j] *= gain
            amplified[c] += changed / np.float32(height * half)
        X[0, 0] = mean
        to_plane(X, x[c])


def _where_it_stands_out(y: Planes, x: Planes, shot: Real, read: Real) -> Planes:
    """Mix planes and their filtered ones by what the change costs in noise."""
    change, number = x - y, np.float32(len(y))
    expected = np.einsum("c,cij", shot, np.maximum(y, ZERO)) + read.sum()
    power, cost = (
        smooth(block_sums(plane, _BLOCK), _AROUND)
        for plane in (np.square(change.sum(axis=0) / number), expected / number**2)
    )
    share: Real = np.clip(ONE - _SURE * cost / np.maximum(power, np.float32(1e-20)), ZERO, ONE)
    change *= interpolated(share, _BLOCK, *y.shape[1:])
    return y + change


@lru_cache(maxsize=16)
def _rise(shape: tuple[int, int], slope: float) -> NDArray[np.float32]:
    """|f|^a, one over the power of a scene."""
    return np.ascontiguousarray(frequency_squared(shape) ** np.float32(0.5 * slope), dtype=np.float32)
