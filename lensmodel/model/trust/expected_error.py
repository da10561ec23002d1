"""The error that an answer expects of itself: one named term for each of its sources."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from lensmodel.core.files import fitted
from lensmodel.model.modes import WAVEFRONT_SHARE, Mixture
from lensmodel.model.trust.support import field_error, shared_error


@dataclass(frozen=True, slots=True)
class SampleEvidence:
    """What is known of the samples that answer a question.

    Parameters
    ----------
    scatter : float
        s^2, by which neighbours differ.
    expected : float
        t^2, the mean squared error that their estimators expect.
    independent : float
        Photos that count, 1 / sum w^2.
    nearest : float
        Distance to the nearest sample in bandwidths.
    extrapolated : bool
        Whether no sample is near.
    usual : float
        Mean squared held-out error all over the field.
    """

    scatter: float
    expected: float
    independent: float
    nearest: float
    extrapolated: bool
    usual: float

    @property
    def distance_factor(self) -> float:
        """How well the nearest samples agree says nothing of a place without samples.

        Half as much again for each bandwidth beyond the first (chosen: kernels change by as much).
        """
        return 1.0 + 0.5 * max(self.nearest - 1.0, 0.0)

    @property
    def shared(self) -> float:
        """Relative L2 that all samples share, see `shared_error`."""
        return shared_error(self.expected, self.scatter)

    def regression_error(self, held_out: float) -> float:
        """Relative L2 of averaged kernels, from their squared held-out error near the place."""
        own = field_error(held_out, self.scatter, self.independent)
        return math.hypot(own * self.distance_factor, self.shared)


def expected_error(evidence: SampleEvidence, mixture: Mixture, *, wavefront_alone: bool) -> float:
    """Relative L2 that the first answer of a mixture expects of itself.

    The regression's is held out (`SampleEvidence.regression_error`), and so is that of a wavefront which
    answers alone. But a wavefront that cannot bend as the lens does agrees with itself all over the
    field: it is never surer than the kernels would be, nor than it agrees with them.

    Parameters
    ----------
    wavefront_alone : bool
        Whether a wavefront of known aperture and pixels answers.
    """
    own = float(mixture.squared[0])
    if wavefront_alone:
        error = math.sqrt(own) * evidence.distance_factor
    else:
        error = evidence.regression_error(float(mixture.usual) if evidence.extrapolated else own)
    if mixture.shares[0] > 0.0:
        averaged = evidence.usual if evidence.extrapolated else float(mixture.averaged[0])
        error = max(error, evidence.regression_error(averaged), float(mixture.apart[0]))
    return error


_JOINT: Final[Mapping[str, float]] = fitted("model")["joint_error"]
"""a, b, c and the least distance of `joint_error`; see `data/README.md`."""


def joint_error(evidence: SampleEvidence, mixture: Mixture, r: float) -> float:
    """Relative L2 that the first mean of averaged kernels and a wavefront's expects of itself.

    With d the relative L2 by which the two differ, e = exp(a + b r + c ln(d + 0.02)). Held-out kernels share
    their mistakes with all kernels of these photos; how far two kinds of estimates lie apart is nearer to
    what both are off by. Without a wavefront the error is the regression's.

    Parameters
    ----------
    r : float
        Half-diagonals.
    """
    own = evidence.regression_error(float(mixture.usual if evidence.extrapolated else mixture.squared[0]))
    share = float(mixture.shares[0]) / WAVEFRONT_SHARE
    apart = float(mixture.apart[0])
    distance = math.log(apart + _JOINT["least_apart"])
    joint = math.exp(_JOINT["at_center"] + _JOINT["by_radius"] * r + _JOINT["by_distance"] * distance)
    return math.hypot(math.sqrt(1.0 - share) * own, math.sqrt(share) * joint * evidence.distance_factor)


def with_prior(error: float, share: float, prior_error: float) -> float:
    """Relative L2 of an answer of which a share is a prior's, sqrt((1 - p) e^2 + p e_p^2)."""
    return float(np.sqrt((1.0 - share) * error**2 + share * prior_error**2))
