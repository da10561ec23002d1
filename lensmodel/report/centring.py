"""Is the lens centred? What breaks the symmetry of its blur, where to, and how sure that is.

A centred lens blurs alike all around its axis. Two signs of a fault in one copy are looked for in the samples
themselves, not in the smoothed field, so that their errors are known:

* one side is softer. The log of the width w of a sample (root mean square, pixels) is fitted by a part that
  is alike all around and a slope over the field h = r (cos phi, sin phi)::

      ln w = a + b r^2 + c r^4 + g.h

  g points to the softer side; w at the edge r there is exp(2 |g| r) times that of the opposite side.
* coma where there should be none. The third moment of a kernel, m = <|x|^2 x> / w^3, grows from zero with
  the field in a centred lens; a part that is the same in the whole middle of the picture is the sign of a
  shifted element (K. P. Thompson, JOSA A 22, 2005, eq. 11)::

      m = m0 + k h        for r < 0.5

Errors come from leaving one photo out at a time (jackknife; B. Efron, "The Jackknife, the Bootstrap and Other
Resampling Plans", SIAM 1982, eq. 3.3): patches of a photo share its focus and a tilted subject, so that many
patches of one photo do not prove a fault of the lens.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special

from lensmodel.core.psf import WING_LEVEL, PsfSample, rms_width
from lensmodel.core.types import LensSettings
from lensmodel.model import LensModel

# Field radius at which opposite sides are compared (chosen: the short sides of a 3:2 frame are at 0.83)
EDGE_R: Final = 0.85
_MIDDLE_R: Final = 0.5  # half-diagonals: inside, opposite sides are next to each other (chosen)
_NEAR_STOPS: Final = 0.7  # stops: photos of one aperture as far as blur is concerned (chosen)
_FEWEST: Final = 12  # patches: a plane through fewer is chance (chosen)
_SOFTER: Final = 0.10  # of the width: less is not seen between two sides of a print (chosen)
_COMATIC: Final = 0.15  # third moment over width cubed, in the middle: a shorter tail is not seen (chosen)
_UNSURE: Final = 0.4  # sides that may differ by more, error and all, are not called alike (chosen)
# One sound lens in a hundred is called decentred: rarer, and mild faults would go unnamed (chosen)
_CHANCE: Final = 0.01
_DIRECTIONS: Final = (
    *("right", "upper right", "top", "upper left"),
    *("left", "lower left", "bottom", "lower right"),
)
_Array = NDArray[np.float64]


def direction_in_words(phi: float) -> str:
    """Name the eighth of the picture that an angle points to."""
    return _DIRECTIONS[round(phi / (math.pi / 4.0)) % 8]


@dataclass(frozen=True, slots=True)
class Asymmetry:
    """A vector over the picture with its error."""

    amount: float  # length; what it counts is said where it stands
    direction: float  # radians, counter-clockwise from the right
    error: float  # standard error of each component of the vector, in the unit of `amount`
    significant: bool  # whether chance makes a vector so long in less than one of a hundred centred lenses


@dataclass(frozen=True, slots=True)
class Centring:
    """How well centred a copy is, by what its photos show."""

    verdict: Literal["centred", "decentred", "unknown"]
    text: str  # the verdict as one sentence, without a full stop
    # Towards the softer side; amount = ln of the ratio of widths of opposite sides at r = 0.85. None where
    # there are too few samples.
    softer: Asymmetry | None = None
    coma: Asymmetry | None = None  # towards the tail of the blur in the middle of the picture; amount = |m0|


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
    h = np.array([s.position.xy for s in samples])  # (right, up)
    r = np.hypot(*h.T)
    photos = np.unique([s.photo for s in samples], return_inverse=True)[1]
    root = np.sqrt([s.weight for s in samples])[:, None]
    widths = np.maximum([rms_width(s.kernel) for s in samples], 1e-3)
    slope = np.column_stack([h / (2.0 * EDGE_R), r**0, r**2, r**4])
    softer, coma = _asymmetry((root * slope)[:, None], root * np.log(widths)[:, None], photos), None
    inner = np.flatnonzero(r < _MIDDLE_R)
    if len(inner) >= _FEWEST // 2:
        third = np.array([_third_moment(samples[i]) for i in inner])
        constant = np.concatenate([np.broadcast_to(np.eye(2), (len(inner), 2, 2)), h[inner, :, None]], axis=2)
        coma = _asymmetry(root[inner, :, None] * constant, root[inner] * third, photos[inner])
    measured = all(sample.measured for sample in samples)
    return _verdict(softer, coma, int(photos.max()) + 1, measured=measured)


def _third_moment(sample: PsfSample) -> _Array:
    """<|x|^2 x> / w^3 as (right, up), about the centre of mass, wings below a hundredth cut."""
    kernel = np.where(sample.kernel > WING_LEVEL * sample.kernel.max(), sample.kernel, 0.0)
    kernel = kernel / kernel.sum()
    down, right = np.indices(kernel.shape) - kernel.shape[0] // 2
    x = np.stack([right - (kernel * right).sum(), (kernel * down).sum() - down])
    squared = (x**2).sum(axis=0)
    width = math.sqrt(max(float((kernel * squared).sum()) / 2.0, 1e-6))
    return np.asarray((kernel * squared * x).sum(axis=(1, 2)) / width**3)


def _asymmetry(design: _Array, value: _Array, photos: NDArray[np.intp]) -> Asymmetry:
    """First two unknowns of weighted equations (sample, each, unknown), with their jackknife error.

    It is the larger one of leaving out each sample and each photo.
    """

    def fit(rows: NDArray[np.bool_]) -> _Array:
        equations = design[rows].reshape(-1, design.shape[2])
        return np.asarray(np.linalg.lstsq(equations, value[rows].ravel(), rcond=None)[0])[:2]

    errors = []
    for groups in (np.arange(len(photos)), photos):
        names = np.unique(groups)
        if (n := len(names)) > 1:
            others = np.array([fit(groups != name) for name in names])
            errors.append((math.sqrt((n - 1) * float(others.var(axis=0).mean())), n - 1))
    error, freedom = max(errors)
    right, up = fit(np.ones(len(photos), dtype=np.bool_)).tolist()
    # |g|^2 / (2 s^2) is distributed as F with 2 and 2 (n - 1) degrees where there is only chance
    limit = math.sqrt(2.0 * float(special.fdtri(2.0, 2.0 * freedom, 1.0 - _CHANCE)))
    length = math.hypot(right, up)
    return Asymmetry(length, math.atan2(up, right), error, significant=length > limit * error)


def _verdict(softer: Asymmetry, coma: Asymmetry | None, photos: int, *, measured: bool = False) -> Centring:
    photographs = "one photo" if photos == 1 else f"{photos} photos"
    sides, spread = math.expm1(softer.amount), math.expm1(2.0 * softer.error)
    figures = f"opposite sides differ by {sides:.0%}, give or take {spread:.0%}"
    signs = []
    if softer.significant and softer.amount > _SOFTER:
        more = math.exp(softer.amount + 2.0 * softer.error) - math.exp(softer.amount)
        signs.append(
            f"the {direction_in_words(softer.direction)} is softer than the opposite side, "
            f"its blur {1.0 + sides:.2f} times as wide, give or take {more:.2f}"
        )
    if coma is not None and coma.significant and coma.amount > _COMATIC:
        tails = direction_in_words(coma.direction)
        signs.append(f"points in the middle of the picture have tails towards the {tails}")
    verdict: Literal["centred", "decentred", "unknown"] = "unknown"
    text = f"decentred: {'; '.join(signs)}"
    if signs and photos > 1:
        verdict = "decentred"
    elif signs:
        text = f"perhaps {text}; one photo cannot tell this from a subject at a slant; a second one can"
    # a subject at a slant may hide a fault as it may feign one; a chart was photographed straight on
    elif sides + spread <= _UNSURE and (photos > 1 or measured):
        verdict, text = "centred", f"well centred within what {photographs} can tell: {figures}"
    else:
        told = figures if spread < 1.0 else "its samples differ too much from photo to photo"
        text = f"{photographs} cannot tell whether the lens is centred: {told}"
    return Centring(verdict, text, softer, coma)
