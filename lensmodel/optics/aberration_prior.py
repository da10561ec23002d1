"""What is expected of a lens before any patch is seen: one prior of its aberrations, which all fits read.

Its unknowns are normal about a centred design of third order, with three things known of lenses in use:

* what third-order theory does not have is small, and a copy's own faults are smaller than the design's;
* who focuses balances focus and spherical aberration, the spot is smallest between -1 and -4/3 of it
  (W. T. Welford, "Aberrations of Optical Systems", 1986, ch. 6);
* corners are blurrier than the center, of most lenses. With s(r) the mean width of the rays' spot at r,
  ln(s(1) / s(0)) is 1.0 with a spread of 0.3 over drawn lenses, 0.7 with a spread of 0.5 over four ray-traced
  designs, and about 0.5 for the lens of the paper, whose MTF50 is 613 and 383: hence 0.7 with a spread of 0.8
  here. Scenes that are soft all over the frame look like a lens that is, and nothing else speaks against it.

Kernels say more of a lens than spectra do, so the fit to kernels needs bounds and the fit to spectra needs
knowledge: their spreads differ, and so do those of one place, where a term holds all that the field adds up.
The numbers lie in `data/fitted.json`; the README beside it says where each comes from and why they differ.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.files import fitted
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.optics.pupil import ray_gradients
from lensmodel.optics.wavefront import NAMES, design

Floats = NDArray[np.float64]

_LENS = len(NAMES) + 2  # and the cat's eye
_ACROSS, _ANGLES = 41, 8  # rays across the pupil, and directions of the field (chosen: means to a percent)


@dataclass(frozen=True, slots=True, eq=False)
class AberrationPrior:
    """Spreads of the aberrations, standard deviations in pixels of blur at the widest aperture.

    Parameters
    ----------
    with_kernels, with_spectra : ndarray of float64, shape (19,)
        Of the terms of a lens (`wavefront.NAMES`), fitted to kernels and fitted to spectra.
    at_place : ndarray of float64, shape (8,)
        Of the terms of one field position (`local_pupil`), fitted to spectra.
    drawn : mapping of str to float
        Of the terms of a random lens, by name, in widths of its kernels; terms without an entry are 0.
    drawn_at_place : ndarray of float64, shape (6,)
        Of the terms of one random field position, in widths of its kernel; tilts are 0.
    per_octave : float
        Change of a lens's term over an octave of focal length, as a part of its spread with kernels.
    eye, eye_spread : tuple of float
        Radius of the cat's eye and its shift per unit of field: usual values and spreads.
    balance, balance_spread, drawn_balance : float
        Focus over spherical aberration; spread of the focus about that in pixels, and of a random lens's in
        widths of its kernels.
    corner, corner_spread : float
        Logarithm of the width of the spot at r = 1 over that at r = 0, and its spread.
    least_px2 : float
        Squared width of the pixel and of diffraction, which no aberration takes away.
    """

    with_kernels: Floats
    with_spectra: Floats
    at_place: Floats
    drawn: Mapping[str, float]
    drawn_at_place: Floats
    per_octave: float
    eye: tuple[float, float]
    eye_spread: tuple[float, float]
    balance: float
    balance_spread: float
    drawn_balance: float
    corner: float
    corner_spread: float
    least_px2: float

    @classmethod
    def of(cls, numbers: Mapping[str, Any]) -> AberrationPrior:
        """Take the entries of `data/fitted.json`."""
        lens, place, eye, balance, corner = (
            numbers[name] for name in ("lens", "place", "eye", "balance", "corner")
        )
        return cls(
            with_kernels=np.array([lens["with_kernels"][name] for name in NAMES]),
            with_spectra=np.array([lens["with_spectra"][name] for name in NAMES]),
            at_place=np.array(place["with_spectra"]),
            drawn={name: lens["drawn"][name] for name in NAMES if name in lens["drawn"]},
            drawn_at_place=np.array(place["drawn"]),
            per_octave=lens["per_octave"],
            eye=(eye["usual"][0], eye["usual"][1]),
            eye_spread=(eye["spread"][0], eye["spread"][1]),
            balance=balance["usual"],
            balance_spread=balance["spread"],
            drawn_balance=balance["drawn"],
            corner=corner["usual"],
            corner_spread=corner["spread"],
            least_px2=corner["least"],
        )

    @property
    def slopes(self) -> Floats:
        """Spread of the change of each term of a zoom by octave of focal length, shape (19,)."""
        return self.per_octave * self.with_kernels


ABERRATIONS: Final = AberrationPrior.of(fitted("optics"))
"""The prior that all fits read."""

_USUAL = np.concatenate([np.zeros(len(NAMES)), ABERRATIONS.eye])


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
    missed = (ratio - ABERRATIONS.corner) / ABERRATIONS.corner_spread
    by = np.zeros(_LENS)
    by[: len(NAMES)] = change / ABERRATIONS.corner_spread
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
    least = ABERRATIONS.least_px2
    inner, outer = terms @ center @ terms + least, terms @ corner @ terms + least
    return 0.5 * math.log(outer / inner), corner @ terms / outer - center @ terms / inner


def _precision() -> Floats:
    """Inverse covariance of the lens's unknowns."""
    precision = np.diag(1.0 / np.concatenate([ABERRATIONS.with_spectra, ABERRATIONS.eye_spread]) ** 2)
    balanced = np.zeros(_LENS)
    balanced[[NAMES.index("focus"), NAMES.index("spherical")]] = 1.0, -ABERRATIONS.balance
    return np.asarray(precision + np.outer(balanced, balanced) / ABERRATIONS.balance_spread**2)


_PRECISION = _precision()


@lru_cache(maxsize=1)
def _spots() -> tuple[Floats, Floats]:
    """Matrices Q of the squared width per axis, t'Qt pixels^2, at r = 0 and r = 1, means over all angles."""
    side = np.linspace(-1.0, 1.0, _ACROSS)
    px, py = (axis.ravel() for axis in np.meshgrid(side, side))
    rays = np.array(ray_gradients(px, py))[:, :, px * px + py * py <= 1.0]
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
