"""The PSF between a photo and the sharp picture that it shows: weighted least squares.

For the pixels p that the sensor measured in a window,

    y(p) = sum_u k(u) x(p - u) + c(p) + n(p)          var n(p) = s(p)²

so that only the latent picture x must be known everywhere, and a mosaic needs no demosaicing; c changes
slowly over the window and is taken out of both sides (`Smooth`). Every
value of the kernel has a prior, normal with mean 0, whose width falls with the distance d to the middle
as the light of a lens does:

    t(d) = T / (1 + (d / D)²)

The kernel is the minimum of  sum_p (y - k * x - c)² / (q s²) + sum_u k(u)² / t(u)²  over all k >= 0 whose sum
is that of the minimum over all k, where q >= 1 is the mean of the squared residuals over what the noise
explains. Without the sum, k >= 0 alone would cut off one half of the noise and keep the other: hundreds of
values around a small core then add up to a halo that is not there. (Where the latent picture has noise of its
own, which is taken off, the free minimum is not determined, and k >= 0 is all.) Its expected error is

    e² = trace (X'X / q + diag(1 / t²))^-1 / |k|².

Sources: N. Joshi et al., "PSF estimation using sharp edge prediction", CVPR 2008, section 4 (known
sharp picture, non-negative least squares); M. Delbracio et al., "The non-parametric sub-pixel local
point spread function estimation is a well posed problem", IJCV 96, 2012, section 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError, NotEnoughEvidenceError
from lensmodel.core.least_squares import nonnegative_least_squares
from lensmodel.core.psf import as_kernel, centroid
from lensmodel.core.types import Kernel
from lensmodel.estimation.measure.smooth import Smooth

PEAK: Final = 0.5
"""T: the middle of the sharpest kernel, a pixel's box and some diffraction, holds about as much light."""
REACH: Final = 2.5
"""D in pixels: light 10 px away is expected below 3 percent a pixel, ten times what wide halos have."""

_ROWS: Final = 4096  # at once: the design matrix of a window would take hundreds of megabytes
_STEPS: Final = 300
"""Of the projected gradient, whose error falls with the square of their number: more only cost time
(chosen)."""
_STILL: Final = 1e-7  # of the light: no value moves by more
_WORST: Final = 1.0  # an error beyond it says that nothing was measured


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """A kernel and how well it explains its window.

    Parameters
    ----------
    kernel : Kernel, shape (k, k)
        Not centred.
    light : float
        Sum of the kernel before it was normalised: what the latent picture must be multiplied with.
    offset : float
        The mean of c.
    shift : tuple of float
        Its centre of mass, (row, col) pixels from the middle.
    error : float
        Expected relative L2.
    misfit : float
        Mean squared residual over that of the noise: q.
    """

    kernel: Kernel
    light: float
    offset: float
    shift: tuple[float, float]
    error: float
    misfit: float


def solve(
    observed: NDArray[np.floating],
    latent: NDArray[np.floating],
    measured: NDArray[np.bool_],
    variance: NDArray[np.floating],
    size: int,
    latent_noise: NDArray[np.floating] | None = None,
    *,
    even: bool = False,
) -> Solved:
    """Find the kernel that makes the latent picture the observed one.

    Parameters
    ----------
    observed : ndarray, shape (H, W)
        Linear light.
    latent : ndarray, shape (H + size - 1, W + size - 1)
        What the photo shows without blur, with a margin of half a kernel.
    measured : ndarray of bool, shape (H, W)
        Which pixels count.
    variance : ndarray, shape (H, W)
        Of the noise of `observed`.
    size : int
        Odd side of the kernel.
    latent_noise : ndarray, shape (2 size - 1, 2 size - 1), optional
        Autocovariance of the noise that the latent picture has itself; it is taken off the normal
        equations, or noise would be taken for picture and the kernel come out too wide.
    even : bool
        Whether c is the same all over the window, as it has to be where that is hardly wider than the kernel.

    Raises
    ------
    InvalidInputError
        If the shapes do not fit each other.
    NotEnoughEvidenceError
        If fewer pixels count than the kernel has, or no kernel explains them.
    """
    require_fit(observed, latent, measured, size)
    weight = weights_of(measured, variance)
    a, b, power = _normal_equations(observed, latent, weight, size, even=even)
    if latent_noise is not None:
        a -= stationary(latent_noise, size) * weight.sum()
    prior = np.diag(1.0 / prior_width(size) ** 2)
    count = int(measured.sum())
    misfit = 1.0
    start = np.zeros(size * size)
    for _ in range(2):  # the second time with the residuals of the first
        if latent_noise is None:
            k = bounded(a / misfit + prior, b / misfit, start)
        else:  # less its noise a latent picture leaves directions open, and the free minimum's sum with them
            k = nonnegative_least_squares(a / misfit + prior, b / misfit, start, _STEPS)
        misfit = max((power - 2.0 * float(b @ k) + float(k @ a @ k)) / count, 1.0)
        start = k
    light = float(k.sum())
    if not light > 0.0:
        raise NotEnoughEvidenceError("no kernel explains this window; the latent picture does not match it")
    kernel = as_kernel(k.reshape(size, size))
    mean_y, mean_x = weighted_mean(observed, weight), means_of_latent(latent, weight, size)
    return Solved(
        kernel=kernel,
        light=light,
        offset=mean_y - float(mean_x @ k),
        shift=centroid(kernel),
        error=error_of(a / misfit + prior, k),
        misfit=misfit,
    )


