"""Ways to answer from the same neighbours and weights.

============  ===============================================================================
both          a quarter of the kernels of the neighbours averaged, three quarters of the wavefront of the
              lens where the spectra of all patches agree on one and kernels are no exact ones (the default)
kernels       the kernels of the neighbours averaged, as in the paper
wavefront     the wavefront of the lens alone, fitted to all samples (`physical_mean`)
paper         the kernels of the neighbours averaged, and nothing else: bandwidths by eq. (8) alone,
              all samples as sure as they claim, no symmetry, nothing moved along the radius
============  ===============================================================================

A mode that needs a wavefront where none could be fitted answers with averaged kernels.

Kernels that patches gave one by one and a wavefront that all patches gave together make unlike mistakes.
Behind lenses of third order, of which the wavefront is made, it is nearer to the truth; behind ray-traced
designs now the one is and now the other. The mean with `WAVEFRONT_SHARE` was as near as the better of the two
behind either family of development lenses (`python -m lensmodel.lab.model.joint_answer`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.files import fitted
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model.answer import BOTH, WAVEFRONT
from lensmodel.model.field.kriging import as_kernels
from lensmodel.model.field.local_frame import Answers
from lensmodel.model.fitting import Fit
from lensmodel.model.trust.support import exact_share, measured_share
from lensmodel.model.wavefront.physical_mean import Physics

WAVEFRONT_SHARE: Final = float(fitted("model")["wavefront_share"])
"""Of the wavefront in the mode `both`; see `data/README.md`."""


@dataclass(frozen=True, slots=True, eq=False)
class Mixture:
    """Answers to several questions, of averaged kernels and a wavefront.

    Parameters
    ----------
    kernels : ndarray, shape (q, size, size)
    squared : ndarray, shape (q,)
        Squared held-out errors near the places.
    usual : float
        The same all over the field.
    shares : ndarray, shape (q,)
        Weights of the wavefront, 0..1.
    averaged : ndarray, shape (q,)
        Squared held-out errors of averaged kernels alone near the places.
    apart : ndarray, shape (q,)
        How far the wavefront lies from the averaged kernels, relative L2; 0 without it.
    far_light : ndarray, shape (q,)
        Share of the light of `kernels` that was added far from their core, 0..1.
    """

    kernels: NDArray[np.float64]
    squared: NDArray[np.float64]
    usual: float
    shares: NDArray[np.float64]
    averaged: NDArray[np.float64]
    apart: NDArray[np.float64]
    far_light: NDArray[np.float64]


def answered(
    fit: Fit,
    physical: Physics | None,
    near: Answers,
    positions: Sequence[FieldPosition],
    settings: LensSettings,
    widths: NDArray[np.float64],
    size: int,
    expected: NDArray[np.float64],
) -> Mixture:
    """Answer questions of one setting in the mode of a fit.

    Parameters
    ----------
    fit : Fit
    physical : Physics or None
        Wavefront of these settings.
    near : Answers
        Neighbours of the places and their weights.
    widths : ndarray, shape (q, 2)
        Scales of the places.
    expected : ndarray, shape (q,)
        Relative L2 that estimators expect of the neighbours: where they were measured, a wavefront says less.
    """
    validation, angles = fit.validation, np.array([p.phi for p in positions])
    kernels = fit.local.kernels(near, angles, widths, size, validation.choice.mirror)
    averaged = _alone(kernels, near, validation.errors)
    if physical is None:
        return averaged
    if fit.mode == WAVEFRONT:
        rows = as_kernels(physical.rows(positions, settings), size)
        alone = _alone(rows, near, physical.extended_errors(len(validation.votes)))
        apart, shares = relative_l2(rows, kernels), np.ones(len(rows))
        return replace(alone, shares=shares, averaged=averaged.squared, apart=apart)
    if fit.mode == BOTH and physical.agreed and physical.diffraction_known:
        known = np.maximum(measured_share(expected), exact_share(math.sqrt(validation.usual)))
        share = WAVEFRONT_SHARE * (1.0 - known)
        if share.any():
            return _with_wavefront(averaged, physical, share, positions, settings)
    return averaged


def relative_l2(kernels: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Relative L2 of kernels about others of any brightness, shape (q,)."""
    others = others / others.sum(axis=(1, 2), keepdims=True)
    return np.asarray(np.linalg.norm(kernels - others, axis=(1, 2)) / np.linalg.norm(others, axis=(1, 2)))


def _with_wavefront(
    averaged: Mixture,
    physical: Physics,
    share: NDArray[np.float64],
    positions: Sequence[FieldPosition],
    settings: LensSettings,
) -> Mixture:
    """The mean of averaged kernels and, by their shares `(q,)`, of the wavefront's, turned as may be."""
    rows = as_kernels(physical.rows(positions, settings), averaged.kernels.shape[1])
    if physical.turned > 0.0:
        rows = (1.0 - physical.turned) * rows + physical.turned * rows[:, ::-1, ::-1]
    return replace(
        averaged,
        kernels=averaged.kernels + share[:, None, None] * (rows - averaged.kernels),
        shares=share,
        apart=relative_l2(rows, averaged.kernels),
    )


def _alone(kernels: NDArray[np.float64], near: Answers, errors: NDArray[np.float64]) -> Mixture:
    nothing, squared = np.zeros(len(kernels)), near.mean(errors**2)
    return Mixture(kernels, squared, float(errors @ errors) / len(errors), nothing, squared, nothing, nothing)


def between(one: Mixture, other: Mixture, share: float) -> Mixture:
    """The mean of two mixtures of the same questions, with the share of the first."""
    rest = 1.0 - share
    return Mixture(
        share * one.kernels + rest * other.kernels,
        share * one.squared + rest * other.squared,
        share * one.usual + rest * other.usual,
        share * one.shares + rest * other.shares,
        share * one.averaged + rest * other.averaged,
        share * one.apart + rest * other.apart,
        share * one.far_light + rest * other.far_light,
    )
