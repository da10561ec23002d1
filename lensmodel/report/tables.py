"""A report as tables: figures by aperture and place, and one line for each figure as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from typing import Final

from lensmodel.core.types import FieldPosition
from lensmodel.report.lens_report import UNIT_NAMES, ApertureReport, LensReport, Range

_HEAD: Final = (
    *("quantity", "aperture", "channel", "r", "phi", "row", "col", "frequency_c_px", "frequency_lp_mm"),
    *("direction", "value", "low", "high", "unit", "predicted_error", "extrapolated"),
)


def place_table(report: LensReport) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of tangential and sagittal MTF50 by aperture and place, in each known unit."""
    units = report.sensor.units
    head = ["Aperture", "Place", *(f"{side}, {UNIT_NAMES[unit]}" for unit in units for side in "TS")]
    rows = []
    for aperture in report.apertures:
        found = report.at(aperture)
        for spot in (found.spots[0], *found.sides, *found.spots[1:]):
            figures = [
                report.sensor.words(value, unit, between)
                for unit in units
                for value, between in (
                    (spot.tangential, spot.tangential_range),
                    (spot.sagittal, spot.sagittal_range),
                )
            ]
            rows.append([found.at or "unknown", spot.place.removeprefix("the "), *figures])
    return head, rows


def to_csv(report: LensReport) -> str:
    """Write a report as CSV: MTF50 over the picture, contrast by radius, widths, lateral colour."""
    out = io.StringIO()
    writer = csv.DictWriter(out, _HEAD, restval="", lineterminator="\n")
    writer.writeheader()
    for found in report.tested:
        known = {"aperture": _number(found.settings.aperture), "channel": found.settings.channel}
        writer.writerows(known | row for row in _rows(found))
    if report.lateral is not None:
        for channel, values in (("r", report.lateral.red), ("b", report.lateral.blue)):
            for r, value in zip(report.lateral.radii, values, strict=True):
                known = {"quantity": "lateral colour", "channel": channel, "unit": "px"}
                writer.writerow(known | {"r": _number(r), "value": _number(value)})
    return out.getvalue()


def _rows(found: ApertureReport) -> Iterator[dict[str, str]]:
    for zone, value in found.zones.items():
        yield {"quantity": f"MTF50, mean of {zone}", "value": _number(value), "unit": "c/px"}
    for spot in (*found.spots, *found.sides):
        own = {"quantity": f"MTF50 at {spot.place}"} | _at(spot.position)
        own |= {"predicted_error": _number(spot.predicted_error)}
        yield own | {"direction": "tangential"} | _figure(spot.tangential, spot.tangential_range)
        yield own | {"direction": "sagittal"} | _figure(spot.sagittal, spot.sagittal_range)
    for direction, values, ranges in (
        ("tangential", found.tangential, found.tangential_range),
        ("sagittal", found.sagittal, found.sagittal_range),
    ):
        for i, (place, value, between) in enumerate(zip(found.positions, values, ranges, strict=True)):
            row, col = divmod(i, found.cols)
            yield (
                _at(place)
                | _figure(value, between)
                | {
                    "quantity": "MTF50",
                    "direction": direction,
                    "row": str(row),
                    "col": str(col),
                    "predicted_error": _number(found.predicted_error[i]),
                    "extrapolated": str(int(found.extrapolated[i])),
                }
            )
    for curve in found.curves:
        known = {
            "quantity": "MTF",
            "frequency_c_px": _number(curve.frequency),
            "frequency_lp_mm": _number(curve.lp_mm),
        }
        for direction, values in (("tangential", curve.tangential), ("sagittal", curve.sagittal)):
            for r, value in zip(found.radii, values, strict=True):
                yield known | {"r": _number(r), "direction": direction, "value": _number(value)}


def _at(place: FieldPosition) -> dict[str, str]:
    return {"r": _number(place.r), "phi": _number(place.phi)}


def _figure(value: float, between: Range) -> dict[str, str]:
    return {"value": _number(value), "low": _number(between[0]), "high": _number(between[1]), "unit": "c/px"}


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"
