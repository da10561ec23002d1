"""A lens test: a report for each aperture and colour, with its errors, and a sentence for photographers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Final

import numpy as np

from lensmodel.core.geometry import zone_of
from lensmodel.core.types import ZONES, Channel, StepHook, Zone, ignore_step
from lensmodel.model import LensModel
from lensmodel.photo.lateral import LateralColour
from lensmodel.report.advice import Advice, advice
from lensmodel.report.bootstrap import DRAWS, Spread, spreads_of
from lensmodel.report.lens_report import LensReport, ReportSettings, apertures, lens_report, widest
from lensmodel.report.places import DEFAULT_ASPECT
from lensmodel.report.units import SensorGeometry

MOST_APERTURES: Final = 4  # a reader compares no more at once (chosen)
ROWS: Final = 7  # of the grid of places: zones have some each, and their figures are still readable (chosen)

_EVEN, _NEARLY, _SOFTER = 0.95, 0.8, 0.5
"""Shares of the centre's MTF50 above which corners are called as good, nearly as good, and clearly softer
(chosen: a fifth less is hardly seen in a print, half as much at a glance)."""

_CRISP, _SHARP, _SOFT = 0.35, 0.2, 0.1
"""MTF50 in cycles/pixel of the centre above which a lens is called as sharp as a sensor shows, sharp, and
a little soft (chosen: an ideal pixel behind an ideal lens reaches .6, a demosaiced photo about .3)."""

_GUESSED: Final = 0.5
"""Mean expected error of the kernels from which on a verdict is called a guess (chosen: half of a kernel may
be wrong)."""

_LATERAL_R: Final = tuple(round(0.1 * k, 1) for k in range(11))  # half-diagonals (chosen: curves are smooth)


@dataclass(frozen=True, slots=True)
class Tested:
    """What was found at one aperture, in one colour.

    Parameters
    ----------
    report : LensReport
    spread : Spread or None
        Standard errors, of green; None of other colours, and where there is nothing to draw from.
    """

    report: LensReport
    spread: Spread | None = None

    @property
    def zones(self) -> dict[Zone, float]:
        """Mean MTF50 of the map's places in each zone, cycles/pixel."""
        return zone_means(self.report)


@dataclass(frozen=True, slots=True)
class LateralColourCurve:
    """Pixels outwards by which red and blue images lie beyond the green one, by radius."""

    radii: tuple[float, ...]
    red: tuple[float, ...]
    blue: tuple[float, ...]
    photos: int


@dataclass(frozen=True, slots=True)
class LensTest:
    """A whole lens test.

    Parameters
    ----------
    name : str
        Of the lens.
    verdict : str
        For photographers.
    photos, samples : int
        That it rests on.
    sensor : SensorGeometry
        For other units than cycles/pixel.
    tested : tuple of Tested
        By aperture, ascending, and by colour, green first.
    lateral : LateralColourCurve or None
        None where no photo showed it.
    advice : Advice
        Which photo would help most.
    """

    name: str
    verdict: str
    photos: int
    samples: int
    sensor: SensorGeometry
    tested: tuple[Tested, ...]
    lateral: LateralColourCurve | None
    advice: Advice

    def at(self, aperture: float | None, channel: Channel = "g") -> Tested:
        """Return what was found at an aperture that was tested; the widest for None or another one."""
        own = [one for one in self.tested if one.report.settings.channel == channel]
        return next((one for one in own if one.report.settings.aperture == aperture), own[0])

    @property
    def apertures(self) -> tuple[float | None, ...]:
        """Those that were tested."""
        return tuple(dict.fromkeys(one.report.settings.aperture for one in self.tested))


