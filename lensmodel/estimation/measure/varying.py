"""The PSF of a window in which it changes, at the phase between pixels that fits best.

Within a window the kernel is linear in the place, with u and v from -1 to 1 over its rows and columns:

    y(p) = sum_t (k(t) + u k_u(t) + v k_v(t)) x(p - t) + c(p) + n(p)

k_u and k_v have the prior of `solve` with `CHANGE` of its width. What they explain is taken out of the
normal equations (Schur's complement), so that k is found as if it were the same everywhere.

A kernel that is not negative on one grid of pixels is so on no other, if it has a peak as narrow as a
pixel: moved by half a pixel, the peak rings along its row and column, k >= 0 cuts one half of that off, and
the rest is explained by something else. So the grid is fitted as well: X S(d) k is compared with y, where
S(d) moves a kernel by d pixels (by sinc, which is exact for a picture without frequencies beyond the
pixels'), and d minimises the misfit. Where the kernel is smooth, any d will do, and a weak prior keeps its
centre of mass in the middle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import as_kernel, centroid
from lensmodel.estimation.measure.smooth import Smooth
from lensmodel.estimation.measure.solve import (
    Solved,
    bounded,
    error_of,
    means_of_latent,
    of_sum,
    prior_width,
    require_fit,
    weighted_mean,
    weights_of,
)

CHANGE: Final = 0.3
"""Width of the prior of k_u and k_v over that of k (chosen: at three times as much nothing changed;
measured once, no command repeats it)."""

CENTRED_PX: Final = 0.3
"""How far from the middle the centre of mass is expected, where the misfit does not tell: the match before it
is as sure; much more and the phase is left open (chosen)."""

_ROWS: Final = 2048  # of the design matrix at once: a whole window would take hundreds of megabytes (chosen)
_STEPS_PX: Final = (0.25, 0.1, 0.04)
"""Of the search for the phase, coarse to fine: the first crosses a pixel in four, each next one looks around
where the last ended (chosen)."""
_MOST_PX: Final = 1.0
"""Largest phase along an axis: kernels come here centred, a whole pixel is another match (chosen)."""
_MOST_MOVES: Final = 24  # with one step, at most: enough to cross the whole square of phases (chosen)
_SEARCHED: Final = 100
"""Steps from one phase to the next: their kernels are alike, and only their order counts (chosen)."""


@dataclass(frozen=True, slots=True)
class _Equations:
    """Normal equations of the kernel in the middle: k'Ak/2 - b'k, and y'Wy."""

    a: NDArray[np.float64]
    b: NDArray[np.float64]
    power: float


def solve_varying(
    observed: NDArray[np.floating],
    latent: NDArray[np.floating],
    measured: NDArray[np.bool_],
    variance: NDArray[np.floating],
    size: int,
) -> Solved:
    """Find the kernel in the middle of a window; parameters, result and errors are those of `solve`.

    The latent picture has no noise. The kernel needs no centring: it lies on the grid that fits best.
    """
    require_fit(observed, latent, measured, size)
    weight = weights_of(measured, variance)
    a, b, power = _normal_equations(observed, latent, weight, size)
    prior = 1.0 / prior_width(size) ** 2
    count, misfit = int(measured.sum()), 1.0
    values = np.zeros(size * size)
    for _ in range(2):  # the second time with the residuals of the first
        eq = _without_change(a / misfit, b / misfit, power / misfit, prior)
        values = bounded(eq.a + np.diag(prior), eq.b, values)
        rest = eq.power - 2.0 * float(eq.b @ values) + float(values @ eq.a @ values)
        misfit = max(misfit * rest / count, 1.0)
    eq = _without_change(a / misfit, b / misfit, power / misfit, prior)
    values, moved = _on_its_grid(eq, prior, values, size)
    light = float(values.sum())
    if not light > 0.0:
        raise NotEnoughEvidenceError("no kernel explains this window; the latent picture does not match it")
    kernel = as_kernel(values.reshape(size, size))
    off = centroid(kernel)
    offset = weighted_mean(observed, weight) - float(means_of_latent(latent, weight, size) @ values)
    return Solved(
        kernel=kernel,
        light=light,
        offset=offset,
        shift=(off[0] + moved[0], off[1] + moved[1]),
        error=error_of(eq.a + np.diag(prior), values),
        misfit=misfit,
    )


