"""Ways to answer from the same neighbours and weights.

============  ===============================================================================
kernels       the kernels of the neighbours averaged, as in the paper (the default)
mixed         the mixture of `combination`: kernels of both frames, and the wavefront
wavefront     the wavefront of the lens alone, fitted to all samples (`physical_mean`)
paper         the kernels of the neighbours averaged, and nothing else: bandwidths by eq. (8) alone,
              all samples as sure as they claim, no symmetry, nothing moved along the radius
============  ===============================================================================

A mode that needs a wavefront where none could be fitted answers with averaged kernels.

Behind lenses of third order, of which the wavefront is made, `mixed` is nearer to the truth. Behind
ray-traced designs it is confidently wrong in places, and a photo corrected by it loses there what `kernels`
gains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model.answer import MIXED, WAVEFRONT
from lensmodel.model.combination import Estimates, Mixture, relative_l2
from lensmodel.model.field.kriging import as_kernels
from lensmodel.model.field.local_frame import Answers, LocalKernels


def answered(
    mode: str,
    estimates: Estimates,
    local: LocalKernels,
    near: Answers,
    positions: Sequence[FieldPosition],
    settings: LensSettings,
    widths: NDArray[np.float64],
    size: int,
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
    if mode == MIXED:
        return estimates.mixed(kernels, near, positions, settings)
    return _alone(kernels, near, estimates.validation.errors, 0)


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
