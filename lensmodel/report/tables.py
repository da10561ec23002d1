"""A report as tables: figures by aperture and place, and one line for each figure as CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator
from typing import Final, TypeAlias

from lensmodel.report.centring import EDGE_R, Centring
from lensmodel.report.lens_report import UNIT_NAMES, ApertureReport, LensReport

_HEAD: Final = (
    *("quantity", "aperture", "channel", "r", "phi", "row", "col", "frequency_c_px", "frequency_lp_mm"),
    *("direction", "value", "low", "high", "unit", "predicted_error", "unknown"),
)
_Row: TypeAlias = dict[str, str | float | None]


def place_table(report: LensReport) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of tangential and sagittal MTF50 by aperture and place, in each known unit."""
    words, units = report.sensor.words, report.sensor.units
    head = ["Aperture", "Place", *(f"{side}, {UNIT_NAMES[unit]}" for unit in units for side in "TS")]
    rows = []
    for aperture in report.apertures:
        found = report.at(aperture)
        for spot in (found.spots[0], *found.sides, *found.spots[1:]):
            place = spot.place.removeprefix("the ") + (" (not known)" if spot.unknown else "")
            figures = [words(value, unit, between) for unit in units for _, value, between in spot.directions]
            rows.append([found.at or "unknown", place, *figures])
    return head, rows


def to_csv(report: LensReport) -> str:
    """Write a report as CSV: MTF50 over the picture, contrast by radius, centring, lateral colour."""
    out = io.StringIO()
    writer = csv.DictWriter(out, _HEAD, restval="", lineterminator="\n")
    writer.writeheader()
    rows = [row for found in report.tested for row in _rows(found)]
    if report.lateral is not None:
        for channel, values in (("r", report.lateral.red), ("b", report.lateral.blue)):
            rows += [
                {"quantity": "lateral colour", "channel": channel, "unit": "px", "r": r, "value": value}
                for r, value in zip(report.lateral.radii, values, strict=True)
            ]
    for row in rows:
        writer.writerow(
            {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items() if v is not None}
        )
    return out.getvalue()


def _rows(found: ApertureReport) -> Iterator[_Row]:
    """What was found at one aperture in one colour, as figures with what is known of each."""
    known: _Row = {"aperture": found.settings.aperture, "channel": found.settings.channel}
    for zone, value in found.zones.items():
        yield known | {"quantity": f"MTF50, mean of {zone}", "value": value, "unit": "c/px"}
    cells = [(divmod(i, found.cols), spot) for i, spot in enumerate(found.map)]
    spots = [(known | {"quantity": f"MTF50 at {s.place}"}, s) for s in (*found.spots, *found.sides)]
    spots += [(known | {"quantity": "MTF50", "row": row, "col": col}, s) for (row, col), s in cells]
    for own, spot in spots:
        own |= {"r": spot.position.r, "phi": spot.position.phi, "unit": "c/px", "unknown": int(spot.unknown)}
        own |= {"predicted_error": spot.predicted_error}
        for direction, value, (low, high) in spot.directions:
            yield own | {"direction": direction, "value": value, "low": low, "high": high}
    for curve in found.curves:
        own = known | {"quantity": "MTF", "frequency_c_px": curve.frequency, "frequency_lp_mm": curve.lp_mm}
        for direction, values in (("tangential", curve.tangential), ("sagittal", curve.sagittal)):
            for r, value in zip(found.radii, values, strict=True):
                yield own | {"direction": direction, "r": r, "value": value}
    yield from _centring_rows(found.centring, known)


def _centring_rows(found: Centring, known: _Row) -> Iterator[_Row]:
    """The verdict as 0 or 1, and both signs of a fault with two standard errors; `phi` is their direction."""
    decentred = int(found.verdict == "decentred")
    yield known | {"quantity": "decentred", "value": decentred, "unknown": int(found.verdict == "unknown")}
    if (softer := found.softer) is not None:
        value, low, high = (math.exp(softer.amount + k * softer.error) for k in (0.0, -2.0, 2.0))
        yield known | {"quantity": "width of blur, softer side over opposite side", "unit": "ratio"} | {
            "r": EDGE_R, "phi": softer.direction, "value": value, "low": low, "high": high
        }  # fmt: skip
    if (coma := found.coma) is not None:
        value, low, high = (max(coma.amount + k * coma.error, 0.0) for k in (0.0, -2.0, 2.0))
        yield known | {"quantity": "coma in the middle of the picture", "unit": "cubed widths of blur"} | {
            "r": 0.0, "phi": coma.direction, "value": value, "low": low, "high": high
        }  # fmt: skip
