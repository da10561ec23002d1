"""The one pass of `DirectFilter`, compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.jit import jit
from lensmodel.correction.compiled.common import ONE, ZERO, Complex, Number, Real, to_plane, to_spectrum


@jit
def _restored(
    out: Real,
    i: int,
    j: int,
    gain: tuple[np.float32, np.float32, np.float32],
    rhs: tuple[np.float32, np.float32, np.float32, np.float32, np.float32, np.float32],
    luma: Number,
    chroma: Number,
) -> None:
    """Solve (diag(gain + chroma) + (luma - chroma) / 3 1 1') x = rhs at one frequency (Sherman, Morrison).

    `out`, shape (3, rows, 2 cols), and `rhs` hold real and imaginary parts in turn.
    """
    g = (luma - chroma) / np.float32(3.0)
    u, v, w = ONE / (gain[0] + chroma), ONE / (gain[1] + chroma), ONE / (gain[2] + chroma)
    t = g / (ONE + g * (u + v + w))
    for part in range(2):
        p, q, r = rhs[part], rhs[2 + part], rhs[4 + part]
        common = (p * u + q * v + r * w) * t
        out[0, i, j + part] = (p - common) * u
        out[1, i, j + part] = (q - common) * v
        out[2, i, j + part] = (r - common) * w


@jit
def one_pass(  # noqa: C901 - one pass over memory for both contrasts
    x: Real,
    y: Real,
    K: Complex,
    noise: Real,
    decay: Real,
    fine: Real,
    levels: NDArray[np.float64],
    busy: Real,
    floor: Number,
) -> None:
    """Filter three planes for two contrasts, `levels` of (luma, chroma), and mix by `busy` into `x`."""
    height, width = busy.shape
    half = width // 2 + 1
    Y = np.empty((3, height, half), np.complex64)
    X, Z = np.empty((3, height, half), np.complex64), np.empty((3, height, half), np.complex64)
    work = np.empty((height, width), np.float32)
    for c in range(3):
        to_spectrum(y[c], Y[c])
    blurred_prior = np.float64(0.0)
    for i in range(height):
        part = ZERO
        for c in range(3):
            for j in range(half):
                k = K[c, i, j]
                part += fine[i, j] * (k.real * k.real + k.imag * k.imag)
        blurred_prior += part
    blurred_prior /= 3.0
    n0, n1, n2 = ONE / noise[0], ONE / noise[1], ONE / noise[2]
    lumas, chromas = np.empty(2, np.float32), np.empty(2, np.float32)
    for level in range(2):
        lumas[level] = np.float32(blurred_prior / (height * width) / levels[level, 0])
        chromas[level] = np.float32(blurred_prior / (height * width) / levels[level, 1])
    k, yy, xx, zz = K.view(np.float32), Y.view(np.float32), X.view(np.float32), Z.view(np.float32)
    for i in range(height):
        for j in range(half):
            re, im = 2 * j, 2 * j + 1
            ar, ai, br, bi, dr, di = (
                k[0, i, re],
                k[0, i, im],
                k[1, i, re],
                k[1, i, im],
                k[2, i, re],
                k[2, i, im],
            )
            a = (ar * ar + ai * ai + floor) * n0
            b = (br * br + bi * bi + floor) * n1
            d = (dr * dr + di * di + floor) * n2
            pr = (ar * yy[0, i, re] + ai * yy[0, i, im]) * n0
            pi = (ar * yy[0, i, im] - ai * yy[0, i, re]) * n0
            qr = (br * yy[1, i, re] + bi * yy[1, i, im]) * n1
            qi = (br * yy[1, i, im] - bi * yy[1, i, re]) * n1
            rr = (dr * yy[2, i, re] + di * yy[2, i, im]) * n2
            ri = (dr * yy[2, i, im] - di * yy[2, i, re]) * n2
            w = decay[i, j]
            _restored(xx, i, re, (a, b, d), (pr, pi, qr, qi, rr, ri), w * lumas[0], w * chromas[0])
            _restored(zz, i, re, (a, b, d), (pr, pi, qr, qi, rr, ri), w * lumas[1], w * chromas[1])
    for c in range(3):
        X[c, 0, 0] = Y[c, 0, 0]
        Z[c, 0, 0] = Y[c, 0, 0]
        to_plane(X[c], x[c])
        to_plane(Z[c], work)
        for i in range(height):
            for j in range(width):
                x[c, i, j] = work[i, j] + busy[i, j] * (x[c, i, j] - work[i, j])
