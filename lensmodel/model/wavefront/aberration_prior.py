"""What is expected of a lens before any patch is seen.

Its unknowns are normal about a centred design of third order, with three things known of lenses in use:

* what third-order theory does not have is small, and a copy's own faults are smaller than the design's;
* who focuses balances focus and spherical aberration, the spot is smallest between -1 and -4/3 of it;
* corners are blurrier than the center. With s(r) the mean width of the rays' spot at r, ln(s(1) / s(0)) is
  1.0 with a spread of 0.34 over development lenses (seeds 0 to 59), and about 0.5 for the lens of the paper,
  whose MTF50 is 613 and 383: hence a spread of 0.5 here. Scenes that are soft all over the frame look like a
  lens that is, and nothing else speaks against it.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model.wavefront.least_squares import USUAL_EYE
from lensmodel.optics.wavefront import NAMES, design

Floats = NDArray[np.float64]

BALANCE: Final = -1.1
"""Focus over spherical aberration."""

_BALANCE_SPREAD_PX = 0.25
_SPREAD_PX = np.array(
    [0.9, 0.15, 3.0, 0.3, 0.3, 0.15, 4.0, 0.5, 0.5, 2.5, 0.15, 0.3, 0.5, 2.5, 0.25, 0.25, 0.15, 0.15, 0.15]
)
_EYE_SPREAD = (0.15, 0.3)
_USUAL = np.concatenate([np.zeros(len(NAMES)), USUAL_EYE])
_LENS = len(_USUAL)
_CORNER, _CORNER_SPREAD = 1.0, 0.5
_PIXEL_PX2 = 0.15
"""Squared width of the pixel and of diffraction, which no aberration takes away."""

_ACROSS, _ANGLES = 41, 8  # rays across the pupil, and directions of the field (chosen)


def unlikeliness(lens: Floats) -> tuple[float, Floats, Floats]:
    """Return what speaks against a lens, |unknowns|^2 in standard deviations, and how it changes.

    Parameters
    ----------
    lens : ndarray, shape (21,)
        The terms of a wavefront and the cat's eye.

    Returns
    -------
    cost : float
    curvature : ndarray, shape (21, 21)
        Half its second derivatives, by Gauss and Newton.
    slope : ndarray, shape (21,)
        Half its first derivatives.
    """
    off = lens - _USUAL
    ratio, change = corner_ratio(lens[: len(NAMES)])
    missed = (ratio - _CORNER) / _CORNER_SPREAD
    by = np.zeros(_LENS)
    by[: len(NAMES)] = change / _CORNER_SPREAD
    pull = _PRECISION @ off
    return float(pull @ off) + missed**2, _PRECISION + np.outer(by, by), pull + by * missed


def corner_ratio(terms: Floats) -> tuple[float, Floats]:
    """Logarithm of the width of the rays' spot at r = 1 over that at r = 0, and its derivatives.

    Parameters
    ----------
    terms : ndarray, shape (19,)
        Of a wavefront, pixels.
    """
    center, corner = _spots()
    inner, outer = terms @ center @ terms + _PIXEL_PX2, terms @ corner @ terms + _PIXEL_PX2
    return 0.5 * math.log(outer / inner), corner @ terms / outer - center @ terms / inner


def _precision() -> Floats:
    """Inverse covariance of the lens's unknowns."""
    precision = np.diag(1.0 / np.concatenate([_SPREAD_PX, _EYE_SPREAD]) ** 2)
    balanced = np.zeros(_LENS)
    balanced[[NAMES.index("focus"), NAMES.index("spherical")]] = 1.0, -BALANCE
    return np.asarray(precision + np.outer(balanced, balanced) / _BALANCE_SPREAD_PX**2)


_PRECISION = _precision()


@lru_cache(maxsize=1)
def _spots() -> tuple[Floats, Floats]:
    """Matrices Q of the squared width per axis, t'Qt pixels^2, at r = 0 and r = 1, means over all angles."""
    side = np.linspace(-1.0, 1.0, _ACROSS)
    px, py = (axis.ravel() for axis in np.meshgrid(side, side))
    rho2 = px * px + py * py
    right = [4 * rho2 * px, rho2 + 2 * px * px, 2 * px * py, 2 * px, 2 * px, 2 * py]
    up = [4 * rho2 * py, 2 * px * py, rho2 + 2 * py * py, 2 * py, -2 * py, 2 * px]
    rays = np.array([right, up])[:, :, rho2 <= 1.0]
    rays = rays - rays.mean(axis=2, keepdims=True)
    gram = np.einsum("akp,alp->kl", rays, rays) / (2.0 * rays.shape[2])
    matrices = []
    for r in (0.0, 1.0):
        angles = np.arange(_ANGLES) * 2.0 * math.pi / _ANGLES - math.pi
        designs = np.stack(
            [design(FieldPosition(r, float(phi)), LensSettings(channel="g")) for phi in angles]
        )
        matrices.append(np.einsum("qki,kl,qlj->ij", designs, gram, designs) / _ANGLES)
    return matrices[0], matrices[1]
