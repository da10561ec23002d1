"""The report on one copy of a lens: sharpness over the field, best aperture, centring.

Everything follows from the model and its samples. Frequencies are cycles/pixel; where the samples
know their pixel pitch, the curves are drawn at 10 to 40 line pairs per millimetre, as lens tests are.
Tangential is the contrast along u (of lines across the radius), sagittal along v.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import ZONES, FieldPosition, LensSettings, Zone
from lensmodel.model import LensModel
from lensmodel.model.provenance import answerers_in_words
from lensmodel.quality import mtf_from_kernel, tangential_sagittal_mtf50
from lensmodel.report.decentring import Decentring, decentring
from lensmodel.report.field_shape import FieldShape, Ring, field_shape
from lensmodel.report.places import DEFAULT_ASPECT, grid, ring
from lensmodel.report.units import SensorGeometry

_STEPS_MM: Final = (50.0, 20.0, 10.0)
"""Curves are drawn at one to four times such a step in lp/mm: 10 to 40, as lens tests are, and for sensors
with small pixels at the largest of which four lie below half of the Nyquist frequency (chosen)."""

FALLBACK_FREQUENCIES: Final = (0.05, 0.1, 0.15, 0.2)
"""Cycles/pixel of the curves where no pixel pitch is known: 10 to 40 lp/mm at 5 micrometres (chosen)."""

# Half-diagonals (chosen: nothing is asked in the very corner, which no sample reaches)
_RADII: Final = tuple(float(r) for r in np.linspace(0.0, 0.95, 11).round(4))
_RING: Final = 3  # places in each quarter of a ring whose mean is its value: more hardly change it (chosen)
_MOST_APERTURES: Final = 12  # a page holds as many rows (chosen)
# Half-diagonals (chosen: about the middle of each zone)
_ZONE_RADIUS: Final[dict[Zone, float]] = {"center": 0.15, "mid": 0.5, "corner": 0.88}


@dataclass(frozen=True, slots=True)
class ReportSettings:
    """What a report looks at.

    Parameters
    ----------
    rows, cols : int
        Cells of the map.
    aspect : float
        Width over height of the picture.
    size : int
        Odd side of the kernels, pixels.
    frequencies : tuple of float
        Of the curves, cycles/pixel; empty: 10, 20, 30 and 40 lp/mm
        by the samples' pixel pitch, or 0.05 to 0.2.
    """

    rows: int = 7
    cols: int = 11
    aspect: float = DEFAULT_ASPECT
    size: int = 31
    frequencies: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not 3 <= self.size <= 255 or self.size % 2 == 0:
            raise InvalidInputError(f"size must be odd and lie in 3..255, got {self.size}")
        if any(not 0.0 < f <= 0.5 for f in self.frequencies):
            raise InvalidInputError(f"frequencies must lie in 0..0.5 cycles/pixel, got {self.frequencies}")


@dataclass(frozen=True, slots=True)
class MapPoint:
    """Sharpness at one place, MTF50 in cycles/pixel; which model answered there, and why that one."""

    position: FieldPosition
    tangential: float
    sagittal: float
    predicted_error: float
    effective_samples: float
    extrapolated: bool
    answered_by: str = ""
    reason: str = ""

    @property
    def mean(self) -> float:
        """Mean of both MTF50."""
        return (self.tangential + self.sagittal) / 2.0


@dataclass(frozen=True, slots=True)
class Curve:
    """Contrast at one frequency over the radius.

    Parameters
    ----------
    frequency : float
        Cycles/pixel.
    lp_mm : float or None
        The same in line pairs per millimetre, where the pixel pitch is known.
    tangential, sagittal : tuple of float
        Mean over the angles that lie on the picture, one value for each radius of the report.
    tangential_spread, sagittal_spread : tuple of float
        Standard deviation over the angles: zero in a centred lens.
    """

    frequency: float
    lp_mm: float | None
    tangential: tuple[float, ...]
    sagittal: tuple[float, ...]
    tangential_spread: tuple[float, ...]
    sagittal_spread: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ApertureRow:
    """MTF50 in cycles/pixel at one aperture at r = 0.15, 0.5 and 0.88; `whole` weighs them by area.

    `answered_by` says in words which models answered, and why.
    """

    aperture: float
    center: float
    mid: float
    corner: float
    whole: float
    answered_by: str = ""


@dataclass(frozen=True, slots=True)
class LensReport:
    """What a model says of its lens, at some settings.

    Parameters
    ----------
    settings : LensSettings
    photos, samples : int
        Behind the model, of all settings.
    pixel_pitch_um : float or None
        Of the samples, where they agree.
    aspect : float
        Width over height of the map.
    rows, cols : int
    field : tuple of MapPoint
        rows x cols places, row by row from the top left.
    radii : tuple of float
        Of the curves and the field's shape.
    curves : tuple of Curve
    shape : FieldShape
    apertures : tuple of ApertureRow
        One for each aperture that a photo had; empty where none is known.
    best_aperture : mapping of str to float
        f-number of the largest MTF50 for "center", "mid", "corner" and "whole"; empty with fewer
        than two apertures.
    decentring : Decentring
    extrapolated_share : float
        Share of the map for which no sample is near, 0..1.
    summary : tuple of str
        The report in sentences.
    curves_answered_by : str
        Which models answered for the curves and the field's shape, and why, in words.
    """

    settings: LensSettings
    photos: int
    samples: int
    pixel_pitch_um: float | None
    aspect: float
    rows: int
    cols: int
    field: tuple[MapPoint, ...]
    radii: tuple[float, ...]
    curves: tuple[Curve, ...]
    shape: FieldShape
    apertures: tuple[ApertureRow, ...]
    best_aperture: dict[str, float]
    decentring: Decentring
    extrapolated_share: float
    summary: tuple[str, ...]
    curves_answered_by: str = ""


def lens_report(
    model: LensModel, settings: LensSettings | None = None, options: ReportSettings | None = None
) -> LensReport:
    """Report on a lens at some settings.

    Parameters
    ----------
    model : LensModel
    settings : LensSettings, optional
        Default: the widest aperture that a photo had, where faults show most; green.
    options : ReportSettings, optional

    Notes
    -----
    About 200 questions to the model, and 12 more for each aperture: a second or two.
    """
    settings = widest(model) if settings is None else settings
    options = options or ReportSettings()
    field = tuple(
        map_point(model, place, settings, options.size)
        for place in grid(options.rows, options.cols, options.aspect)
    )
    pitch = _pitch(model)
    answers = [
        [(p, model.query(p, settings, options.size)) for p in ring(r, _RING, options.aspect)] for r in _RADII
    ]
    rings = [[(place, answer.kernel) for place, answer in places] for places in answers]
    made = [(answer.answered_by, answer.reason) for places in answers for _, answer in places]
    shape = field_shape(_RADII, rings)
    rows = tuple(_aperture_row(model, settings, n, options) for n in apertures(model))
    best = {} if len(rows) < 2 else {zone: _best(rows, zone) for zone in (*ZONES, "whole")}
    centring = decentring(model, settings)
    unseen = sum(point.extrapolated for point in field) / len(field)
    return LensReport(
        settings=settings,
        photos=len({s.photo for s in model.samples}),
        samples=len(model.samples),
        pixel_pitch_um=pitch,
        aspect=options.aspect,
        rows=options.rows,
        cols=options.cols,
        field=field,
        radii=_RADII,
        curves=tuple(_curve(rings, f, lp) for f, lp in _frequencies(options, pitch)),
        shape=shape,
        apertures=rows,
        best_aperture=best,
        decentring=centring,
        extrapolated_share=unseen,
        summary=_summary(field, shape, best, centring, unseen),
        curves_answered_by=answerers_in_words(made),
    )


def apertures(model: LensModel) -> tuple[float, ...]:
    """The f-numbers that photos had, ascending; the twelve with most samples."""
    known = [s.settings.aperture for s in model.samples if s.settings.aperture is not None]
    ranked = sorted(set(known), key=lambda n: (-known.count(n), n))
    return tuple(sorted(ranked[:_MOST_APERTURES]))


def widest(model: LensModel) -> LensSettings:
    """The widest aperture that a photo had, green; focal length and distance as unknown."""
    known = apertures(model)
    return LensSettings(aperture=known[0] if known else None)


def map_point(model: LensModel, place: FieldPosition, settings: LensSettings, size: int) -> MapPoint:
    """Sharpness at one place, with the evidence behind it."""
    answer = model.query(place, settings, size)
    tangential, sagittal = tangential_sagittal_mtf50(answer.kernel, place.phi)
    return MapPoint(
        place,
        tangential,
        sagittal,
        answer.predicted_error,
        answer.effective_samples,
        answer.extrapolated,
        answer.answered_by,
        answer.reason,
    )


def answerers(points: Sequence[MapPoint]) -> str:
    """Say which models answered at some places, and why."""
    return answerers_in_words((point.answered_by, point.reason) for point in points)


def _pitch(model: LensModel) -> float | None:
    known = {s.pixel_pitch_um for s in model.samples}
    return next(iter(known)) if len(known) == 1 else None


def _frequencies(options: ReportSettings, pitch_um: float | None) -> list[tuple[float, float | None]]:
    """Cycles/pixel and lp/mm of the curves, only those below the Nyquist frequency of the sensor."""
    if options.frequencies or pitch_um is None:
        chosen = options.frequencies or FALLBACK_FREQUENCIES
        return [(f, None if pitch_um is None else f * 1000.0 / pitch_um) for f in chosen]
    nyquist = 500.0 / pitch_um
    step = next((step for step in _STEPS_MM if 4.0 * step <= nyquist / 2.0), _STEPS_MM[-1])
    pairs = [(k * step * pitch_um / 1000.0, k * step) for k in range(1, 5)]
    return [(f, lp) for f, lp in pairs if f <= 0.5]


_CYCLES: Final = SensorGeometry()


def _curve(rings: list[Ring], frequency: float, lp_mm: float | None) -> Curve:
    def contrast(turn: float) -> list[NDArray[np.float64]]:
        return [
            np.array([mtf_from_kernel(k, p.phi + turn, [frequency])[0] for p, k in places])
            for places in rings
        ]

    tangential, sagittal = contrast(0.0), contrast(math.pi / 2.0)
    if len(rings[0]) == 1:
        # u has no direction at the centre: both are the mean over all, as they are just beside it
        both = np.concatenate([tangential[0], sagittal[0]])
        tangential[0] = sagittal[0] = np.array([both.mean()])
    return Curve(
        frequency,
        lp_mm,
        tuple(float(c.mean()) for c in tangential),
        tuple(float(c.mean()) for c in sagittal),
        tuple(float(c.std()) for c in tangential),
        tuple(float(c.std()) for c in sagittal),
    )


def _aperture_row(
    model: LensModel, settings: LensSettings, aperture: float, options: ReportSettings
) -> ApertureRow:
    asked = replace(settings, aperture=aperture)

    points = {
        zone: [map_point(model, p, asked, options.size) for p in ring(r, 1, options.aspect)]
        for zone, r in _ZONE_RADIUS.items()
    }
    by_zone = {zone: float(np.mean([point.mean for point in own])) for zone, own in points.items()}
    # shares of a 3:2 picture's area: r < 0.3, between, r > 0.75
    whole = 0.15 * by_zone["center"] + 0.65 * by_zone["mid"] + 0.2 * by_zone["corner"]
    made = answerers([point for own in points.values() for point in own])
    return ApertureRow(aperture, by_zone["center"], by_zone["mid"], by_zone["corner"], whole, made)


def _best(rows: tuple[ApertureRow, ...], zone: str) -> float:
    return max(rows, key=lambda row: (getattr(row, zone), -row.aperture)).aperture


def _summary(
    field: tuple[MapPoint, ...],
    shape: FieldShape,
    best: dict[str, float],
    centring: Decentring,
    unseen: float,
) -> tuple[str, ...]:
    sharpest = max(field, key=lambda point: point.mean)
    softest = min(field, key=lambda point: point.mean)
    lines = [
        f"MTF50 lies between {_CYCLES.words(softest.mean)} and {_CYCLES.words(sharpest.mean)} cycles/px "
        "over the picture",
        shape.text,
        centring.text,
    ]
    if best:
        lines.append(
            f"sharpest at f/{best['center']:g} in the centre, at f/{best['corner']:g} in the corners, "
            f"at f/{best['whole']:g} over the whole picture"
        )
    if unseen > 0:
        lines.append(
            f"no photo shows {100.0 * unseen:.0f} % of the picture at these settings; "
            "the figures there are guesses"
        )
    lines.append(answerers(field))
    return tuple(lines)
