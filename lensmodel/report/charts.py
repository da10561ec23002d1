"""The charts of a lens test: maps, curves, colours, field, apertures, centring, lateral colour."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from lensmodel.core.types import ZONE_WORDS, ZONES, Channel
from lensmodel.report.drawing import COLOURS, GREY, INK, Area, Axes, Box, Label, Line, Part, ReportChart
from lensmodel.report.lens_test import LensTest, Tested
from lensmodel.report.palette import colour, ink, rgb
from lensmodel.report.units import NYQUIST, SensorGeometry, Unit

# Layout in points of the picture (chosen: keys and numbers beside the axes are not cut off); axes have five
# steps.
WIDTH: Final = 640
HEIGHT: Final = 380
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 160, 40, 52
_GAP: Final = 20
_SCALE_HIGH: Final = 14
_LEAST_WIDTH_PX: Final = 0.5  # what the axis of widths shows at least: a point may have none (chosen)
_RADII_TICKS: Final = tuple((k / 5, f"{k / 5:.1f}") for k in range(6))
_TURNS: Final = tuple(k * math.pi / 24 for k in range(48))  # radians: so many corners look round (chosen)
_INKS: Final[dict[Channel, str]] = {"r": "#c2410c", "g": "#15803d", "b": "#0b6e99"}
_NAMES: Final[dict[Channel, str]] = {"r": "red", "g": "green", "b": "blue"}


def map_chart(
    tested: Tested, sensor: SensorGeometry, unit: Unit = "c/px", top: float = NYQUIST
) -> ReportChart:
    """Draw MTF50 maps, tangential and sagittal, on one scale from 0 to `top` cycles/pixel."""
    points = tested.report.field
    guessed = [point.extrapolated for point in points]
    values = ([point.tangential for point in points], [point.sagittal for point in points])
    parts = _two_maps(tested, values, top, sensor, unit, guessed)
    name = {"c/px": "cycles/pixel", "lp/ph": "line pairs per picture height", "lp/mm": "line pairs per mm"}
    return _maps(tested, f"MTF50 in {name[unit]}", parts, any(guessed))


def error_chart(tested: Tested, sensor: SensorGeometry) -> ReportChart | None:
    """Draw the standard errors of both maps on one scale; None where they are not known."""
    spread = tested.spread
    if spread is None:
        return None
    top = max(0.01, *spread.tangential, *spread.sagittal)
    parts = _two_maps(tested, (spread.tangential, spread.sagittal), top, sensor, "c/px", None, worse=True)
    return _maps(tested, f"Standard error of MTF50, cycles/pixel, over {spread.drawn}", parts, guessed=False)


def _maps(tested: Tested, title: str, parts: list[Part], guessed: bool) -> ReportChart:
    report = tested.report
    high = _map_height(report.aspect)
    note = "? no photo shows this place: guessed" if guessed else ""
    parts = [Label(_GAP, 24, f"{title}{_at(tested)}"), *parts]
    parts.append(Label(WIDTH - _GAP, _TOP + high + 58, note, GREY, "end"))
    return ReportChart(title, WIDTH, round(_TOP + high + 70), tuple(parts))


def _map_height(aspect: float) -> float:
    return (WIDTH - 3 * _GAP) / 2 / aspect


def _two_maps(
    tested: Tested,
    values: tuple[Sequence[float], Sequence[float]],
    top: float,
    sensor: SensorGeometry,
    unit: Unit,
    guessed: Sequence[bool] | None,
    *,
    worse: bool = False,
) -> list[Part]:
    report = tested.report
    wide, high = (WIDTH - 3 * _GAP) / 2, _map_height(report.aspect)
    cell = (wide / report.cols, high / report.rows)
    factor = sensor.factor(unit) or 1.0
    parts: list[Part] = []
    for number, (name, own) in enumerate(zip(("tangential", "sagittal"), values, strict=True)):
        left = _GAP + number * (wide + _GAP)
        for i, value in enumerate(own):
            row, col = divmod(i, report.cols)
            x, y = left + col * cell[0], _TOP + row * cell[1]
            share = min(value / top, 1.0) if math.isfinite(value) else 0.0
            fill = colour(1.0 - share if worse else share)
            parts.append(Box(x, y, cell[0] - 0.5, cell[1] - 0.5, rgb(fill)))
            text = _figure(value * factor, factor, capped=not worse and value >= NYQUIST)
            text += "?" if guessed and guessed[i] else ""
            parts.append(Label(x + cell[0] / 2, y + cell[1] / 2 + 3, text, ink(fill), "middle", 8.5))
        parts.append(Label(left + wide / 2, _TOP + high + 16, name, GREY, "middle"))
    return parts + _scale(_TOP + high + 30, top, factor, worse=worse)


def _scale(y: float, top: float, factor: float, *, worse: bool) -> list[Part]:
    """A bar of the colours with the values at its ends and middle."""
    wide, steps = 200, 40
    parts: list[Part] = []
    for k in range(steps):
        share = (k + 0.5) / steps
        fill = rgb(colour(1.0 - share if worse else share))
        parts.append(Box(_GAP + k * wide / steps, y, wide / steps + 0.3, _SCALE_HIGH, fill))
    for share in (0.0, 0.5, 1.0):
        text = _figure(share * top * factor, factor)
        parts.append(Label(_GAP + share * wide, y + _SCALE_HIGH + 13, text, GREY, "middle", 10))
    return parts


def _figure(value: float, factor: float, *, capped: bool = False) -> str:
    if not math.isfinite(value):
        return "-"
    shown = NYQUIST * factor if capped else value
    text = f"{shown:.2f}".removeprefix("0") if factor == 1.0 else f"{shown:.0f}"
    return f">{text}" if capped else text


def curves_chart(tested: Tested) -> ReportChart:
    """Draw contrast over the radius: sagittal solid, tangential dashed, bands of one standard error."""
    report, axes = tested.report, _axes(1.0)
    parts: list[Part] = [Label(_LEFT, 24, f"Contrast over the picture{_at(tested)}")]
    parts += axes.grid(_RADII_TICKS, _RADII_TICKS, "r: 0 centre, 1 corner")
    bands: list[Part] = []
    lines: list[Part] = []
    for i, curve in enumerate(report.curves):
        own = COLOURS[i % len(COLOURS)]
        name = f"{curve.frequency:.3g} c/px" if curve.lp_mm is None else f"{curve.lp_mm:.3g} lp/mm"
        if tested.spread is not None and i < len(tested.spread.curves):
            over = tested.spread.curves[i]
            bands.append(axes.band(report.radii, curve.sagittal, over.sagittal, own))
            bands.append(axes.band(report.radii, curve.tangential, over.tangential, own))
        lines.append(axes.curve(report.radii, curve.sagittal, own))
        lines.append(axes.curve(report.radii, curve.tangential, own, dashed=True))
        lines += axes.key(2 * i, f"{name} S", own)
        lines += axes.key(2 * i + 1, f"{name} T", own, dashed=True)
    return ReportChart("Contrast over the picture", WIDTH, HEIGHT, (*parts, *_inside(axes, bands), *lines))


def colours_chart(test: LensTest, aperture: float | None) -> ReportChart:
    """Draw contrast of red, green and blue over the radius, mean of tangential and sagittal."""
    matching = [one for one in test.tested if one.report.settings.aperture == aperture]
    axes = _axes(1.0)
    second = min(1, len(matching[0].report.curves) - 1)
    curve = matching[0].report.curves[second]
    name = f"{curve.frequency:.3g} c/px" if curve.lp_mm is None else f"{curve.lp_mm:.3g} lp/mm"
    parts: list[Part] = [Label(_LEFT, 24, f"Contrast by colour at {name}{_at(matching[0])}")]
    parts += axes.grid(_RADII_TICKS, _RADII_TICKS, "r: 0 centre, 1 corner")
    for i, one in enumerate(matching):
        channel = one.report.settings.channel
        own = one.report.curves[second]
        mean = [(t + s) / 2.0 for t, s in zip(own.tangential, own.sagittal, strict=True)]
        parts.append(axes.curve(one.report.radii, mean, _INKS[channel]))
        parts += axes.key(i, _NAMES[channel], _INKS[channel])
    return ReportChart("Contrast by colour", WIDTH, HEIGHT, tuple(parts))


def field_chart(tested: Tested) -> ReportChart:
    """Draw how wide points are along the radius and around the centre, see `FieldShape`."""
    shape, radii = tested.report.shape, tested.report.radii
    top = 1.15 * max(*shape.along_u, *shape.along_v, _LEAST_WIDTH_PX)
    axes = _axes(top)
    parts: list[Part] = [Label(_LEFT, 24, f"Width of a point in pixels{_at(tested)}")]
    parts += axes.grid(_RADII_TICKS, _steps(top), "r: 0 centre, 1 corner")
    rows = (("along the radius", shape.along_u), ("around the centre", shape.along_v))
    for i, (name, values) in enumerate(rows):
        parts.append(axes.curve(radii, values, COLOURS[i]))
        parts += axes.key(i, name, COLOURS[i])
    parts += [
        Label(axes.right + 14, _TOP + 66, "apart: astigmatism", GREY, size=10),
        Label(axes.right + 14, _TOP + 82, "rising together: field", GREY, size=10),
        Label(axes.right + 14, _TOP + 95, "curvature, or blur that", GREY, size=10),
        Label(axes.right + 14, _TOP + 108, "grows with the field", GREY, size=10),
    ]
    return ReportChart("Astigmatism and field curvature", WIDTH, HEIGHT, tuple(parts))


def apertures_chart(test: LensTest, unit: Unit = "c/px") -> ReportChart | None:
    """Draw MTF50 of each zone by aperture; None with fewer than two."""
    apertures = [aperture for aperture in test.apertures if aperture is not None]
    if len(apertures) < 2:
        return None
    factor = test.sensor.factor(unit) or 1.0
    rows = [test.at(aperture).zones for aperture in apertures]
    values = [factor * min(row[zone], NYQUIST) for row in rows for zone in ZONES]
    top = 1.15 * max(values)
    axes = Axes(_LEFT, _TOP, WIDTH - _RIGHT, HEIGHT - _BOTTOM, (-0.3, len(rows) - 0.7), (0.0, top))
    parts: list[Part] = [Label(_LEFT, 24, f"MTF50 by aperture, {unit}")]
    parts += axes.grid([(i, f"f/{n:g}") for i, n in enumerate(apertures)], _steps(top), "aperture")
    for i, zone in enumerate(ZONES):
        own = [factor * min(row[zone], NYQUIST) for row in rows]
        parts.append(axes.curve(range(len(rows)), own, COLOURS[i]))
        parts += axes.key(i, ZONE_WORDS[zone], COLOURS[i])
    return ReportChart("MTF50 by aperture", WIDTH, HEIGHT, tuple(parts))


def centring_chart(tested: Tested) -> ReportChart:
    """Draw towards which side the lens is softer, with the circle of twice its error."""
    centring, aspect = tested.report.decentring, tested.report.aspect
    high = 260
    wide = high * aspect
    left, top = (WIDTH - wide) / 2, _TOP
    x, y = left + wide / 2, top + high / 2
    frame = ((left, top), (left + wide, top), (left + wide, top + high), (left, top + high), (left, top))
    parts: list[Part] = [Label(_GAP, 24, f"Centring{_at(tested)}"), Line(frame, GREY)]
    parts.append(Line(((x - 6, y), (x + 6, y)), GREY))
    parts.append(Line(((x, y - 6), (x, y + 6)), GREY))
    if centring.softer is not None:
        scale = high / 2 / 0.7  # sides that differ by a factor of two reach the edge
        end = (
            x + scale * centring.softer.amount * math.cos(centring.softer.direction),
            y - scale * centring.softer.amount * math.sin(centring.softer.direction),
        )
        end = (min(max(end[0], left), left + wide), min(max(end[1], top), top + high))
        radius = min(2.0 * centring.softer.error * scale, high / 2)
        around = [(end[0] + radius * math.cos(t), end[1] + radius * math.sin(t)) for t in _TURNS]
        circle = tuple(
            (min(max(across, left), left + wide), min(max(down, top), top + high)) for across, down in around
        )
        parts.append(Area(circle, COLOURS[0]))
        parts.append(Line(((x, y), end), COLOURS[1], 3.0))
        sides = 100.0 * math.expm1(centring.softer.amount)
        error = 100.0 * math.expm1(2.0 * centring.softer.error)
        text = f"opposite sides differ by {sides:.0f} %, give or take {error:.0f} % (two standard errors)"
        parts.append(Label(WIDTH / 2, top + high + 22, text, INK, "middle"))
    note = (
        "arrow: points to the softer side; circle: two standard errors around its tip; "
        "certain if the cross lies outside"
    )
    parts.append(Label(WIDTH / 2, top + high + 42, note, GREY, "middle", 10))
    return ReportChart("Centring", WIDTH, top + high + 56, tuple(parts))


def lateral_chart(test: LensTest) -> ReportChart | None:
    """Draw lateral colour over the radius; None where no photo showed it."""
    shift = test.lateral
    if shift is None:
        return None
    most = max(0.1, *(abs(value) for value in (*shift.red, *shift.blue)))
    reach = 1.2 * most
    axes = Axes(_LEFT, _TOP, WIDTH - _RIGHT, HEIGHT - _BOTTOM, (0.0, 1.0), (-reach, reach))
    ticks = [(k * most / 2.0, f"{k * most / 2.0:+.2f}") for k in range(-2, 3)]
    parts: list[Part] = [Label(_LEFT, 24, "Lateral colour: pixels outwards of green")]
    parts += axes.grid(_RADII_TICKS, ticks, "r: 0 centre, 1 corner")
    rows: tuple[tuple[Channel, tuple[float, ...]], ...] = (("r", shift.red), ("b", shift.blue))
    for i, (channel, values) in enumerate(rows):
        parts.append(axes.curve(shift.radii, values, _INKS[channel]))
        parts += axes.key(i, _NAMES[channel], _INKS[channel])
    return ReportChart("Lateral colour", WIDTH, HEIGHT, tuple(parts))


def charts_of(test: LensTest, aperture: float | None, unit: Unit = "c/px") -> list[ReportChart]:
    """All charts of one aperture, in the order of a report."""
    tested = test.at(aperture)
    charts = [
        map_chart(tested, test.sensor, unit),
        error_chart(tested, test.sensor),
        curves_chart(tested),
        colours_chart(test, tested.report.settings.aperture),
        field_chart(tested),
        centring_chart(tested),
    ]
    return [chart for chart in charts if chart is not None]


def _axes(top: float) -> Axes:
    return Axes(_LEFT, _TOP, WIDTH - _RIGHT, HEIGHT - _BOTTOM, (0.0, 1.0), (0.0, top))


def _inside(axes: Axes, bands: Sequence[Part]) -> list[Part]:
    """Bands that stay within the area of a chart."""
    return [
        Area(tuple((x, min(max(y, axes.top), axes.bottom)) for x, y in band.points), band.colour)
        for band in bands
        if isinstance(band, Area)
    ]


def _at(tested: Tested) -> str:
    aperture = tested.report.settings.aperture
    return "" if aperture is None else f", f/{aperture:g}"


def _steps(top: float) -> list[tuple[float, str]]:
    """Round ticks from 0 to `top`, four to nine of them."""
    power = 10.0 ** math.floor(math.log10(top))
    step = next(power * m for m in (1.0, 0.5, 0.2, 0.1) if top / (power * m) >= 4.0)
    return [(step * i, f"{step * i:.3g}") for i in range(int(top / step + 1e-9) + 1)]
