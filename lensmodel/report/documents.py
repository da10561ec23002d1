"""A lens test as one HTML file: text, tables and drawings, nothing loaded from elsewhere."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import Final

from lensmodel.core.types import ZONES
from lensmodel.report.charts import apertures_chart, charts_of, lateral_chart
from lensmodel.report.comparison import Comparison
from lensmodel.report.drawing import ReportChart
from lensmodel.report.lens_test import LensTest, Tested
from lensmodel.report.units import UNIT_NAMES

_STYLE: Final = """
:root { color-scheme: light dark; }
body { margin: 0 auto; max-width: 84rem; padding: 1.5rem; font: 16px/1.55 system-ui, sans-serif;
  background: light-dark(#fff, #131416); color: light-dark(#191a1c, #eeeeec); }
h1 { line-height: 1.2; margin: 0; } h2 { margin: 2.2rem 0 .6rem; }
.verdict { font-size: 1.25rem; max-width: 46rem; }
.facts, .note { color: light-dark(#55585d, #b1b4b9); max-width: 60rem; }
.charts { display: grid; gap: 1rem; grid-template-columns: repeat(auto-fill, minmax(min(100%, 34rem), 1fr));
  align-items: start; }
figure { margin: 0; border: 1px solid light-dark(#dcdcd8, #363a3f); border-radius: .5rem; overflow-x: auto; }
svg { display: block; width: 100%; min-width: 33rem; height: auto; }
table { border-collapse: collapse; } th, td { text-align: left; padding: .3rem 1.4rem .3rem 0;
  border-bottom: 1px solid light-dark(#dcdcd8, #363a3f); font-variant-numeric: tabular-nums; }
.scroll { overflow-x: auto; }
@media print { body { background: #fff; color: #000; } figure { break-inside: avoid; } }
"""


def facts(test: LensTest) -> str:
    """Say what a test rests on."""
    photos = "1 photo" if test.photos == 1 else f"{test.photos} photos"
    parts = [photos, f"{test.samples} blur samples"]
    if test.sensor.pixel_pitch_um is not None:
        pitch = test.sensor.pixel_pitch_um
        parts.append(f"pixels of {pitch:.2f} micrometres, Nyquist frequency {500.0 / pitch:.0f} lp/mm")
    if test.sensor.height_px is not None:
        parts.append(f"{test.sensor.height_px} pixels high")
    return ", ".join(parts)


def error_map_words(tested: Tested) -> str:
    """Say what the bands and error maps of a report are."""
    if tested.spread is None:
        return "Too little is known to estimate the error of these figures."
    again = f"{tested.spread.draws} random redraws of the {tested.spread.drawn}"
    words = (
        f"Bands and error maps: one standard error, from {again}. "
        "Errors that all photos share are not included."
    )
    if tested.spread.drawn == "patches":
        words += " With fewer than three photos this error is too small: patches of a photo share its focus."
    return words


def zone_table(test: LensTest) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of MTF50 by aperture and zone, in each unit that is known."""
    units = test.sensor.units
    head = ["Aperture", "Zone", *(f"MTF50, {UNIT_NAMES[unit]}" for unit in units)]
    rows = []
    for aperture in test.apertures:
        tested = test.at(aperture)
        name = "unknown" if aperture is None else f"f/{aperture:g}"
        for zone in ZONES:
            value = tested.zones[zone]
            rows.append([name, zone, *(test.sensor.words(value, unit) for unit in units)])
    return head, rows


def to_html(test: LensTest) -> str:
    """Write a lens test as a page."""
    parts = [
        f"<h1>{escape(test.name)}</h1>",
        f'<p class="verdict">{escape(test.verdict)}</p>',
        f'<p class="facts">{escape(facts(test))}.</p>',
        _table(*zone_table(test)),
    ]
    whole = [chart for chart in (apertures_chart(test), lateral_chart(test)) if chart is not None]
    if whole:
        parts += ["<h2>Over apertures and colours</h2>", _figures(whole)]
    for aperture in test.apertures:
        tested = test.at(aperture)
        parts.append(f"<h2>{'At ' + f'f/{aperture:g}' if aperture is not None else 'Aperture unknown'}</h2>")
        parts.append(_list(tested.report.summary))
        parts.append(_figures(charts_of(test, aperture)))
        parts.append(f'<p class="note">{escape(error_map_words(tested))}</p>')
    parts += ["<h2>What would help most</h2>", f"<p>{escape(test.advice.text)}</p>"]
    return _page(test.name, parts)


def comparison_html(comparison: Comparison) -> str:
    """Write a comparison as a page."""
    first, second = comparison.first, comparison.second
    title = f"{first.name} and {second.name}"
    rows = [
        [
            change.zone,
            f"{change.first:.3f}",
            f"{change.second:.3f}",
            f"{change.share:+.0%}",
            "unknown" if change.error is None else f"{change.error / change.first:.0%}",
        ]
        for change in comparison.zones
    ]
    head = ["Zone", f"MTF50 of {first.name}, c/px", f"of {second.name}", "Difference", "Its standard error"]
    parts = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="verdict">{escape(comparison.verdict)}</p>',
        *(f'<p class="facts">{escape(side.facts)}.</p>' for side in (first, second)),
        _table(head, rows),
        _figures(comparison.charts),
        f'<p class="note">{escape(error_map_words(first.tested))}</p>',
    ]
    return _page(title, parts)


def _page(title: str, parts: Iterable[str]) -> str:
    return "\n".join(
        [
            '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n<main>",
            *parts,
            "</main>\n</body>\n</html>\n",
        ]
    )


def _figures(charts: Sequence[ReportChart]) -> str:
    # lettering of a chart stays large enough to read; on a narrow screen the chart scrolls, by keys as well
    figures = "".join(f'<figure tabindex="0">{chart.svg()}</figure>' for chart in charts)
    return f'<div class="charts">{figures}</div>'


def _list(lines: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(line[:1].upper() + line[1:])}.</li>' for line in lines)}</ul>"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    names = "".join(f'<th scope="col">{escape(name)}</th>' for name in head)
    lines = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return (
        '<div class="scroll" tabindex="0" role="region" aria-label="Figures">'
        f"<table><thead><tr>{names}</tr></thead><tbody>{lines}</tbody></table></div>"
    )
