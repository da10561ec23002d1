"""Is the lens centred? Towards which side its blur grows, and how sure that is.

A centred lens blurs alike all around its axis. In the samples themselves, not in the smoothed field, so that
their errors are known, the log of the width w of the blur (root mean square, pixels) is fitted by a part that
is alike all around and a slope over the field h = r (cos phi, sin phi)::

    ln w = a + b r^2 + c r^4 + g.h

g points to the softer side; w at the edge r there is exp(2 |g| r) times that of the opposite side.

Errors come from leaving one photo out at a time (jackknife; B. Efron, "The Jackknife, the Bootstrap and Other
Resampling Plans", SIAM 1982, eq. 3.3): patches of a photo share its focus and a tilted subject, so that many
patches of one photo do not prove a fault of the lens.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import special

from lensmodel.core.psf import PsfSample, rms_width
from lensmodel.core.types import LensSettings
from lensmodel.model import LensModel

# Field radius at which opposite sides are compared (chosen: the short sides of a 3:2 frame are at 0.83)
EDGE_R: Final = 0.85
_NEAR_STOPS: Final = 0.7  # stops: photos of one aperture as far as blur is concerned (chosen)
_FEWEST: Final = 12  # patches: a plane through fewer is chance (chosen)
_SOFTER: Final = 0.10  # of the width: less is not seen between two sides of a print (chosen)
_UNSURE: Final = 0.4  # sides that may differ by more, error and all, are not called alike (chosen)
# One sound lens in a hundred is called decentred: rarer, and mild faults would go unnamed (chosen)
_CHANCE: Final = 0.01
_DIRECTIONS: Final = (
    *("right", "upper right", "top", "upper left"),
    *("left", "lower left", "bottom", "lower right"),
)
Verdict: TypeAlias = Literal["centred", "decentred", "unknown"]


def direction_in_words(phi: float) -> str:
    """Name the eighth of the picture that an angle points to."""
    return _DIRECTIONS[round(phi / (math.pi / 4.0)) % 8]


@dataclass(frozen=True, slots=True)
class SofterSide:
    """By how much the blur is wider on one side than on the opposite one, at r = 0.85."""

    amount: float  # natural logarithm of the ratio of widths
    direction: float  # radians, counter-clockwise from the right
    error: float  # standard error of the amount
    significant: bool  # whether chance makes so large a one in less than one of a hundred centred lenses


@dataclass(frozen=True, slots=True)
class Centring:
    """How well centred a copy is, by what its photos show."""

    verdict: Verdict
    text: str  # the verdict as one sentence, without a full stop
    softer: SofterSide | None = None  # None where there are too few samples


def centring(model: LensModel, settings: LensSettings) -> Centring:
    """Judge the centring of a copy from the samples of one colour near an aperture."""
    stops = settings.stops
    samples = [
        s
        for s in model.samples
        if s.weight > 0  # of a photo that counts
        and s.settings.channel == settings.channel
        and (stops is None or s.settings.stops is None or abs(s.settings.stops - stops) <= _NEAR_STOPS)
    ]
    if len(samples) < _FEWEST:
        few = f"{len(samples)} sample{'' if len(samples) == 1 else 's'}"
        return Centring("unknown", f"{few} cannot tell whether the lens is centred; it takes {_FEWEST}")
    softer, photos = softer_side(samples), len({s.photo for s in samples})
    return Centring(*_verdict(softer, photos, measured=all(s.measured for s in samples)), softer)


def softer_side(samples: Sequence[PsfSample]) -> SofterSide:
    """Fit the widths of samples; the error is the larger one of leaving out each sample and each photo."""
    h = np.array([s.position.xy for s in samples])  # (right, up)
    r = np.hypot(*h.T)
    root = np.sqrt([s.weight for s in samples])
    design = root[:, None] * np.column_stack([h / (2.0 * EDGE_R), r**0, r**2, r**4])
    value = root * np.log(np.maximum([rms_width(s.kernel) for s in samples], 1e-3))

    def slope(rows: NDArray[np.bool_]) -> NDArray[np.float64]:
        return np.asarray(np.linalg.lstsq(design[rows], value[rows], rcond=None)[0])[:2]

    errors = []
    for groups in (np.arange(len(samples)), np.unique([s.photo for s in samples], return_inverse=True)[1]):
        if n := int(groups.max()):
            others = np.array([slope(groups != group) for group in range(n + 1)])
            errors.append((math.sqrt(n * float(others.var(axis=0).mean())), n))
    error, freedom = max(errors)
    right, up = slope(np.ones(len(samples), dtype=np.bool_)).tolist()
    # |g|^2 / (2 s^2) is distributed as F with 2 and 2 (n - 1) degrees where there is only chance
    limit = math.sqrt(2.0 * float(special.fdtri(2.0, 2.0 * freedom, 1.0 - _CHANCE)))
    amount = math.hypot(right, up)
    return SofterSide(amount, math.atan2(up, right), error, significant=amount > limit * error)


def _verdict(softer: SofterSide, photos: int, *, measured: bool) -> tuple[Verdict, str]:
    photographs = "one photo" if photos == 1 else f"{photos} photos"
    sides, spread = math.expm1(softer.amount), math.expm1(2.0 * softer.error)
    figures = f"opposite sides differ by {sides:.0%}, give or take {spread:.0%}"
    if softer.significant and softer.amount > _SOFTER:
        more = math.exp(softer.amount + softer.error) - math.exp(softer.amount)
        text = (
            f"decentred: the {direction_in_words(softer.direction)} is softer than the opposite side, "
            f"its blur {1.0 + sides:.2f} times as wide, give or take {more:.2f}"
        )
        if photos > 1:
            return "decentred", text
        cannot = "one photo cannot tell this from a subject at a slant; a second one can"
        return "unknown", f"perhaps {text}; {cannot}"
    # a subject at a slant may hide a fault as it may feign one; a chart was photographed straight on
    if sides + spread <= _UNSURE and (photos > 1 or measured):
        return "centred", f"well centred within what {photographs} can tell: {figures}"
    told = figures if spread < 1.0 else "its samples differ too much from photo to photo"
    return "unknown", f"{photographs} cannot tell whether the lens is centred: {told}"
