"""The light that falls on a window of the page, separated from the detail of the page itself.

The mean of noise over a part of a window is not quite that of the page: a quadratic fitted to the photo
alone follows the slow waves of the noise itself, and a hundredth of wrong light over a window becomes a tenth
of wrong kernel in its wings. What is printed is known, so with a kernel k that is nearly right

    y(p) = sum_j e_j (k * (q_j R))(p) + sum_j c_j q_j(p) + n(p)

is linear in e_j, the light, and c_j, what the lens and its reflections lay over it; q_j are the terms of
`quadratic`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.types import Kernel
from lensmodel.estimation.measure.smooth import quadratic

_FEWEST: Final = 64  # pixels: five times as many as there are terms


@dataclass(frozen=True, slots=True, eq=False)
class Illumination:
    """A quadratic in row and column whose mean over its square window is 1.

    Parameters
    ----------
    terms : ndarray, shape (6,)
        Of `quadratic`, in sides of the window from its middle.
    side : int
        Side of the window in pixels.
    """

    terms: NDArray[np.float64]
    side: int

    @classmethod
    def even(cls, side: int) -> Illumination:
        """Return light that is the same everywhere."""
        return cls(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]), side)

    def __call__(self, margin: int) -> NDArray[np.float64]:
        """Return the light of the window and of a margin around it."""
        return _terms(self.side, margin) @ self.terms


def fitted_light(
    observed: NDArray[np.floating], measured: NDArray[np.bool_], page: NDArray[np.floating], kernel: Kernel
) -> Illumination:
    """Fit the light of a window.

    Parameters
    ----------
    observed : ndarray, shape (side, side)
        Linear light.
    measured : ndarray of bool, shape (side, side)
        Which pixels count.
    page : ndarray, shape (side + k - 1, side + k - 1)
        What the window shows without blur in even light, where it lies.
    kernel : Kernel, shape (k, k)
        Nearly the PSF.

    Raises
    ------
    NotEnoughEvidenceError
        If too few pixels count, or no light explains the window.
    """
    side = observed.shape[0]
    if int(measured.sum()) < _FEWEST:
        raise NotEnoughEvidenceError("nearly all pixels of a window are clipped; expose less")
    outer, inner = _terms(side, kernel.shape[0] // 2), _terms(side, 0)
    lit = [scipy.signal.fftconvolve(page * outer[..., j], kernel, mode="valid")[measured] for j in range(6)]
    basis = np.stack([*lit, *(inner[..., j][measured] for j in range(6))], axis=-1)
    terms, *_ = np.linalg.lstsq(basis, np.asarray(observed[measured], dtype=np.float64), rcond=None)
    light = inner @ terms[:6]
    if not float(light.min()) > 0.0:
        raise NotEnoughEvidenceError("a window of the page is black, or does not show the page; light it")
    return Illumination(np.asarray(terms[:6] / float(light.mean())), side)


def _terms(side: int, margin: int) -> NDArray[np.float64]:
    t = (np.arange(-margin, side + margin) - (side - 1) / 2.0) / side
    return quadratic(t[:, None], t[None, :])