def _normal_equations(
    observed: NDArray[np.floating], latent: NDArray[np.floating], weight: NDArray[np.float64], size: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """X'WX, X'Wy and y'Wy of k, k_u and k_v, after slow changes were taken out."""
    smooth = Smooth.of(observed, latent, weight, size)
    views = sliding_window_view(np.asarray(latent, dtype=np.float32), (size, size))[:, :, ::-1, ::-1]
    u, v = (np.linspace(-1.0, 1.0, n, dtype=np.float32) for n in weight.shape)
    rows, cols = np.nonzero(weight)
    n = size * size
    a, b, power = np.zeros((3 * n, 3 * n)), np.zeros(3 * n), 0.0
    for first in range(0, rows.size, _ROWS):
        part = rows[first : first + _ROWS], cols[first : first + _ROWS]
        root = np.sqrt(weight[part]).astype(np.float32)
        x = np.empty((root.size, 3 * n), dtype=np.float32)
        x[:, :n] = smooth.out_of_x(views[part].reshape(root.size, -1), part) * root[:, None]
        x[:, n : 2 * n] = x[:, :n] * u[part[0], None]
        x[:, 2 * n :] = x[:, :n] * v[part[1], None]
        y = smooth.out_of_y(observed[part], part) * root
        a += x.T @ x
        b += x.T @ y
        power += float(y @ y)
    return a, b, power


def _without_change(
    a: NDArray[np.float64], b: NDArray[np.float64], power: float, prior: NDArray[np.float64]
) -> _Equations:
    """Eliminate k_u and k_v."""
    n = len(prior)
    inner = a[n:, n:] + np.diag(np.tile(prior / CHANGE**2, 2))
    right = np.concatenate([a[n:, :n], b[n:, None]], axis=1)
    solved = scipy.linalg.solve(inner, right, assume_a="sym", check_finite=False)
    return _Equations(
        a[:n, :n] - a[:n, n:] @ solved[:, :n],
        b[:n] - a[:n, n:] @ solved[:, n],
        power - float(b[n:] @ solved[:, n]),
    )


def _on_its_grid(
    eq: _Equations, prior: NDArray[np.float64], start: NDArray[np.float64], size: int
) -> tuple[NDArray[np.float64], tuple[float, float]]:
    """Kernel and phase (row, col) in pixels at which k >= 0 explains the window best."""
    light = float(start.sum())
    # moving a kernel by sinc lengthens none; the prior is the same for all
    largest = 1.02 * float(
        scipy.linalg.eigvalsh(eq.a + np.diag(prior), subset_by_index=(len(prior) - 1,) * 2)[0]
    )
    known: dict[tuple[float, float], tuple[float, NDArray[np.float64]]] = {}

    def cost(phase: tuple[float, float], near: NDArray[np.float64]) -> float:
        if phase not in known:
            a, b = _moved(eq, phase, size)
            k = of_sum(a + np.diag(prior), b, near, light, largest, _SEARCHED)
            off = centroid(as_kernel(k.reshape(size, size)))
            misfit = float(k @ a @ k) - 2.0 * float(b @ k) + float(prior @ (k * k))
            known[phase] = misfit + (off[0] ** 2 + off[1] ** 2) / CENTRED_PX**2, k
        return known[phase][0]

    best = (0.0, 0.0)
    cost(best, start)
    for step in _STEPS_PX:
        for _ in range(_MOST_MOVES):
            around = [
                (round(best[0] + i * step, 3), round(best[1] + j * step, 3))
                for i, j in ((-1, 0), (1, 0), (0, -1), (0, 1))
            ]
            inside = [phase for phase in around if max(map(abs, phase)) <= _MOST_PX]
            better = min(inside, key=lambda phase: cost(phase, known[best][1]))
            if known[better][0] >= known[best][0]:
                break
            best = better
    return known[best][1], best


def _moved(
    eq: _Equations, phase: tuple[float, float], size: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """S'AS and S'b, axis by axis."""
    down, across = _sinc(phase[0], size), _sinc(phase[1], size)
    n = size * size

    def left(m: NDArray[np.float64]) -> NDArray[np.float64]:
        rows = (down.T @ m.reshape(size, -1)).reshape(size, size, -1)
        return np.asarray(np.matmul(across.T, rows).reshape(n, -1))

    return left(left(eq.a).T), left(eq.b[:, None])[:, 0]


def _sinc(by: float, size: int) -> NDArray[np.float64]:
    """Matrix that moves a row of a kernel by so many pixels."""
    t = np.arange(size)
    return np.asarray(np.sinc(t[:, None] - t[None, :] - by))
