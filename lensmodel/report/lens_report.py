"""The report on one copy of a lens: how sharp it is where, at which apertures and in which colours.

Everything follows from the model. Frequencies are cycles/pixel. Tangential is the contrast along u (of lines
across the radius), sagittal along v; the two are never mixed but where "mean" says so. How far off a figure
may be is what the model expects of the kernel at its place (`predicted_error`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Final, Literal, TypeAlias

import numpy as np
from scipy.spatial import Delaunay, QhullError

from lensmodel.core import types
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import places_of
from lensmodel.core.types import ZONES, FieldPosition, LensSettings, Zone
from lensmodel.model import LensModel, PsfAnswer
from lensmodel.neural.network import RING_MIDDLES
from lensmodel.quality import crossing, mtf50_from_kernel, mtf_from_kernel
from lensmodel.report.centring import Centring, centring

# Width over height of a 35 mm frame; a profile does not say how wide its photos were
DEFAULT_ASPECT: Final = 1.5
Unit = Literal["c/px", "lp/ph", "lp/mm"]
UNIT_NAMES: Final[dict[Unit, str]] = {
    "c/px": "cycles/pixel",
    "lp/ph": "line pairs per picture height",
    "lp/mm": "line pairs per mm",
}
DIRECTIONS: Final = ("tangential", "sagittal")
# Cycles/pixel: beyond it a sensor shows no finer lines, and a measured MTF50 says only "at least"
NYQUIST: Final = 0.5
_MOST_APERTURES: Final = 4  # a reader compares no more at once (chosen)
_ROWS: Final = 7  # of the grid of places: zones have some each, and their figures are still readable (chosen)
# Curves are drawn at one to four times such a step in lp/mm: 10 to 40, as lens tests are, and for sensors
# with small pixels at the largest of which four lie below half of the Nyquist frequency (chosen)
_STEPS_MM: Final = (50.0, 20.0, 10.0)
# Cycles/pixel of the curves where no pixel pitch is known: 10 to 40 lp/mm at 5 micrometres (chosen)
_FREQUENCIES: Final = (0.05, 0.1, 0.15, 0.2)
# Half-diagonals (chosen: nothing is asked in the very corner, which no sample reaches)
RADII: Final = tuple(float(r) for r in np.linspace(0.0, 0.95, 11).round(4))
_ROUND: Final = 1.05  # of the hull of measured places, which a figure may lie beyond (chosen)
# Shares of the centre's MTF50 above which a place is called as sharp, nearly as sharp, and clearly softer
# (chosen: a fifth less is hardly seen in a print, half as much at a glance)
_EVEN: Final = 0.95
_FALLS: Final = ((_EVEN, "as sharp"), (0.8, "nearly as sharp"), (0.5, "clearly softer"), (0.0, "much softer"))
# MTF50 in cycles/pixel of the centre, and what it is called (chosen: an ideal pixel behind an ideal lens
# reaches .6, a demosaiced photo about .3)
_LEVELS: Final = ((0.35, "very sharp"), (0.2, "sharp"), (0.1, "a little soft"), (0.0, "soft"))
MARKED: Final = (
    *("centre", "left", "right", "top", "bottom"),
    *("upper left corner", "upper right corner", "lower left corner", "lower right corner"),
)
_ASPECTS: Final = (1.0, 4 / 3, 1.5, 16 / 9)
_FILLED: Final = 0.85  # of the way to a side that samples reach at least (chosen: patches end short of it)
_NAMED: Final = 8  # photos that a report names (chosen: two lines)
_CAUTION: Final = "Caution"  # name among the details of a report of what to allow for in its figures
# Expected relative L2 of a kernel that another photo would not better by what is seen (chosen)
_WELL_KNOWN: Final = 0.1
# Expected relative L2 of a kernel from which on a place is drawn as unknown (chosen: half may be wrong)
UNKNOWN: Final = 0.5
# Errors of the transfer function that a range of MTF50 allows for (chosen on three ray-traced lenses; how
# often ranges then hold is printed by `lab.lens_test`)
_ERRORS: Final = 2.0
# Share of MTF50 of a chart, a target or points that it may be off by even there (chosen: as tests ask)
_MEASURED: Final = 0.15
_SCALE: Final = np.linspace(0.0, 1.0, 513)  # cycles/pixel
_TURNS: Final = (0.0, math.pi / 2.0)  # from u, to what is tangential and sagittal
Range: TypeAlias = tuple[float, float]  # between what MTF50 is expected, cycles/pixel


@dataclass(frozen=True, slots=True)
class SensorGeometry:
    """What turns cycles/pixel into other units."""

    pixel_pitch_um: float | None = None  # micrometres from pixel to pixel
    height_px: int | None = None  # pixels of the shorter side of the picture

    @property
    def units(self) -> dict[Unit, float]:
        """Factors of cycles/pixel in the units that are known: LP/PH = H f, lp/mm = 1000 f / p."""
        per_mm = self.pixel_pitch_um and 1000.0 / self.pixel_pitch_um
        factors: dict[Unit, float | None] = {"c/px": 1.0, "lp/ph": self.height_px, "lp/mm": per_mm}
        return {unit: float(factor) for unit, factor in factors.items() if factor}

    def words(self, frequency: float, unit: Unit = "c/px", between: Range | None = None) -> str:
        """Write a frequency given in cycles/pixel, with its range; beyond Nyquist's only "at least" it."""
        value = min(frequency, NYQUIST) * self.units[unit]
        digits = f"{value:.3f}".removeprefix("0") if unit == "c/px" else f"{value:.0f}"
        words = f"at least {digits}" if frequency >= NYQUIST else digits
        if between is None or between[0] >= NYQUIST:
            return words
        low, high = (self.words(end, unit) for end in between)
        return f"{words} [{low} to {high.replace('at least', 'over')}]"


