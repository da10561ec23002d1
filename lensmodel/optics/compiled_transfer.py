"""The sums of `transfer` over the pupil, compiled; imported only where Numba is installed.

Nothing is loaded but the pupil's points: phases and transmissions are cheaper to compute than to read.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.jit import jit

# In single precision, so that no sum is made in double.
_HALF, _ONE, _TWO = np.float32(0.5), np.float32(1.0), np.float32(2.0)
# Of sin(pi x) and cos(pi x) for |x| <= 1/2, by least squares: within 2e-6.
_S1, _S3, _S5, _S7 = (np.float32(v) for v in (3.1415847, -5.16724542, 2.54284755, -0.55707962))
_C0, _C2, _C4 = (np.float32(v) for v in (0.99999997, -4.93479493, 4.05845981))
_C6, _C8 = np.float32(-1.33222587), np.float32(0.22046276)


@jit
def sums(  # noqa: PLR0915 - one accumulator a column: arrays of them are not kept in registers
    px: NDArray[np.float32],
    py: NDArray[np.float32],
    fx: NDArray[np.float32],
    fy: NDArray[np.float32],
    blur: NDArray[np.float32],
    eye: NDArray[np.float32],
    steep: np.float32,
    out: NDArray[np.float32],
) -> None:
    """Fill `out`, shape (F, 20), for F shifts (fx, fy) = q f of the pupil.

    Columns: real and imaginary sum; the real one by six terms, the imaginary one by them; the real one
    by three numbers of the cat's eye, the imaginary one by them.

    Parameters
    ----------
    px, py : ndarray of float32, shape (P,)
        Points of the pupil.
    blur : ndarray of float32, shape (6,)
        Coefficients of the terms, in turns at the points: blur / (2 q).
    eye : ndarray of float32, shape (3,)
        Radius and middle of the second circle.
    steep : float32
        Slope of the edge of a circle.
    """
    b0, b1, b2, b3, b4, b5 = blur[0], blur[1], blur[2], blur[3], blur[4], blur[5]
    radius2, sx, sy = eye[0] * eye[0], eye[1], eye[2]
    slope, over, rim = steep / (_TWO * eye[0]), _ONE / eye[0], steep * _HALF
    zero = np.float32(0.0)
    for f in range(fx.size):
        gx, gy = fx[f], fy[f]
        re = im = zero
        r0 = r1 = r2 = r3 = r4 = r5 = zero
        i0 = i1 = i2 = i3 = i4 = i5 = zero
        u0 = u1 = u2 = v0 = v1 = v2 = zero
        for p in range(px.size):
            ax, ay, bx, by = px[p] + gx, py[p] + gy, px[p] - gx, py[p] - gy
            ra, rb = ax * ax + ay * ay, bx * bx + by * by
            stop_a = min(max((_ONE - ra) * rim + _HALF, zero), _ONE)
            stop_b = min(max((_ONE - rb) * rim + _HALF, zero), _ONE)
            cx, cy, dx, dy = ax - sx, ay - sy, bx - sx, by - sy
            edge_a = (radius2 - cx * cx - cy * cy) * slope + _HALF
            edge_b = (radius2 - dx * dx - dy * dy) * slope + _HALF
            eye_a, eye_b = min(max(edge_a, zero), _ONE), min(max(edge_b, zero), _ONE)
            soft_a = steep if zero < edge_a < _ONE else zero
            soft_b = steep if zero < edge_b < _ONE else zero
            stop = stop_a * stop_b
            t0, t1, t2 = ra * ra - rb * rb, ax * ra - bx * rb, ay * ra - by * rb
            t3, t4 = ra - rb, (ax * ax - ay * ay) - (bx * bx - by * by)
            t5 = _TWO * (ax * ay - bx * by)
            turns = b0 * t0 + b1 * t1 + b2 * t2 + b3 * t3 + b4 * t4 + b5 * t5
            x = turns - np.float32(math.floor(turns + _HALF))
            x2 = x * x
            sine = x * (_S1 + x2 * (_S3 + x2 * (_S5 + x2 * _S7)))
            cosine = _C0 + x2 * (_C2 + x2 * (_C4 + x2 * (_C6 + x2 * _C8)))
            sin_turn, cos_turn = _TWO * sine * cosine, _ONE - _TWO * sine * sine
            both = stop * eye_a * eye_b
            real, imaginary = both * cos_turn, both * sin_turn
            re += real
            im += imaginary
            r0 -= t0 * imaginary
            r1 -= t1 * imaginary
            r2 -= t2 * imaginary
            r3 -= t3 * imaginary
            r4 -= t4 * imaginary
            r5 -= t5 * imaginary
            i0 += t0 * real
            i1 += t1 * real
            i2 += t2 * real
            i3 += t3 * real
            i4 += t4 * real
            i5 += t5 * real
            change_a, change_b = stop * soft_a * eye_b, stop * soft_b * eye_a
            w0 = change_a + change_b
            w1 = (change_a * cx + change_b * dx) * over
            w2 = (change_a * cy + change_b * dy) * over
            u0 += w0 * cos_turn
            u1 += w1 * cos_turn
            u2 += w2 * cos_turn
            v0 += w0 * sin_turn
            v1 += w1 * sin_turn
            v2 += w2 * sin_turn
        row = out[f]
        row[0], row[1] = re, im
        row[2], row[3], row[4], row[5], row[6], row[7] = r0, r1, r2, r3, r4, r5
        row[8], row[9], row[10], row[11], row[12], row[13] = i0, i1, i2, i3, i4, i5
        row[14], row[15], row[16], row[17], row[18], row[19] = u0, u1, u2, v0, v1, v2
