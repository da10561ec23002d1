"""Ways to answer from the same neighbours and weights.

============  ===============================================================================
both          a quarter of the kernels of the neighbours averaged, three quarters of the wavefront of the
              lens where the spectra of all patches agree on one (the default)
kernels       the kernels of the neighbours averaged, as in the paper
mixed         the mixture of `combination`: kernels of both frames, and the wavefront
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

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model.answer import BOTH, MIXED, WAVEFRONT
from lensmodel.model.combination import WAVEFRONT_SHARE, Estimates, Mixture, relative_l2
from lensmodel.model.field.kriging import as_kernels
from lensmodel.model.field.local_frame import Answers, LocalKernels
from lensmodel.model.trust.support import measured_share
from lensmodel.model.wavefront.physical_mean import Physics


def answered(
    mode: str,
    estimates: Estimates,
    local: LocalKernels,
    near: Answers,
    positions: Sequence[FieldPosition],
    settings: LensSettings,
    widths: NDArray[np.float64],
    size: int,
    expected: NDArray[np.float64],
) -> Mixture:
    """Answer questions of one setting in one mode.

    Parameters
    ----------
    mode : str
        Of `answer.MODES`.
    near : Answers
        Neighbours of the places and their weights.
    widths : ndarray, shape (q, 2)
        Scales of the places.
    expected : ndarray, shape (q,)
        Relative L2 that estimators expect of the neighbours: where they were measured, a wavefront says less.
    """
    angles, mirror = np.array([p.phi for p in positions]), estimates.validation.choice.mirror
    physical = estimates.physical
    kernels = local.kernels(near, angles, widths, size, mirror)
    if mode == WAVEFRONT and physical is not None:
        rows = as_kernels(physical.rows(positions, settings), size)
        errors = physical.extended_errors(len(estimates.validation.votes))
        alone = _alone(rows, near, errors, 2)
        averaged, apart = near.mean(estimates.validation.errors**2), relative_l2(rows, kernels)
        return replace(alone, averaged=averaged, apart=apart)
    if mode == BOTH and physical is not None and physical.agreed and physical.diffraction_known:
        regression = _alone(kernels, near, estimates.validation.errors, 0)
        share = WAVEFRONT_SHARE * (1.0 - measured_share(expected))
        return _with_wavefront(regression, physical, share, positions, settings)
    if mode == MIXED:
        return estimates.mixed(kernels, near, positions, settings)
    return _alone(kernels, near, estimates.validation.errors, 0)


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
        shares=np.stack([1.0 - share, np.zeros_like(share), share], axis=1),
        apart=relative_l2(rows, averaged.kernels),
    )


def _alone(kernels: NDArray[np.float64], near: Answers, errors: NDArray[np.float64], expert: int) -> Mixture:
    shares = np.zeros((len(kernels), 3))
    shares[:, expert] = 1.0
    squared = near.mean(errors**2)
    return Mixture(
        kernels, squared, float(errors @ errors) / len(errors), shares, squared, np.zeros(len(kernels))
    )


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
    )