@dataclass(frozen=True, slots=True)
class Curve:
    """Contrast at one frequency over `RADII`, mean over the ways to the four corners."""

    name: str  # the frequency in lp/mm where the pixel pitch is known, else in cycles/pixel
    frequency: float  # cycles/pixel
    tangential: tuple[float, ...]
    sagittal: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Spot:
    """What the lens makes of a point at one place: MTF50, at most the Nyquist frequency, and the kernel."""

    place: str  # as "upper left corner"; empty on a map
    position: FieldPosition
    mtf50: tuple[float, float]  # tangential, sagittal; the Nyquist frequency means at least that
    ranges: tuple[Range, Range]  # between what these are expected
    predicted_error: float  # expected relative L2 of the kernel
    unknown: bool  # whether too little is known of the place to call this the lens
    kernel: tuple[tuple[float, ...], ...] = ()  # its rows, left out of the places of a map

    @property
    def mean(self) -> float:
        """Mean of both MTF50."""
        return sum(self.mtf50) / 2.0

    @property
    def mean_range(self) -> Range:
        """Between what the mean is expected."""
        low, high = np.mean(self.ranges, axis=0).tolist()
        return low, high

    @property
    def words(self) -> str:
        """Both figures with their ranges, never one of the two."""
        return "T {}, S {}".format(*self.figures(SensorGeometry()))

    def figures(self, sensor: SensorGeometry, unit: Unit = "c/px") -> list[str]:
        """Both figures with their ranges, in a unit."""
        return [sensor.words(*figure) for figure in zip(self.mtf50, (unit, unit), self.ranges, strict=True)]