def require_fit(
    observed: NDArray[np.floating], latent: NDArray[np.floating], measured: NDArray[np.bool_], size: int
) -> None:
    """Refuse shapes that do not fit each other, and too few pixels; see `solve`."""
    if size < 3 or size % 2 == 0 or latent.shape != tuple(n + size - 1 for n in observed.shape):
        raise InvalidInputError(
            f"a latent picture of {latent.shape} does not fit a window of {observed.shape} and kernels of "
            f"{size}"
        )
    if int(measured.sum()) < size * size:
        raise NotEnoughEvidenceError(
            f"{int(measured.sum())} pixels count, {size * size} are needed for a kernel of side {size}"
        )


def weights_of(measured: NDArray[np.bool_], variance: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return one over the variance of each pixel, 0 where it does not count."""
    return np.where(measured, 1.0 / np.maximum(variance, 1e-12), 0.0)


def bounded(
    a: NDArray[np.float64], b: NDArray[np.float64], start: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Minimise k'Ak/2 - b'k over k >= 0 of the free minimum's sum."""
    eigenvalues = np.linalg.eigvalsh(a)
    largest = float(eigenvalues[-1])
    lift = max(1e-6 * largest - float(eigenvalues[0]), 0.0)  # single precision may leave it indefinite
    a = a + lift * np.eye(len(b))
    light = float(scipy.linalg.solve(a, b, assume_a="pos").sum())
    if not light > 0.0:
        raise NotEnoughEvidenceError("no kernel explains this window; the latent picture does not match it")
    return of_sum(a, b, start, light, largest + lift)


def of_sum(
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    start: NDArray[np.float64],
    light: float,
    largest: float,
    steps: int = _STEPS,
) -> NDArray[np.float64]:
    """Minimise k'Ak/2 - b'k over k >= 0 of sum `light` by accelerated projected gradients.

    `largest` bounds the eigenvalues of A.
    """
    step = 1.0 / largest
    k, momentum, t = start.copy(), start.copy(), 1.0
    for _ in range(steps):
        after = _on_simplex(momentum - step * (a @ momentum - b), light)
        t_next = 0.5 * (1.0 + math.sqrt(1.0 + 4.0 * t * t))
        momentum = after + (t - 1.0) / t_next * (after - k)
        if float(np.abs(after - k).max()) < _STILL * light:
            return after
        k, t = after, t_next
    return k


def _on_simplex(values: NDArray[np.float64], total: float) -> NDArray[np.float64]:
    """Nearest values that are not negative and have this sum.

    Source: J. Duchi et al., "Efficient projections onto the l1-ball for learning in high dimensions",
    ICML 2008, figure 1.
    """
    falling = np.sort(values)[::-1]
    excess = (np.cumsum(falling) - total) / np.arange(1, len(values) + 1)
    last = int(np.nonzero(falling > excess)[0][-1])
    return np.asarray(np.maximum(values - excess[last], 0.0))


def _normal_equations(
    observed: NDArray[np.floating],
    latent: NDArray[np.floating],
    weight: NDArray[np.float64],
    size: int,
    *,
    even: bool,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """X'WX, X'Wy and y'Wy after slow changes were taken out of both."""
    smooth = Smooth.of(observed, latent, weight, size, even=even)
    views = sliding_window_view(np.asarray(latent, dtype=np.float32), (size, size))[:, :, ::-1, ::-1]
    rows, cols = np.nonzero(weight)
    a, b, power = np.zeros((size * size, size * size)), np.zeros(size * size), 0.0
    for first in range(0, rows.size, _ROWS):
        part = rows[first : first + _ROWS], cols[first : first + _ROWS]
        root = np.sqrt(weight[part]).astype(np.float32)
        x = smooth.out_of_x(views[part].reshape(root.size, -1), part) * root[:, None]
        y = smooth.out_of_y(observed[part], part) * root
        a += x.T @ x
        b += x.T @ y
        power += float(y @ y)
    return a, b, power


def weighted_mean(values: NDArray[np.floating], weight: NDArray[np.float64]) -> float:
    """Return the mean of values that count by their weight."""
    return float((values * weight).sum() / weight.sum())


def means_of_latent(
    latent: NDArray[np.floating], weight: NDArray[np.float64], size: int
) -> NDArray[np.float64]:
    """Return the weighted mean of x(p - u) for each u, in the order of the kernel's values."""
    height, width = weight.shape
    means = np.empty((size, size))
    for i in range(size):
        for j in range(size):
            part = latent[size - 1 - i : size - 1 - i + height, size - 1 - j : size - 1 - j + width]
            means[i, j] = np.vdot(part, weight)
    return means.ravel() / weight.sum()


def stationary(covariance: NDArray[np.floating], size: int) -> NDArray[np.float64]:
    """Return the covariance of all values of a window of `size` pixels, shape (k², k²)."""
    rows, cols = np.divmod(np.arange(size * size), size)
    return np.asarray(
        covariance[rows[:, None] - rows + size - 1, cols[:, None] - cols + size - 1], dtype=np.float64
    )


def prior_width(size: int) -> NDArray[np.float64]:
    """Return t(d), shape (k²,)."""
    t = np.arange(size) - size // 2
    return (PEAK / (1.0 + (t[:, None] ** 2 + t[None, :] ** 2) / REACH**2)).ravel()


def error_of(precision: NDArray[np.float64], k: NDArray[np.float64]) -> float:
    """Return the root of the posterior variance of all values over the norm of the kernel."""
    try:
        inverse = scipy.linalg.inv(precision, check_finite=False)
    except scipy.linalg.LinAlgError:
        return _WORST
    variance = float(np.maximum(np.diag(inverse), 0.0).sum())
    return min(math.sqrt(variance / float(k @ k)), _WORST)
