"""A lens test as a table: one line for each figure, for spreadsheets and scripts."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from typing import Final

from lensmodel.report.lens_test import LensTest, Tested
from lensmodel.report.units import UNIT_NAMES

_HEAD: Final = (
    *("quantity", "aperture", "channel", "r", "phi", "row", "col", "frequency_c_px", "frequency_lp_mm"),
    *("direction", "value", "unit", "standard_error", "extrapolated", "answered_by", "reason"),
)


def to_csv(test: LensTest) -> str:
    """Write a lens test as CSV: MTF50 over the picture, contrast by radius, widths, lateral colour."""
    out = io.StringIO()
    writer = csv.DictWriter(out, _HEAD, restval="", lineterminator="\n")
    writer.writeheader()
    for tested in test.tested:
        settings = tested.report.settings
        known = {"aperture": _number(settings.aperture), "channel": settings.channel}
        for row in _rows(tested):
            writer.writerow(known | row)
    if test.lateral is not None:
        for channel, values in (("r", test.lateral.red), ("b", test.lateral.blue)):
            for r, value in zip(test.lateral.radii, values, strict=True):
                writer.writerow(
                    {
                        "quantity": "lateral colour",
                        "channel": channel,
                        "r": _number(r),
                        "value": _number(value),
                        "unit": "px",
                    }
                )
    return out.getvalue()


def _rows(tested: Tested) -> Iterator[dict[str, str]]:
    report, spread = tested.report, tested.spread
    for zone, value in tested.zones.items():
        yield {"quantity": f"MTF50, mean of {zone}", "value": _number(value), "unit": UNIT_NAMES["c/px"]}
    for i, point in enumerate(report.field):
        row, col = divmod(i, report.cols)
        place = {
            "r": _number(point.position.r),
            "phi": _number(point.position.phi),
            "row": str(row),
            "col": str(col),
            "extrapolated": str(int(point.extrapolated)),
            "answered_by": point.answered_by,
            "reason": point.reason,
            "unit": UNIT_NAMES["c/px"],
        }
        for name, value, errors in (
            ("tangential", point.tangential, spread and spread.tangential),
            ("sagittal", point.sagittal, spread and spread.sagittal),
        ):
            error = "" if not errors else _number(errors[i])
            yield place | {
                "quantity": "MTF50",
                "direction": name,
                "value": _number(value),
                "standard_error": error,
            }
    for number, curve in enumerate(report.curves):
        over = None if spread is None else spread.curves[number]
        for name, values, known in (
            ("tangential", curve.tangential, over and over.tangential),
            ("sagittal", curve.sagittal, over and over.sagittal),
        ):
            for k, r in enumerate(report.radii):
                yield {
                    "quantity": "MTF",
                    "r": _number(r),
                    "frequency_c_px": _number(curve.frequency),
                    "frequency_lp_mm": _number(curve.lp_mm),
                    "direction": name,
                    "value": _number(values[k]),
                    "standard_error": "" if not known else _number(known[k]),
                }
    for name, widths in (("radial", report.shape.along_u), ("around", report.shape.along_v)):
        for r, width in zip(report.radii, widths, strict=True):
            yield {
                "quantity": "width of a point",
                "r": _number(r),
                "direction": name,
                "value": _number(width),
                "unit": "px",
            }


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"