@dataclass(frozen=True, slots=True)
class ApertureReport:
    """What was found at one aperture, in green."""

    settings: LensSettings
    aspect: float  # width over height of the map
    rows: int
    cols: int
    map: tuple[Spot, ...]  # row by row from the top left, without kernels
    spots: tuple[Spot, ...]  # of `marked_places`: the centre, the four sides, the four corners
    radii: tuple[float, ...]
    curves: tuple[Curve, ...]
    centring: Centring

    @property
    def corners(self) -> tuple[Spot, ...]:
        """The four corners."""
        return self.spots[5:]

    @property
    def unknown_share(self) -> float:
        """Share of the map of which too little is known to draw it as if it were the lens."""
        return sum(spot.unknown for spot in self.map) / len(self.map)

    @property
    def zones(self) -> dict[Zone, float]:
        """Mean MTF50 of the map's places in each zone, cycles/pixel; not a number where it has none."""
        own = {zone: [s.mean for s in self.map if types.zone_of(s.position.r) == zone] for zone in ZONES}
        return {zone: float(np.mean(means)) if means else math.nan for zone, means in own.items()}

    @property
    def worst(self) -> Spot:
        """The softest corner."""
        return min(self.corners, key=lambda spot: spot.mean)

    @property
    def at(self) -> str:
        """The aperture in words, empty where it is unknown."""
        return "" if self.settings.aperture is None else f"f/{self.settings.aperture:g}"


@dataclass(frozen=True, slots=True)
class LensReport:
    """A whole report."""

    name: str  # of the lens
    verdict: str  # for photographers
    photos: int  # that it rests on
    places: int  # at which these show the blur, in the colour that most of them show
    sensor: SensorGeometry  # for other units than cycles/pixel
    tested: tuple[ApertureReport, ...]  # by aperture, ascending
    # what else stands on the page: camera, serial, names of photos, a caution
    details: Mapping[str, str] = field(default_factory=dict)

    def at(self, aperture: float | None) -> ApertureReport:
        """Return what was found at an aperture; at the widest for None or one not tested."""
        return next((one for one in self.tested if one.settings.aperture == aperture), self.tested[0])

    @property
    def apertures(self) -> tuple[float | None, ...]:
        """Those that were tested."""
        return tuple(one.settings.aperture for one in self.tested)

    @property
    def facts(self) -> str:
        """What it rests on, in words."""
        facts = f"{self.photos} photo{'s' * (self.photos != 1)}"
        facts += f", blur measured at {self.places} place{'s' * (self.places != 1)}"
        if (pitch := self.sensor.pixel_pitch_um) is not None:
            facts += f", pixels of {pitch:.2f} micrometres, Nyquist frequency {500.0 / pitch:.0f} lp/mm"
        return facts

    @property
    def advice(self) -> str:
        """Which photo would help most: of the place and aperture whose blur is known least."""
        spots = [(spot, one) for one in self.tested for spot in one.spots]
        least, tested = max(spots, key=lambda pair: pair[0].predicted_error)
        if least.predicted_error < _WELL_KNOWN:
            return "The lens is well known by now; another photo would add little."
        at = f", taken at {tested.at}," if tested.at else ""
        return (
            f"A photo with fine detail at the {least.place}{at} would help most: what is known of the blur "
            f"there is expected to be wrong by {least.predicted_error:.0%}, more than elsewhere."
        )

    @property
    def summary(self) -> tuple[str, ...]:
        """The report in sentences, those of its first aperture."""
        share = self.tested[0].unknown_share
        guesses = f"Too little is known of {share:.0%} of the picture; those figures are guesses."
        lines = (self.verdict, guesses if share else "", self.details.get(_CAUTION, ""), self.advice)
        return tuple(filter(None, lines))


def caution(photos: Sequence[str]) -> str:
    """Say of the file names of photos that cameras have sharpened some; nothing where none is a JPEG."""
    jpegs = sum(name.lower().endswith((".jpg", ".jpeg")) for name in photos)
    share = f"Learned from JPEG files ({jpegs} of {len(photos)} photos)"
    return f"{share}: the camera's sharpening makes a lens look sharper." if jpegs else ""


