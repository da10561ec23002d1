"""Which model answered a question, why that one, and how many samples and photos stand behind it.

With s the share of the wavefront, w_i the weights of the regression and v_i the votes of the samples that the
wavefront was fitted to, both of sum 1, sample i has the part W_i of an answer, and as many count as if all
had the same::

    W_i = (1 - s) w_i + s v_i,        effective samples = 1 / sum W_i^2
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.types import WAVELENGTH_NM, LensSettings
from lensmodel.model.answer import BOTH, KERNELS, PAPER, WAVEFRONT
from lensmodel.model.field.local_frame import Answers
from lensmodel.model.fitting import Fit
from lensmodel.model.trust.support import exact_share
from lensmodel.model.wavefront.from_kernels import MIN_SAMPLES, ONE_FOCAL_LENGTH
from lensmodel.model.wavefront.joint_kernels import MIN_PLACES
from lensmodel.model.wavefront.physical_mean import FEW_SPECTRA, NO_AGREEMENT, SEVERAL_FOCAL_LENGTHS
from lensmodel.model.wavefront.zoom import nearest

REGRESSION: Final = "regression"
TOGETHER: Final = "wavefront and regression"

_APART: Final[Mapping[str, str]] = MappingProxyType(
    {
        NO_AGREEMENT: "no wavefront agrees with all patches",
        FEW_SPECTRA: f"fewer than {MIN_PLACES} patches with a spectrum",
        SEVERAL_FOCAL_LENGTHS: "photos of several focal lengths, whose patches are not solved together",
    }
)
_LISTED = 1e-3  # share of the weight from which on a photo is counted: less shows in no digit (chosen)


@dataclass(frozen=True, slots=True)
class Provenance:
    """What made an answer.

    Parameters
    ----------
    answered_by : {"regression", "wavefront and regression", "wavefront", "paper"}
    reason : str
        Why that one answered.
    effective_samples : float
    photos : int
    """

    answered_by: str
    reason: str
    effective_samples: float
    photos: int


def answerers_in_words(made: Iterable[tuple[str, str]]) -> str:
    """Say which models answered at some places and why, those of most places first.

    Parameters
    ----------
    made : iterable of tuple of str
        `answered_by` and `reason` of each place.
    """
    counts = Counter(made)
    if len(counts) == 1:
        ((name, reason),) = counts
        return f"answered by {name}: {reason}"
    total = counts.total()
    parts = (f"{n} of {total} places by {name}: {reason}" for (name, reason), n in counts.most_common())
    return f"answered at {'; at '.join(parts)}"


def provenance(
    fit: Fit, near: Answers, share: float, settings: LensSettings, *, takes_wavefront: bool
) -> Provenance:
    """Tell what made the answer to one question.

    Parameters
    ----------
    fit : Fit
    near : Answers
        Samples that the regression weighed.
    share : float
        Of the wavefront, 0..1.
    settings : LensSettings
        Of the question.
    takes_wavefront : bool
        Whether the regression that was chosen leaves a wavefront a share at all.
    """
    parts = np.zeros(len(fit.roster.photo))
    np.add.at(parts, near.rows, np.maximum(near.weights, 0.0))
    parts *= (1.0 - share) / parts.sum()
    if share > 0.0:
        parts += share * _wavefront_votes(fit, settings)
    per_photo = np.bincount(fit.roster.photo, parts)
    return Provenance(
        *_named(fit, share, settings, takes_wavefront=takes_wavefront),
        effective_samples=1.0 / float(parts @ parts),
        photos=int(np.count_nonzero(per_photo > _LISTED)),
    )


def _named(fit: Fit, share: float, settings: LensSettings, *, takes_wavefront: bool) -> tuple[str, str]:
    if fit.mode == PAPER:
        return PAPER, "the lens has the model paper"
    if share > 0.0 and fit.mode == WAVEFRONT:
        return WAVEFRONT, "the wavefront alone was asked for"
    if share > 0.0:
        return TOGETHER, "all patches agree on a wavefront, and aperture and pixel pitch are known"
    if fit.mode == KERNELS:
        return REGRESSION, "the kernels alone were asked for"
    return REGRESSION, _without_wavefront(fit, settings, takes_wavefront=takes_wavefront)


def _without_wavefront(fit: Fit, settings: LensSettings, *, takes_wavefront: bool) -> str:
    """Why no wavefront takes part in an answer that could have one."""
    physical = fit.physical_at(settings)
    if not takes_wavefront:
        return "the regression that was chosen takes no wavefront"
    if physical is None:
        voting = fit.validation.votes > 0.0
        if fit.mode == BOTH and not (fit.has_spectrum & voting).any():
            return "no patch has a spectrum"
        few = int(voting.sum()) < MIN_SAMPLES
        return f"fewer than {MIN_SAMPLES} samples" if few else "the wavefront is not fitted yet"
    if not physical.agreed or not physical.diffraction_known:
        return "aperture or pixel pitch unknown" if physical.agreed else _APART[physical.why_apart]
    exact = exact_share(math.sqrt(fit.validation.usual)) == 1.0
    return "kernels agree with each other all over the field" if exact else "kernels were measured"


def _wavefront_votes(fit: Fit, settings: LensSettings) -> NDArray[np.float64]:
    """Votes of sum 1 of the samples that the wavefront of some settings was fitted to, shape (n,).

    Channels of one patch are not counted apart: those of the question stand for all.
    """
    end = fit.end_at(settings)
    if end is None and fit.mode == BOTH and fit.physical is not None and not fit.physical.agreed:
        end, _ = nearest(fit.ends, settings)  # what share there is comes from it
    physical = fit.physical if end is None else end.physical
    assert physical is not None
    votes, points = fit.validation.votes.copy(), fit.index.points
    votes[len(physical.errors) :] = 0.0  # joined since
    if physical.agreed:
        votes[~fit.has_spectrum] = 0.0
    if end is not None:
        votes[~(np.abs(points[:, 5] - end.octaves) <= ONE_FOCAL_LENGTH / 2.0)] = 0.0
    own = np.where(points[:, 4] == WAVELENGTH_NM[settings.channel], votes, 0.0)
    votes = own if own.any() else votes
    return np.asarray(votes / votes.sum())
