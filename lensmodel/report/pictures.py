"""The lens report in pictures: map of sharpness, contrast over the radius, sharpness by aperture."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Final

from lensmodel.core.types import ZONE_WORDS, ZONES
from lensmodel.report.drawing import COLOURS, GREY, Axes, Box, Label, Part, svg
from lensmodel.report.lens_report import LensReport, answerers
from lensmodel.report.palette import colour, ink, rgb

# Layout in points of the picture (chosen: keys and numbers beside the axes are not cut off); axes have five
# steps.
WIDTH: Final = 640
HEIGHT: Final = 400
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 170, 40, 52
_MARGIN: Final = 20
_LINE: Final = 18  # from one line of notes to the next
_LINE_CHARACTERS: Final = 100  # so many fit into the width at the size of the font (chosen)
_TICKS: Final = tuple((i / 5, f"{i / 5:.1f}") for i in range(6))


def mtf_map_svg(report: LensReport) -> str:
    """Draw the mean MTF50 of each cell of the picture, upright, as SVG; a question mark is a guess.

    Returns
    -------
    str
        The text of an SVG file.
    """
    title = f"MTF50 in cycles/pixel{_at(report)}"
    across = WIDTH - 2 * _MARGIN
    high = across / report.aspect
    cell = (across / report.cols, high / report.rows)
    values = [point.mean for point in report.field]
    low, top = min(values), max(values)
    parts: list[Part] = [Label(_MARGIN, 24, title)]
    for i, point in enumerate(report.field):
        row, col = divmod(i, report.cols)
        x, y = _MARGIN + col * cell[0], _TOP + row * cell[1]
        share = 0.5 if top <= low else (point.mean - low) / (top - low)
        fill = colour(share)
        parts.append(Box(x, y, cell[0] - 1, cell[1] - 1, rgb(fill)))
        mark = "?" if point.extrapolated else ""
        middle = x + cell[0] / 2
        text = f"{point.mean:.3f}".removeprefix("0") + mark
        parts.append(Label(middle, y + cell[1] / 2 + 4, text, ink(fill), "middle"))
    notes = [f"from {low:.3f} (red) to {top:.3f} (blue)"]
    if any(point.extrapolated for point in report.field):
        notes[0] += "; ? no photo shows this place, guessed"
    notes += [report.decentring.text, answerers(report.field)]
    return _noted(title, _TOP + high, parts, notes)


def curves_svg(report: LensReport) -> str:
    """Draw contrast over the radius, sagittal solid and tangential dashed, as SVG.

    Returns
    -------
    str
        The text of an SVG file.
    """
    title = f"Contrast over the picture{_at(report)}"
    axes = Axes(_LEFT, _TOP, WIDTH - _RIGHT, HEIGHT - _BOTTOM, (0.0, 1.0), (0.0, 1.0))
    parts: list[Part] = [Label(_LEFT, 24, title)]
    parts += axes.grid(_TICKS, _TICKS, "r: 0 centre, 1 corner")
    for i, curve in enumerate(report.curves):
        own = COLOURS[i % len(COLOURS)]
        name = f"{curve.frequency:.3g} c/px" if curve.lp_mm is None else f"{curve.lp_mm:.3g} lp/mm"
        parts.append(axes.curve(report.radii, curve.sagittal, own))
        parts.append(axes.curve(report.radii, curve.tangential, own, dashed=True))
        parts += axes.key(2 * i, f"{name} sagittal", own)
        parts += axes.key(2 * i + 1, f"{name} tangential", own, dashed=True)
    return _noted(title, HEIGHT, parts, [report.curves_answered_by])


def apertures_svg(report: LensReport) -> str:
    """Draw MTF50 of centre, mid and corner over the apertures that photos had, as SVG.

    Returns
    -------
    str
        The text of an SVG file.
    """
    title = "MTF50 in cycles/pixel by aperture"
    rows = report.apertures
    values = [getattr(row, zone) for row in rows for zone in ZONES]
    top = max(0.1, *values) * 1.1 if values else 0.5
    axes = Axes(
        _LEFT, _TOP, WIDTH - _RIGHT, HEIGHT - _BOTTOM, (-0.3, max(len(rows) - 1, 1) + 0.3), (0.0, top)
    )
    parts: list[Part] = [Label(_LEFT, 24, title)]
    parts += axes.grid([(i, f"f/{row.aperture:g}") for i, row in enumerate(rows)], _steps(top), "aperture")
    for number, zone in enumerate(ZONES):
        parts.append(axes.curve(range(len(rows)), [getattr(row, zone) for row in rows], COLOURS[number]))
        parts += axes.key(number, ZONE_WORDS[zone], COLOURS[number])
    return _noted(title, HEIGHT, parts, [f"f/{row.aperture:g} {row.answered_by}" for row in rows])


def _noted(title: str, bottom: float, parts: Sequence[Part], notes: Sequence[str]) -> str:
    """Write a picture with notes below its drawing, each of as many lines as it needs."""
    lines = [line for note in notes for line in textwrap.wrap(note, _LINE_CHARACTERS)]
    labels = [Label(_MARGIN, bottom + 20 + _LINE * k, line, GREY) for k, line in enumerate(lines)]
    return svg(title, WIDTH, round(bottom + 32 + _LINE * len(lines)), [*parts, *labels])


def _at(report: LensReport) -> str:
    aperture = report.settings.aperture
    return "" if aperture is None else f" at f/{aperture:g}"


def _steps(top: float) -> list[tuple[float, str]]:
    """Round ticks from 0 to `top`, four to nine of them."""
    power = 10.0 ** math.floor(math.log10(top))
    step = next(power * m for m in (1.0, 0.5, 0.2, 0.1) if top / (power * m) >= 4.0)
    return [(step * i, f"{step * i:.2f}") for i in range(int(top / step + 1e-9) + 1)]