def provenance(serial: str | None, cameras: Iterable[str], photos: Sequence[str]) -> dict[str, str]:
    """Say on which copy and photos a report rests, when and by what it was written; a caveat for JPEG."""
    names = sorted(photos)
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    details = {
        "Serial number": serial or "",
        "Camera": ", ".join(dict.fromkeys(filter(None, cameras))),
        "Photos": ", ".join(names[:_NAMED]) + more,
        _CAUTION: caution(photos),
        "Written": f"{datetime.now(UTC):%Y-%m-%d} by lensmodel {version('lensmodel')}",
    }
    return {name: words for name, words in details.items() if words}


def lens_report(
    model: LensModel,
    name: str,
    *,
    aspect: float | None = None,
    height_px: int | None = None,
    apertures: Sequence[float] | None = None,
    rows: int = _ROWS,
    size: int = 31,
    on_step: types.StepHook = types.ignore_step,
) -> LensReport:
    """Report on a lens at the apertures of its photos, or at those that are given.

    `aspect` is the width over height of its photos, `height_px` their height in pixels, by default what its
    samples come to; `rows` counts those of the maps, `size` is the odd side of the kernels in pixels.
    """
    aspect = filled_aspect(model) if aspect is None else aspect
    cols = max(3, round(rows * aspect))
    places = [*marked_places(aspect).items(), *(("", at) for at in grid(rows, cols, aspect))]
    numbers = _chosen(model) if apertures is None else apertures
    questions = [LensSettings(aperture=n) for n in numbers] or [LensSettings()]
    known = ({getattr(s, n) for s in model.samples} for n in ("pixel_pitch_um", "half_diagonal_px"))
    pitch, half = (values.pop() if len(values) == 1 else None for values in known)
    measured = all(sample.measured for sample in model.samples)
    tested = []
    for settings in questions:
        spots = _spots(model, settings, places, size, measured)
        tested.append(
            ApertureReport(
                settings=settings,
                aspect=aspect,
                rows=rows,
                cols=cols,
                map=tuple(replace(spot, kernel=()) for spot in spots[9:]),
                spots=tuple(spots[:9]),
                radii=RADII,
                curves=_curves(model, settings, aspect, size, _frequencies(pitch)),
                centring=centring(model, settings),
            )
        )
        on_step(len(tested), len(questions))
    if height_px is None and half is not None:
        height_px = round(2.0 * half * min(half_sides(aspect)))
    return LensReport(
        name=name,
        verdict=_verdict(tested),
        photos=len({sample.photo for sample in model.samples}),
        places=places_of(model.samples),
        sensor=SensorGeometry(pitch, height_px),
        tested=tuple(tested),
    )


def _spots(
    model: LensModel,
    settings: LensSettings,
    places: Sequence[tuple[str, FieldPosition]],
    size: int,
    measured: bool,
) -> list[Spot]:
    """What a model knows of named places.

    Beyond the outermost samples of a chart or a target the regression extrapolates: corners there came out
    softer by 38 to 47 %.
    """
    outside = np.zeros(len(places), dtype=np.bool_)
    if not model.weights:
        with suppress(QhullError):  # too few samples, or all on a line
            hull = Delaunay([_ROUND * np.array(sample.position.xy) for sample in model.samples])
            outside = hull.find_simplex([at.xy for _, at in places]) < 0
    spots = []
    for (words, at), beyond in zip(places, outside, strict=True):
        answer = model.query(at, settings, size)
        error = float(answer.predicted_error)
        mtf50, ranges = zip(*(_mtf50(answer, at.phi + turn, measured) for turn in _TURNS), strict=True)
        unknown = bool(answer.extrapolated or beyond or not (measured or error < UNKNOWN))
        kernel = tuple(tuple(row) for row in answer.kernel.round(7).tolist())
        spots.append(Spot(words, at, mtf50, ranges, error, unknown, kernel))
    return spots


