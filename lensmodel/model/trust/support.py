"""What stands behind an answer: expected error, standard error, distance to the samples."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.files import fitted
from lensmodel.model import variables as va

_FAR = 2.5  # bandwidths: a Gaussian has fallen to 0.04 there (chosen)
_MEASURED, _BLIND = 0.08, 0.15
"""Expected errors of kernels up to which, as of those measured on a target, they are believed more than
patches are, and from which on they count as blind estimates do, none of which expects less (chosen)."""

USUAL_ERROR: Final = float(fitted("model")["usual_error"])
"""Relative L2 error that blind estimates share where they do not say; see `data/README.md`."""


def measured_share(error: float | NDArray[np.float64]) -> NDArray[np.float64]:
    """How far kernels of an expected error were measured: 1 measured, 0 estimated blindly."""
    return np.asarray(np.interp(error, (_MEASURED, _BLIND), (1.0, 0.0)))


_EXACT, _SCATTERED = 0.03, 0.08
"""Held-out errors of a whole field up to which its kernels are exact, and from which on they are estimates
(chosen: blind estimates of one photo scatter by 0.11 at least)."""


def exact_share(held_out: float) -> float:
    """How far kernels that predict each other to a relative L2, all over the field, are exact: 1 or less."""
    return float(np.interp(held_out, (_EXACT, _SCATTERED), (1.0, 0.0)))


def field_error(held_out: float, noise: float, independent: float) -> float:
    """Expected relative L2 of an answer, from held-out errors that contain the samples' own noise.

    With m independent photos, bias b and noise s of a sample::

        held out:  e^2 = b^2 + s^2 (1 + 1/m)        field:  b^2 + s^2 / m

    s^2 is the scatter of neighbours, which also differ in place; so b is not taken below a third of e.

    Parameters
    ----------
    held_out, noise : float
        e^2 and s^2 near the place.
    independent : float
        m.
    """
    noise = min(noise, held_out)
    bias = max(held_out - noise * (1.0 + 1.0 / independent), held_out / 9.0)
    return math.sqrt(bias + noise / independent)


def shared_error(expected: float, noise: float) -> float:
    """Error that all samples share, from what their estimators expect of them.

    They expect bias and noise together, t^2 = b^2 + s^2, and s^2 is the scatter that neighbours show::

        b^2 = max(t^2 - s^2, t^2 / 4)

    Estimators that err alike do not scatter: at least half of what they expect is taken for shared.

    Parameters
    ----------
    expected, noise : float
        t^2 and s^2 near the place.
    """
    return math.sqrt(max(expected - noise, expected / 4.0))


def support(
    where: NDArray[np.float64], asked: NDArray[np.float64], rule: Mapping[str, float]
) -> tuple[float, tuple[str, ...]]:
    """Distance to the nearest of samples `where` (m, 7), and the variables in which all are far.

    Distances count in bandwidths of eq. (8), `rule` from `variables.bandwidths`.
    """
    gaps = va.gaps(where, asked, va.scales(va.support_widths(rule)))
    squared = gaps**2
    nearest = int(squared.sum(axis=1).argmin())
    beyond = {name for name, value in zip(va.COLUMNS, np.abs(gaps).min(axis=0), strict=True) if value > _FAR}
    distance = math.sqrt(float(squared[nearest].sum()))
    if not beyond and distance > _FAR:
        beyond = {va.COLUMNS[int(squared[nearest].argmax())]}
    return distance, tuple(sorted(beyond))


def standard_error(apart: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard error of each pixel, sqrt(sum w^2 sum w (C - f)^2 / (1 - sum w^2)).

    Parameters
    ----------
    apart : ndarray, shape (m, size, size)
        Kernels of the samples as seen from the place.
    weight : ndarray, shape (m,)
        Of sum 1.
    """
    concentration = float((weight**2).sum())
    if concentration > 1.0 - 1e-9:
        return np.full(apart.shape[1:], np.nan)  # a single sample says nothing of its own scatter
    scatter = np.tensordot(weight, (apart - np.tensordot(weight, apart, axes=1)) ** 2, axes=1)
    return np.asarray(np.sqrt(scatter * concentration / (1.0 - concentration)), dtype=np.float64)
