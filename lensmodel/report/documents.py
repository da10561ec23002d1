"""A report as files: one HTML page that loads nothing from elsewhere, and one line for each figure as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from typing import Any, Final

from lensmodel.core.types import FieldPosition
from lensmodel.report.lens_report import UNIT_NAMES, ApertureReport, Comparison, LensReport

_HEAD: Final = (
    *("quantity", "aperture", "channel", "r", "phi", "row", "col", "frequency_c_px", "frequency_lp_mm"),
    *("direction", "value", "unit", "predicted_error", "extrapolated"),
)
_STYLE: Final = """
:root { color-scheme: light; }
body { margin: 0 auto; max-width: 84rem; padding: 1.5rem; font: 16px/1.55 system-ui, sans-serif; color:
#191a1c;
  background: #fff; }
h1 { line-height: 1.2; margin: 0; } h2 { margin: 2.2rem 0 .6rem; }
.verdict { font-size: 1.25rem; max-width: 46rem; } .facts, .note { color: #55585d; max-width: 60rem; }
.charts { display: grid; gap: 1rem; grid-template-columns: repeat(auto-fill, minmax(min(100%, 34rem), 1fr)); }
figure { margin: 0; overflow-x: auto; } img { display: block; width: 100%; min-width: 33rem; height: auto; }
img.page { max-width: 56rem; }
table { border-collapse: collapse; } th, td { text-align: left; padding: .3rem 1.4rem .3rem 0;
  border-bottom: 1px solid #dcdcd8; font-variant-numeric: tabular-nums; }
.scroll { overflow-x: auto; } @media print { figure { break-inside: avoid; } }
"""


def place_table(report: LensReport) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of tangential and sagittal MTF50 by aperture and place, in each known unit."""
    units = report.sensor.units
    head = ["Aperture", "Place", *(f"{side}, {UNIT_NAMES[unit]}" for unit in units for side in "TS")]
    rows = []
    for aperture in report.apertures:
        found = report.at(aperture)
        for spot in (found.spots[0], *found.sides, *found.spots[1:]):
            figures = [
                report.sensor.words(value, unit)
                for unit in units
                for value in (spot.tangential, spot.sagittal)
            ]
            rows.append([found.at or "unknown", spot.place.removeprefix("the "), *figures])
    return head, rows


def to_html(report: LensReport) -> str:
    """Write a report as a page."""
    from lensmodel.report.plots import charts  # noqa: PLC0415 - matplotlib, an extra, takes a second to import

    parts = [
        f"<h1>{escape(report.name)}</h1>",
        f'<p class="verdict">{escape(report.verdict)}</p>',
        f'<p class="facts">{escape(report.facts)}.</p>',
        *(f'<p class="facts">{escape(name)}: {escape(words)}</p>' for name, words in report.details.items()),
        _table(*place_table(report)),
    ]
    for aperture in report.apertures:
        found = report.at(aperture)
        parts.append(f"<h2>{'At ' + found.at if found.at else 'Aperture unknown'}</h2>")
        parts.append(f"<p>{escape(found.centring.text[:1].upper() + found.centring.text[1:])}.</p>")
        parts.append(_figures(charts(report, aperture)))
    parts += ["<h2>What would help most</h2>", f"<p>{escape(report.advice)}</p>"]
    return _page(report.name, parts)


def comparison_html(comparison: Comparison) -> str:
    """Write a comparison as a page."""
    from lensmodel.report.plots import comparison_charts  # noqa: PLC0415 - as above

    first, second = comparison.first, comparison.second
    title = f"{first.name} and {second.name}"
    rows = [[c.zone, f"{c.first:.3f}", f"{c.second:.3f}", f"{c.share:+.0%}"] for c in comparison.zones]
    head = ["Zone", f"MTF50 of {first.name}, c/px", f"of {second.name}", "Difference"]
    parts = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="verdict">{escape(comparison.verdict)}</p>',
        *(f'<p class="facts">{escape(s.name)}: {escape(s.facts)}.</p>' for s in (first, second) if s.facts),
        _table(head, rows),
        _figures(comparison_charts(comparison)),
    ]
    return _page(title, parts)


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
                row = {
                    "quantity": "lateral colour",
                    "channel": channel,
                    "r": _number(r),
                    "value": _number(value),
                }
                writer.writerow(row | {"unit": "px"})
    return out.getvalue()


def _rows(found: ApertureReport) -> Iterator[dict[str, str]]:
    for zone, value in found.zones.items():
        yield {"quantity": f"MTF50, mean of {zone}", "value": _number(value), "unit": "c/px"}
    for spot in (*found.spots, *found.sides):
        own = {"quantity": f"MTF50 at {spot.place}", "unit": "c/px"} | _at(spot.position)
        own |= {"predicted_error": _number(spot.predicted_error)}
        yield own | {"direction": "tangential", "value": _number(spot.tangential)}
        yield own | {"direction": "sagittal", "value": _number(spot.sagittal)}
    for direction, values in (("tangential", found.tangential), ("sagittal", found.sagittal)):
        for i, (place, value) in enumerate(zip(found.positions, values, strict=True)):
            row, col = divmod(i, found.cols)
            yield _at(place) | {
                "quantity": "MTF50",
                "direction": direction,
                "row": str(row),
                "col": str(col),
                "value": _number(value),
                "unit": "c/px",
                "predicted_error": _number(found.predicted_error[i]),
                "extrapolated": str(int(found.extrapolated[i])),
            }
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


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def _page(title: str, parts: Iterable[str]) -> str:
    head = [
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n<main>",
    ]
    return "\n".join([*head, *parts, "</main>\n</body>\n</html>\n"])


def _figures(drawn: Sequence[Any]) -> str:
    # lettering of a chart stays large enough to read; on a narrow screen the chart scrolls, by keys as well
    images = (f'<img src="{chart.source}" alt="{escape(chart.title)}">' for chart in drawn)
    return f'<div class="charts">{"".join(f"<figure tabindex=0>{image}</figure>" for image in images)}</div>'


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    names = "".join(f'<th scope="col">{escape(name)}</th>' for name in head)
    lines = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return (
        '<div class="scroll" tabindex="0" role="region" aria-label="Figures">'
        f"<table><thead><tr>{names}</tr></thead><tbody>{lines}</tbody></table></div>"
    )
