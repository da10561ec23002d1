"""Is the lens centred? What breaks the symmetry of its blur, where to, and how sure that is.

A centred lens blurs alike all around its axis. Two signs of a fault in one copy are looked for in the
samples themselves, not in the smoothed field, so that their errors can be told:

* one side is softer. The log of the width w of a sample (root mean square, pixels) is fitted by a part
  that is alike all around and a slope over the field h = r (cos phi, sin phi)::

      ln w = a + b r^2 + c r^4 + g.h

  g points to the softer side; w at the edge r there is exp(2 |g| r) times that of the opposite side.
* coma where there should be none. The third moment of a kernel, m = <|x|^2 x> / w^3, grows from zero
  with the field in a centred lens; a part that is the same in the whole middle of the picture is
  the sign of a shifted element (K. P. Thompson, JOSA A 22, 2005, eq. 11)::

      m = m0 + k h        for r < 0.5

Errors come from leaving one photo out at a time (jackknife; B. Efron, "The Jackknife, the Bootstrap and
Other Resampling Plans", SIAM 1982, eq. 3.3): patches of a photo share its focus and a tilted subject,
so that many patches of one photo do not prove a fault of the lens.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.geometry import zone_of
from lensmodel.core.psf import PsfSample, second_moments
from lensmodel.core.types import ZONES, LensSettings, Zone
from lensmodel.model import LensModel
from lensmodel.report.places import direction_in_words

Verdict = Literal["centred", "decentred", "unknown"]

EDGE_R: Final = 0.85
"""Field radius at which opposite sides are compared (chosen: the short sides of a 3:2 frame are at 0.83)."""

_MIDDLE_R: Final = 0.5  # half-diagonals: inside, opposite sides are next to each other (chosen)
_NEAR_STOPS: Final = 0.7  # stops: photos of one aperture as far as blur is concerned (chosen)
_FEWEST: Final = 12  # patches: a plane through fewer is chance (chosen)
_SOFTER: Final = 0.10  # of the width: less is not seen between two sides of a print (chosen)
_COMATIC: Final = 0.15  # third moment over width cubed, in the middle: a shorter tail is not seen (chosen)
_UNSURE_PERCENT: Final = 40.0  # sides that may differ by more, error and all, are not called alike (chosen)
_CHANCE: Final = 0.01
"""One sound lens in a hundred is called decentred: rarer, and mild faults would go unnamed (chosen)."""
_WING: Final = 0.01  # of the peak: fainter pixels are noise to a second moment (chosen)

_Fit = Callable[[NDArray[np.intp]], NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class Asymmetry:
    """A vector over the picture with its error.

    Parameters
    ----------
    amount : float
        Length; what it counts is said where it stands.
    direction : float
        Radians, counter-clockwise from the right.
    error : float
        Standard error of each component of the vector, in the unit of `amount`.
    significant : bool
        Whether chance makes a vector so long in less than one of a hundred centred lenses.
    """

    amount: float
    direction: float
    error: float
    significant: bool


@dataclass(frozen=True, slots=True)
class Decentring:
    """How well centred a copy is, by what its photos can tell.

    Parameters
    ----------
    verdict : {"centred", "decentred", "unknown"}
    text : str
        The verdict as one sentence.
    softer : Asymmetry or None
        Towards the softer side; amount = ln of the ratio of widths of opposite sides at r = 0.85.
        None where there are too few samples.
    coma : Asymmetry or None
        Towards the tail of the blur in the middle of the picture; amount = |m0|.
    zones : mapping of Zone to Asymmetry
        The slope of each zone by itself, as ln of the ratio of widths of its opposite sides; zones
        with too few samples are left out.
    part : {"center", "mid", "corner"} or None
        Zone whose opposite sides differ most, of those that differ beyond chance.
    photos, samples : int
        That took part.
    """

    verdict: Verdict
    text: str
    softer: Asymmetry | None
    coma: Asymmetry | None
    zones: dict[Zone, Asymmetry]
    part: Zone | None
    photos: int
    samples: int


def decentring(model: LensModel, settings: LensSettings) -> Decentring:
    """Judge the centring of a copy from the samples near some settings.

    Parameters
    ----------
    model : LensModel
    settings : LensSettings
        Channel, and aperture within 0.7 stop; wide open shows most.
    """
    samples = _voters(model, settings)
    photos = len({s.photo for s in samples})
    if len(samples) < _FEWEST:
        few = f"{len(samples)} sample{'' if len(samples) == 1 else 's'}"
        text = f"{few} at these settings cannot tell whether the lens is centred; it takes {_FEWEST}"
        return Decentring("unknown", text, None, None, {}, None, photos, len(samples))
    r, h = _field(samples)
    widths = np.array([math.sqrt(float(np.trace(second_moments(s.kernel, _WING))) / 2) for s in samples])
    log_w = np.log(np.maximum(widths, 1e-3))
    groups = np.unique([s.photo for s in samples], return_inverse=True)[1]
    weight = np.sqrt(np.array([s.weight for s in samples]))

    softer = _asymmetry(_slope(r, h, log_w, weight), groups, 2.0 * EDGE_R)
    zones: dict[Zone, Asymmetry] = {}
    named = np.array([zone_of(x) for x in r])
    level = _level(r, h, log_w, weight)
    for zone in ZONES:
        rows = np.flatnonzero(named == zone)
        if len(rows) >= _FEWEST // 2:
            reach = float(np.median(r[rows]))
            fit = _slope(r[rows], h[rows], log_w[rows] - level[rows], weight[rows], powers=0)
            zones[zone] = _asymmetry(fit, groups[rows], 2.0 * reach)
    inner = np.flatnonzero(r < _MIDDLE_R)
    coma = None
    if len(inner) >= _FEWEST // 2:
        third = np.array([_third_moment(samples[i]) for i in inner])
        coma = _asymmetry(_constant(h[inner], third, weight[inner]), groups[inner], 1.0)
    beyond = {zone: zone_result.amount for zone, zone_result in zones.items() if zone_result.significant}
    part = max(beyond.items(), key=lambda item: item[1])[0] if beyond else None
    verdict, text = _verdict(softer, coma, photos)
    if verdict == "centred":
        part = None
    return Decentring(verdict, text, softer, coma, zones, part, photos, len(samples))


def _voters(model: LensModel, settings: LensSettings) -> list[PsfSample]:
    """Samples near the settings, without those that the model has flagged."""
    flagged = {flag.sample for flag in model.flags() if flag.sample is not None}
    spoilt = {flag.photo for flag in model.flags() if flag.sample is None} | set(model.settings.excluded)
    voters = []
    for i, sample in enumerate(model.samples):
        own = sample.settings
        if own.channel != settings.channel or sample.weight <= 0 or i in flagged or sample.photo in spoilt:
            continue
        a, b = own.stops, settings.stops
        if a is not None and b is not None and abs(a - b) > _NEAR_STOPS:
            continue
        if own.focal_mm and settings.focal_mm and abs(math.log2(own.focal_mm / settings.focal_mm)) > 0.25:
            continue
        voters.append(sample)
    return voters


def _field(samples: Sequence[PsfSample]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Radii `(n,)` and field vectors `(n, 2)` as (right, up)."""
    r = np.array([s.position.r for s in samples])
    phi = np.array([s.position.phi for s in samples])
    return r, np.stack([r * np.cos(phi), r * np.sin(phi)], axis=1)