def lens_test(
    model: LensModel,
    name: str,
    *,
    aspect: float = DEFAULT_ASPECT,
    height_px: int | None = None,
    lateral: Sequence[LateralColour] = (),
    channels: Sequence[Channel] = ("g", "r", "b"),
    draws: int = DRAWS,
    rows: int = ROWS,
    size: int = 31,
    on_step: StepHook = ignore_step,
) -> LensTest:
    """Test a lens at the apertures that its photos had.

    Parameters
    ----------
    model : LensModel
    name : str
        Of the lens.
    aspect : float
        Width over height of its photos.
    height_px : int, optional
        Height of its photos in pixels; by default what the samples say.
    lateral : sequence of LateralColour
        What its photos show of lateral colour.
    channels : sequence of {"r", "g", "b"}
    draws : int
        Of the bootstrap; 0 makes no errors.
    rows : int
        Of the maps.
    size : int
        Odd side of the kernels in pixels.
    on_step : StepHook
        Called after each aperture and colour.
    """
    rng = np.random.default_rng(0)  # the same photos make the same report
    options = ReportSettings(rows=rows, cols=max(3, round(rows * aspect)), aspect=aspect, size=size)
    wanted = [replace(widest(model), aperture=n) for n in _chosen(model)] or [widest(model)]
    total = len(wanted) * len(channels)
    reports: list[LensReport] = []
    for settings in wanted:
        for channel in channels:
            reports.append(lens_report(model, settings.with_channel(channel), options))
            on_step(len(reports), total)
    green = [report for report in reports if report.settings.channel == "g"]
    known = spreads_of(model, green, size, rng, draws) if green and draws > 0 else [None] * len(green)
    spreads = {id(report): spread for report, spread in zip(green, known, strict=True)}
    tested = [Tested(report, spreads.get(id(report))) for report in reports]
    first = tested[0].report
    return LensTest(
        name=name,
        verdict=verdict(first),
        photos=first.photos,
        samples=first.samples,
        sensor=SensorGeometry(first.pixel_pitch_um, height_px or _height(model, aspect)),
        tested=tuple(tested),
        lateral=_lateral(lateral),
        advice=advice(model),
    )


def _chosen(model: LensModel) -> list[float]:
    """Apertures to test: all, or where there are many the ends and those between with most samples."""
    known = list(apertures(model))
    if len(known) <= MOST_APERTURES:
        return known
    inner = sorted(known[1:-1], key=lambda n: -sum(s.settings.aperture == n for s in model.samples))
    return sorted([known[0], known[-1], *inner[: MOST_APERTURES - 2]])


def _height(model: LensModel, aspect: float) -> int | None:
    """Height of the photos by their half diagonals, where the samples know and agree."""
    known = {s.half_diagonal_px for s in model.samples}
    half = next(iter(known)) if len(known) == 1 else None
    long = max(aspect, 1.0 / aspect)
    return None if half is None else round(2.0 * half / math.hypot(long, 1.0))


def _lateral(measured: Sequence[LateralColour]) -> LateralColourCurve | None:
    """Median displacement over the photos that could tell: one without edges cannot spoil it."""
    columns: dict[Channel, list[LateralColour]] = {
        "r": [each for each in measured if each.red_points > 0],
        "b": [each for each in measured if each.blue_points > 0],
    }
    if not columns["r"] or not columns["b"]:
        return None
    red, blue = (
        tuple(median(each.displacement(r, channel) for each in columns[channel]) for r in _LATERAL_R)
        for channel in ("r", "b")
    )
    return LateralColourCurve(_LATERAL_R, red, blue, min(len(columns["r"]), len(columns["b"])))


def zone_means(report: LensReport) -> dict[Zone, float]:
    """Mean MTF50 of the places of a map in each zone, cycles/pixel."""
    by_zone: dict[Zone, list[float]] = {zone: [] for zone in ZONES}
    for point in report.field:
        by_zone[zone_of(point.position.r)].append(point.mean)
    return {zone: float(np.mean(values)) if values else math.nan for zone, values in by_zone.items()}


def verdict(report: LensReport) -> str:
    """Say in one sentence what a photographer wants to know of a lens."""
    means = zone_means(report)
    center, corner = means["center"], means["corner"]
    aperture = report.settings.aperture
    at = "" if aperture is None else f"At f/{aperture:g} "
    sharpness = f"{at}this copy is {_level(center)} in the centre, and {_fall(corner / center)}."
    sharpness = sharpness[0].upper() + sharpness[1:]
    best = ""
    if report.best_aperture and report.best_aperture["whole"] != aperture:
        best = f" It is sharpest over the whole picture at f/{report.best_aperture['whole']:g}."
    centring = {
        "centred": " It is well centred.",
        "decentred": " It is decentred: one side is softer than the other.",
        "unknown": " It is not yet possible to say whether it is centred.",
    }[report.decentring.verdict]
    error = float(np.mean([point.predicted_error for point in report.field]))
    caution = " Much of this is still a guess; more photos will help." if not error < _GUESSED else ""
    return f"{sharpness}{best}{centring}{caution}"


def _level(center: float) -> str:
    if center >= _CRISP:
        return "as sharp as the sensor can show"
    if center >= _SHARP:
        return "sharp"
    return "a little soft" if center >= _SOFT else "soft"


def _fall(share: float) -> str:
    if not math.isfinite(share):
        return "little is known of its corners"
    if share >= _EVEN:
        return "its corners are just as good"
    if share >= _NEARLY:
        return "its corners are nearly as good"
    return "its corners are clearly softer" if share >= _SOFTER else "its corners are much softer"