def _mtf50(answer: PsfAnswer, angle: float, measured: bool) -> tuple[float, Range]:
    """MTF50 along an angle, and where it lies with the contrast wrong by `_ERRORS` times what is expected.

    Neither goes beyond the Nyquist frequency, which then means "at least".
    """
    value = mtf50_from_kernel(answer.kernel, angle)
    if answer.ring_error is None:
        # between and beyond the places of a chart less is known than at them
        share = max(answer.predicted_error, _MEASURED if measured else 0.0)
        low, high = max(value * (1.0 - share), 0.0), value * (1.0 + share)
    else:
        contrast = mtf_from_kernel(answer.kernel, angle, _SCALE)
        error = _ERRORS * np.interp(_SCALE, RING_MIDDLES, answer.ring_error)
        low, high = crossing(_SCALE, contrast - error, 0.5), crossing(_SCALE, contrast + error, 0.5)
    return min(value, NYQUIST), (min(low, NYQUIST), min(high, NYQUIST))


def _curves(
    model: LensModel, settings: LensSettings, aspect: float, size: int, named: Mapping[str, float]
) -> tuple[Curve, ...]:
    """Contrast at named frequencies from the centre to the corners, mean of the four."""
    places = [FieldPosition(r, phi) for r in RADII for phi in corner_angles(aspect)]
    contrasts = [
        [mtf_from_kernel(kernel, at.phi + turn, list(named.values())) for turn in _TURNS]
        for kernel, at in zip(model.kernels(places, settings, size), places, strict=True)
    ]
    mean = np.reshape(contrasts, (len(RADII), 4, 2, len(named))).mean(axis=1)
    mean[0] = mean[0].mean(axis=0)  # u has no direction in the centre
    both = mean.transpose(2, 1, 0).tolist()
    return tuple(Curve(*of, *map(tuple, t_s)) for of, t_s in zip(named.items(), both, strict=True))


def _frequencies(pitch_um: float | None) -> dict[str, float]:
    """Names and cycles/pixel of the curves, only those up to the Nyquist frequency of the sensor."""
    if pitch_um is None:
        return {f"{f:.3g} c/px": f for f in _FREQUENCIES}
    step = next((step for step in _STEPS_MM if 8.0 * step <= 500.0 / pitch_um), _STEPS_MM[-1])
    named = {f"{k * step:.3g} lp/mm": k * step * pitch_um / 1000.0 for k in range(1, 5)}
    return {name: f for name, f in named.items() if f <= NYQUIST}


def _verdict(tested: Sequence[ApertureReport]) -> str:
    """Say what a photographer wants to know: centre, worst corner, best aperture, centring."""
    found, words = tested[0], [sharpness(tested[0])]
    means = {one.settings.aperture: float(np.mean([spot.mean for spot in one.map])) for one in tested}
    best = max(means, key=lambda n: (means[n], -(n or 0.0)), default=None)
    if len(means) > 1 and best != found.settings.aperture:
        words.append(f"It is sharpest over the whole picture at f/{best:g}.")
    words.append(f"{found.centring.text[:1].upper()}{found.centring.text[1:]}.")
    if not np.mean([spot.predicted_error for spot in found.map]) < UNKNOWN:
        words.append("Much of this is still a guess; more photos will help.")
    return " ".join(words)


def sharpness(found: ApertureReport) -> str:
    """Say in one sentence how sharp a copy is in the centre and in its worst corner."""
    center, worst = found.spots[0].mean, found.worst
    level = next(words for least, words in _LEVELS if center >= least)
    figure = SensorGeometry().words(center, "c/px", found.spots[0].mean_range)
    words = f"this copy is {level} in the centre (MTF50 {figure} cycles/pixel)"
    share = worst.mean / max(center, 1e-6)
    how = next(words for least, words in _FALLS if share >= least)
    # surely softer only where even the top of its range lies below the middle of the centre's
    sure = not worst.unknown and (share >= _EVEN or worst.mean_range[1] < center)
    corner = worst.place.removesuffix(" corner")
    fall = f"its worst corner, the {corner}, {'is' if sure else 'seems'} {how} ({worst.words})"
    unknown = ", but too little is known there" if worst.unknown else ""
    begin = f"At {found.at} {words}" if found.at else f"{words[0].upper()}{words[1:]}"
    return f"{begin}, and {fall}{unknown}."