def _basis(r: NDArray[np.float64], powers: int) -> NDArray[np.float64]:
    return np.stack([r ** (2 * k) for k in range(powers + 1)], axis=1)


def _slope(
    r: NDArray[np.float64],
    h: NDArray[np.float64],
    value: NDArray[np.float64],
    weight: NDArray[np.float64],
    powers: int = 2,
) -> _Fit:
    """Fit of value = even powers of r + g.h to some rows; returns g."""
    design = np.concatenate([h, _basis(r, powers)], axis=1)

    def fit(rows: NDArray[np.intp]) -> NDArray[np.float64]:
        return _solved(design[rows], value[rows], weight[rows])[:2]

    return fit


def _level(
    r: NDArray[np.float64], h: NDArray[np.float64], value: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The part of `value` that is alike all around, at each row."""
    basis = _basis(r, 2)
    return np.asarray(basis @ _solved(np.concatenate([h, basis], axis=1), value, weight)[2:])


def _constant(h: NDArray[np.float64], value: NDArray[np.float64], weight: NDArray[np.float64]) -> _Fit:
    """Fit of the vector value = m0 + k h to some rows; returns m0."""

    def fit(rows: NDArray[np.intp]) -> NDArray[np.float64]:
        n = len(rows)
        right = np.stack([np.ones(n), np.zeros(n), h[rows, 0]], axis=1)
        up = np.stack([np.zeros(n), np.ones(n), h[rows, 1]], axis=1)
        design = np.concatenate([right, up])
        both = np.concatenate([value[rows, 0], value[rows, 1]])
        return _solved(design, both, np.tile(weight[rows], 2))[:2]

    return fit


def _solved(
    design: NDArray[np.float64], value: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.asarray(np.linalg.lstsq(design * weight[:, None], value * weight, rcond=None)[0])


def _third_moment(sample: PsfSample) -> NDArray[np.float64]:
    """<|x|^2 x> / w^3 as (right, up), about the centre of mass, wings below a hundredth cut."""
    kernel = np.where(sample.kernel > _WING * sample.kernel.max(), sample.kernel, 0.0)
    kernel = kernel / kernel.sum()
    t = np.arange(kernel.shape[0]) - kernel.shape[0] // 2
    up, right = -t[:, None] + 0.0 * t[None, :], t[None, :] + 0.0 * t[:, None]
    up, right = up - (kernel * up).sum(), right - (kernel * right).sum()
    squared = up**2 + right**2
    width = math.sqrt(max(float((kernel * squared).sum()) / 2.0, 1e-6))
    return np.array([(kernel * squared * right).sum(), (kernel * squared * up).sum()]) / width**3


def _asymmetry(fit: _Fit, groups: NDArray[np.intp], scale: float) -> Asymmetry:
    """The fitted vector times `scale`, with the larger error of leaving out photos and samples."""
    rows = np.arange(len(groups))
    vector = fit(rows)
    error, freedom = _jackknife(fit, rows)
    if len(np.unique(groups)) > 1:
        by_photo, photos = _jackknife(fit, groups)
        if by_photo > error:
            error, freedom = by_photo, photos
    length = float(np.hypot(*vector))
    # |g|^2 / (2 s^2) is distributed as F with 2 and 2 (n - 1) degrees where there is only chance
    limit = math.sqrt(2.0 * _exceeded_by_chance(max(freedom, 1)))
    return Asymmetry(
        amount=scale * length,
        direction=math.atan2(float(vector[1]), float(vector[0])),
        error=scale * error,
        significant=length > limit * error,
    )


def _exceeded_by_chance(half_freedom: int) -> float:
    """Value that F with 2 and 2 m degrees exceeds with probability p = `_CHANCE`.

    Its survival function is (1 + x / m)^-m: the integral of the density of F with two degrees above has a
    closed form, and `scipy.stats`, half a second of imports, is not needed for it.
    """
    return half_freedom * (_CHANCE ** (-1.0 / half_freedom) - 1.0)


def _jackknife(fit: _Fit, groups: NDArray[np.intp]) -> tuple[float, int]:
    """Standard error of a component and the degrees of freedom, leaving out one group at a time."""
    names = np.unique(groups)
    others = np.array([fit(np.flatnonzero(groups != name)) for name in names])
    n = len(names)
    variance = (n - 1) / n * ((others - others.mean(axis=0)) ** 2).sum(axis=0)
    return math.sqrt(float(variance.mean())), n - 1


def _verdict(softer: Asymmetry, coma: Asymmetry | None, photos: int) -> tuple[Verdict, str]:
    photographs = "one photo" if photos == 1 else f"{photos} photos"
    signs = []
    if softer.significant and softer.amount > _SOFTER:
        ratio, more = math.exp(softer.amount), math.exp(softer.amount + softer.error)
        signs.append(
            f"the {direction_in_words(softer.direction)} is softer than the opposite side, "
            f"its blur {ratio:.2f} times as wide, give or take {more - ratio:.2f}"
        )
    if coma is not None and coma.significant and coma.amount > _COMATIC:
        signs.append(
            f"points in the middle of the picture have tails towards the {direction_in_words(coma.direction)}"
        )
    if not signs:
        spread = 100.0 * math.expm1(2.0 * softer.error)
        sides = 100.0 * math.expm1(softer.amount)
        if sides + spread > _UNSURE_PERCENT:
            return "unknown", (
                f"{photographs} cannot tell whether the lens is centred: opposite sides differ by "
                f"{sides:.0f} %, give or take {spread:.0f} %"
            )
        return "centred", (
            f"well centred within what {photographs} can tell: the blur of opposite sides differs by "
            f"{sides:.0f} %, give or take {spread:.0f} %"
        )
    described = "; ".join(signs)
    if photos == 1:
        return "unknown", (
            f"perhaps decentred: {described}; one photo cannot tell this from a subject at a slant; "
            "a second one can"
        )
    return "decentred", f"decentred: {described}"
