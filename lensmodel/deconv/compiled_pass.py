"""The one pass of `DirectFilter`, compiled."""

from __future__ import annotations

import numpy as np
import rocket_fft
from numpy.typing import NDArray

from lensmodel.deconv.compiled_base import BACK, FORWARD, ONE, ZERO, Complex, Real, jit


@jit
def one_pass(  # noqa: C901 - one pass over memory per loop
    x: Real,
    y: Real,
    K: Complex,
    noise: Real,
    decay: Real,
    fine: Real,
    levels: NDArray[np.float64],
    busy: Real,
    floor: float,
) -> None:
    """Filter three planes for two contrasts, `levels` of (luma, chroma), and mix by `busy` into `x`."""
    height, width = busy.shape
    half = width // 2 + 1
    axes = np.array([0, 1])
    norm = 1.0 / (height * width)
    Y = np.empty((3, height, half), np.complex64)
    X = np.empty((3, height, half), np.complex64)
    work = np.empty((height, width), np.float32)
    for c in range(3):
        rocket_fft.r2c(y[c], Y[c], axes, FORWARD, 1.0, 1)
    seen = np.float64(0.0)
    for i in range(height):
        part = ZERO
        for c in range(3):
            for j in range(half):
                k = K[c, i, j]
                part += fine[i, j] * (k.real * k.real + k.imag * k.imag)
        seen += part
    seen /= 3.0
    n0, n1, n2 = ONE / noise[0], ONE / noise[1], ONE / noise[2]
    for level in range(2):
        luma = np.float32(seen / (height * width) / levels[level, 0])
        chroma = np.float32(seen / (height * width) / levels[level, 1])
        for i in range(height):
            for j in range(half):
                a, b, d = K[0, i, j], K[1, i, j], K[2, i, j]
                s = decay[i, j] * chroma
                g = decay[i, j] * ((luma - chroma) / np.float32(3.0))
                u = ONE / ((a.real * a.real + a.imag * a.imag + floor) * n0 + s)
                v = ONE / ((b.real * b.real + b.imag * b.imag + floor) * n1 + s)
                w = ONE / ((d.real * d.real + d.imag * d.imag + floor) * n2 + s)
                p = np.conj(a) * Y[0, i, j] * (n0 * u)
                q = np.conj(b) * Y[1, i, j] * (n1 * v)
                r = np.conj(d) * Y[2, i, j] * (n2 * w)
                t = (p + q + r) * (g / (ONE + g * (u + v + w)))
                X[0, i, j] = p - t * u
                X[1, i, j] = q - t * v
                X[2, i, j] = r - t * w
        for c in range(3):
            X[c, 0, 0] = Y[c, 0, 0]
            if level == 0:
                rocket_fft.c2r(X[c], x[c], axes, BACK, norm, 1)
            else:
                rocket_fft.c2r(X[c], work, axes, BACK, norm, 1)
                for i in range(height):
                    for j in range(width):
                        x[c, i, j] = work[i, j] + busy[i, j] * (x[c, i, j] - work[i, j])
