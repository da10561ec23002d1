"""Two copies of a lens, or two apertures of one, in one chart."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from lensmodel.core.geometry import zone_of
from lensmodel.core.types import ZONES, Zone
from lensmodel.report.charts import HEIGHT, WIDTH
from lensmodel.report.drawing import COLOURS, GREY, Area, Axes, Box, Label, Part, ReportChart
from lensmodel.report.lens_report import Curve
from lensmodel.report.lens_test import Tested, zone_means
from lensmodel.report.palette import colour, ink, rgb
from lensmodel.report.units import NYQUIST

_SURE: Final = 2.0
"""Standard errors by which two places must differ to be called different (chosen: chance
does it in one of twenty)."""

_ALIKE: Final = 0.05
"""Share by which zones may differ and still be called alike: less is not seen (chosen)."""

_LETTERS: Final = 18
"""Of a name in the key of a chart (chosen: they fit beside it)."""

_TICKS: Final = tuple((k / 5, f"{k / 5:.1f}") for k in range(6))
_NAMES: Final[dict[Zone, str]] = {"center": "in the centre", "mid": "halfway out", "corner": "in the corners"}


@dataclass(frozen=True, slots=True)
class Side:
    """One of two that are compared: what to call it, and what was found of it."""

    name: str
    tested: Tested

    @property
    def facts(self) -> str:
        """What its figures rest on."""
        report = self.tested.report
        stop = report.settings.aperture
        at = "an unknown aperture" if stop is None else f"f/{stop:g}"
        photos = "1 photo" if report.photos == 1 else f"{report.photos} photos"
        return f"{self.name}: {at}, {photos}, {report.samples} blur samples"


@dataclass(frozen=True, slots=True)
class ZoneChange:
    """How the second differs from the first in one zone: MTF50 in cycles/pixel.

    Parameters
    ----------
    zone : {"center", "mid", "corner"}
    first, second : float
    error : float or None
        Standard error of their difference; None where one of them has none.
    """

    zone: Zone
    first: float
    second: float
    error: float | None

    @property
    def sure(self) -> bool:
        """Whether they differ by more than chance makes."""
        return self.error is not None and abs(self.second - self.first) > _SURE * self.error

    @property
    def share(self) -> float:
        """Difference over the first."""
        return (self.second - self.first) / self.first


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two lens tests beside each other.

    Parameters
    ----------
    first, second : Side
    verdict : str
        One sentence.
    zones : tuple of ZoneChange
    charts : tuple of ReportChart
    """

    first: Side
    second: Side
    verdict: str
    zones: tuple[ZoneChange, ...]
    charts: tuple[ReportChart, ...]


def compare(first: Side, second: Side) -> Comparison:
    """Compare two copies at one aperture, or two apertures of one copy; those of one name are numbered."""
    if first.name == second.name:
        first, second = (
            replace(side, name=f"{side.name} ({k})") for k, side in enumerate((first, second), 1)
        )
    zones = tuple(_zone(first.tested, second.tested, zone) for zone in ZONES)
    charts = [_curves(first, second, low) for low in (True, False)]
    difference = _difference(first, second)
    if difference is not None:
        charts.append(difference)
    return Comparison(first, second, _verdict(first, second, zones), zones, tuple(charts))


def _zone(first: Tested, second: Tested, zone: Zone) -> ZoneChange:
    one, two = zone_means(first.report)[zone], zone_means(second.report)[zone]
    errors = [_zone_error(tested, zone) for tested in (first, second)]
    known = [error for error in errors if error is not None]
    return ZoneChange(zone, one, two, math.hypot(*known) if len(known) == len(errors) else None)


def _zone_error(tested: Tested, zone: Zone) -> float | None:
    """Standard error of a zone's mean, its places taken to err together: they share their photos."""
    if tested.spread is None:
        return None
    errors = [
        (t + s) / 2.0
        for point, t, s in zip(
            tested.report.field, tested.spread.tangential, tested.spread.sagittal, strict=True
        )
        if zone_of(point.position.r) == zone
    ]
    return float(np.mean(errors)) if errors else None


def _verdict(first: Side, second: Side, zones: tuple[ZoneChange, ...]) -> str:
    words = []
    for change in zones:
        place = _NAMES[change.zone]
        if abs(change.share) < _ALIKE:
            words.append(f"about the same {place}")
        elif change.error is not None and not change.sure:
            words.append(f"not to be told apart {place}")
        else:
            words.append(f"{abs(change.share):.0%} {'sharper' if change.share > 0 else 'softer'} {place}")
    return f"Compared with {first.name}, {second.name} is {', '.join(words[:-1])} and {words[-1]}."


