"""The error that an answer expects of itself: one named term for each of its sources."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from lensmodel.core.files import fitted
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import variables as va
from lensmodel.model.answer import BOTH, WAVEFRONT
from lensmodel.model.field.local_frame import Answers
from lensmodel.model.fitting import Fit
from lensmodel.model.modes import WAVEFRONT_SHARE, Mixture
from lensmodel.model.prior import Prior
from lensmodel.model.trust.support import field_error, shared_error, support

_PRIOR_COUNTS = 1e-3
"""Share of the answer from which on a prior is asked for its error (chosen: less shows in no digit)."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """What an answer expects of itself.

    Parameters
    ----------
    error : float
        Relative L2, the prior's part included.
    shared : float
        The part of it that all samples share.
    nearest : float
        Distance to the nearest sample in bandwidths.
    beyond : tuple of str
        Variables in which the question lies outside the samples.
    """

    error: float
    shared: float
    nearest: float
    beyond: tuple[str, ...]


def forecast(
    fit: Fit,
    near: Answers,
    mixture: Mixture,
    position: FieldPosition,
    settings: LensSettings,
    prior: tuple[Prior, float] | None = None,
) -> Forecast:
    """Foretell how far the answer to one question is from the truth, in the mode of its fit.

    Parameters
    ----------
    fit : Fit
    near : Answers
        Neighbours of the place and their weights.
    mixture : Mixture
        What they answer.
    position, settings : FieldPosition, LensSettings
        Of the question.
    prior : tuple of Prior and float, optional
        The prior with its share of the answer, 0..1.
    """
    weight = near.shares
    distance, beyond = support(fit.index.points[near.rows], va.point(position, settings), fit.rule)
    per_photo = np.bincount(fit.roster.photo[near.rows], weight)
    evidence = SampleEvidence(
        scatter=float(weight @ fit.validation.noise[near.rows]),
        expected=float(weight @ fit.expected[near.rows]),
        independent=1.0 / float((per_photo**2).sum()),
        nearest=distance,
        extrapolated=bool(beyond),
        usual=fit.validation.usual,
    )
    if fit.mode == BOTH:
        error = joint_error(evidence, mixture, position.r)
    else:
        physical = fit.physical_at(settings)
        alone = fit.mode == WAVEFRONT and physical is not None and physical.agreed
        error = expected_error(evidence, mixture, wavefront_alone=alone)
    if prior is not None and prior[1] > _PRIOR_COUNTS:
        error = with_prior(error, prior[1], prior[0].error(position, settings))
    return Forecast(error, evidence.shared, distance, beyond)


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