def compare(first: LensReport, second: LensReport) -> str:
    """Say in which zones the second copy is sharper or softer, each at the first aperture of its report."""
    changes = []
    for zone, where in zip(ZONES, ("in the centre", "halfway out", "in the corners"), strict=True):
        share = second.tested[0].zones[zone] / first.tested[0].zones[zone] - 1.0
        how = f"{abs(share):.0%} {'sharper' if share > 0 else 'softer'}"
        changes.append(f"{'about the same' if abs(share) < 1.0 - _EVEN else how} {where}")
    begin = f"Compared with this copy, the other one ({second.name}) is"
    return f"{begin} {', '.join(changes[:-1])} and {changes[-1]}."


# --- what the samples of a lens tell of its photos -----------------------------------------------


def widest(model: LensModel) -> LensSettings:
    """The widest aperture that a photo had, green; focal length and distance as unknown."""
    return LensSettings(aperture=min(_apertures(model), default=None))


def _apertures(model: LensModel) -> list[float]:
    return [s.settings.aperture for s in model.samples if s.settings.aperture is not None]


def _chosen(model: LensModel) -> list[float]:
    """Apertures to test: all, or where there are many the ends and those between with most samples."""
    numbers = _apertures(model)
    known = sorted(set(numbers))
    inner = sorted(known[1:-1], key=lambda n: -numbers.count(n))[: _MOST_APERTURES - 2]
    return sorted({*known[:1], *known[-1:], *inner})


def filled_aspect(model: LensModel) -> float:
    """Aspect of common sensors whose sides the samples reach alike; 3:2 where they leave its sides free.

    A chart has a shape of its own, and says nothing of the frame's.
    """
    places = [s.position.xy for s in model.samples if not s.measured] or [(0.0, 0.0)]
    reached = np.abs(places).max(axis=0)
    shares = {aspect: reached / half_sides(aspect) for aspect in _ASPECTS}
    inside = [a for a, share in shares.items() if share.max() <= 1.0 and share.min() > _FILLED]
    return min(inside, key=lambda a: float(np.ptp(shares[a])), default=DEFAULT_ASPECT)


# --- places of the field -------------------------------------------------------------------------


def half_sides(aspect: float) -> tuple[float, float]:
    """Half width and half height of a frame in half diagonals."""
    if not 0.2 <= aspect <= 5.0:  # of a strip a map would have any number of columns
        raise InvalidInputError(f"width over height must lie in 0.2..5, got {aspect}")
    diagonal = math.hypot(aspect, 1.0)
    return aspect / diagonal, 1.0 / diagonal


def grid(rows: int, cols: int, aspect: float) -> tuple[FieldPosition, ...]:
    """Centres of rows x cols equal cells of the picture, row by row from the top left."""
    r, phi = types.field_grid(rows, cols, aspect=aspect)
    return tuple(map(FieldPosition, r.ravel().tolist(), phi.ravel().tolist()))


def corner_angles(aspect: float) -> tuple[float, float, float, float]:
    """Upper left, upper right, lower left, lower right."""
    angle = math.atan(1.0 / aspect)
    return math.pi - angle, angle, angle - math.pi, -angle


def marked_places(aspect: float) -> dict[str, FieldPosition]:
    """The centre, the sides at four fifths, and the corners as far out as samples reach, by their names."""
    width, height = (0.8 * half for half in half_sides(aspect))
    sides = (width, math.pi), (width, 0.0), (height, math.pi / 2.0), (height, -math.pi / 2.0)
    places = ((0.0, 0.0), *sides, *((0.9, angle) for angle in corner_angles(aspect)))
    return {name: FieldPosition(*place) for name, place in zip(MARKED, places, strict=True)}