def _curves(first: Side, second: Side, low: bool) -> ReportChart:
    """Draw contrast of both over the radius, at a low or a high frequency that both have."""
    pairs = [
        (a, b) for a in first.tested.report.curves for b in second.tested.report.curves if _same(a, b)
    ] or [(first.tested.report.curves[0], second.tested.report.curves[0])]
    a, b = pairs[0 if low else -1]
    axes = Axes(56, 40, WIDTH - 190, HEIGHT - 52, (0.0, 1.0), (0.0, 1.0))
    title = f"Contrast at {_frequency(a)}"
    if not _same(a, b):
        title += f", of {second.name} at {_frequency(b)}"
    parts: list[Part] = [Label(56, 24, title), *axes.grid(_TICKS, _TICKS, "r: 0 centre, 1 corner")]
    lines: list[Part] = []
    for i, (side, curve) in enumerate(((first, a), (second, b))):
        radii, ink_ = side.tested.report.radii, COLOURS[i]
        if side.tested.spread is not None:
            over = side.tested.spread.curves[side.tested.report.curves.index(curve)]
            for values, errors in ((curve.sagittal, over.sagittal), (curve.tangential, over.tangential)):
                band = axes.band(radii, values, errors, ink_)
                held = tuple((x, min(max(y, axes.top), axes.bottom)) for x, y in band.points)
                parts.append(Area(held, ink_, 0.12))
        lines.append(axes.curve(radii, curve.sagittal, ink_))
        lines.append(axes.curve(radii, curve.tangential, ink_, dashed=True))
        lines += axes.key(2 * i, f"{_short(side.name)} S", ink_)
        lines += axes.key(2 * i + 1, f"{_short(side.name)} T", ink_, dashed=True)
    return ReportChart(title, WIDTH, HEIGHT, (*parts, *lines))


def _frequency(curve: Curve) -> str:
    return f"{curve.frequency:.3g} c/px" if curve.lp_mm is None else f"{curve.lp_mm:.3g} lp/mm"


def _short(name: str) -> str:
    """Shorten a name for a key; two of one maker differ at the end."""
    return name if len(name) <= _LETTERS else f"{name[: _LETTERS // 2 - 1]}...{name[-_LETTERS // 2 + 2 :]}"


def _same(a: Curve, b: Curve) -> bool:
    if a.lp_mm is not None and b.lp_mm is not None:
        return abs(a.lp_mm - b.lp_mm) < 0.5
    return abs(a.frequency - b.frequency) < 0.01


def _difference(first: Side, second: Side) -> ReportChart | None:
    """Draw MTF50 of the second less that of the first; places within two standard errors are pale."""
    one, two = first.tested.report, second.tested.report
    if (one.rows, one.cols) != (two.rows, two.cols):
        return None
    values = [min(b.mean, NYQUIST) - min(a.mean, NYQUIST) for a, b in zip(one.field, two.field, strict=True)]
    errors = [_place_error(first.tested, i, second.tested) for i in range(len(values))]
    top = max(0.02, *(abs(value) for value in values))
    wide = WIDTH - 40.0
    high = wide / one.aspect
    title = f"MTF50 of {second.name} less that of {first.name}, cycles/pixel"
    parts: list[Part] = [Label(20, 24, title)]
    for i, (value, error) in enumerate(zip(values, errors, strict=True)):
        row, col = divmod(i, one.cols)
        x, y = 20 + col * wide / one.cols, 40 + row * high / one.rows
        sure = error is None or abs(value) > _SURE * error
        fill = colour(0.5 + 0.5 * value / top if sure else 0.5)
        parts.append(Box(x, y, wide / one.cols - 1, high / one.rows - 1, rgb(fill)))
        text = f"{value:+.2f}" + ("" if sure else " ?")
        parts.append(
            Label(x + wide / one.cols / 2, y + high / one.rows / 2 + 4, text, ink(fill), "middle", 11)
        )
    note = f"blue: {second.name} is sharper; ? within the error"
    parts.append(Label(20, 40 + high + 20, note, GREY))
    return ReportChart(title, WIDTH, round(high + 72), tuple(parts))


def _place_error(first: Tested, place: int, second: Tested) -> float | None:
    errors = []
    for tested in (first, second):
        if tested.spread is None:
            return None
        errors.append((tested.spread.tangential[place] + tested.spread.sagittal[place]) / 2.0)
    return math.hypot(*errors)
