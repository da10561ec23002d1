"""The report as one HTML file: its words, its charts as SVG and its table; nothing else is loaded."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from string import Template
from typing import Final

from lensmodel.report.lens_report import LensReport
from lensmodel.report.plots import EXPLAINED, Chart, charts, overview
from lensmodel.report.tables import place_table

_PAGE: Final = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$name: lens report</title>
<style>
:root { color-scheme: light dark; background: light-dark(#fff, #131416); }
body { font: 1rem/1.5 system-ui, sans-serif; color: light-dark(#191a1c, #eeeeec); max-width: 76rem;
  margin: 0 auto; padding: 1rem 1.5rem; }
.charts { display: grid; gap: 1rem; grid-template-columns: repeat(auto-fit, minmax(min(100%, 34rem), 1fr)); }
figure { margin: 0; }
img { width: 100%; min-width: 34rem; height: auto; }
figure, .scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .8rem .2rem 0; text-align: left;
  border-bottom: 1px solid light-dark(#dcdcd8, #363a3f); }
.notes { color: light-dark(#55585d, #b1b4b9); font-size: .9rem; }
@media screen and (prefers-color-scheme: dark) { figure { filter: invert(.92) hue-rotate(180deg); } }
@media print { :root { color-scheme: light; } img { break-inside: avoid; } }
</style>
</head>
<body>
<h1>$name</h1>
<p>$verdict</p>
<p>$centring</p>
<div class="charts">$overview</div>
<p class="notes">$explained</p>
<p>$advice</p>
$apertures
<h2>MTF50 by place</h2>
<div class="scroll" tabindex="0" role="region" aria-label="MTF50 by place"><table>
<thead><tr>$head</tr></thead><tbody>$rows</tbody></table></div>
<p class="notes">$notes</p>
</body>
</html>
""")


def to_html(report: LensReport) -> bytes:
    """Write a report as a page that is read without a network."""
    head, rows = place_table(report)
    parts = [
        f"<h2>{report.at(number).at or 'Charts'}</h2>\n"
        f"<div class='charts'>{_images(charts(report, number))}</div>"
        for number in report.apertures
    ]
    centring = report.tested[0].centring.text
    page = _PAGE.substitute(
        name=escape(report.name),
        verdict=escape(report.verdict),
        centring=escape(f"{centring[:1].upper()}{centring[1:]}."),
        advice=escape(report.advice),
        explained=escape(EXPLAINED),
        overview=_images(overview(report)),
        apertures="\n".join(parts),
        head="".join(f"<th scope='col'>{escape(name)}</th>" for name in head),
        rows="\n".join(
            "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
        ),
        notes="<br>\n".join(map(escape, report.notes)),
    )
    return page.encode()


def _images(drawn: Iterable[Chart]) -> str:
    return "\n".join(
        f"<figure tabindex='0'><img src='{chart.source}' alt='{escape(chart.title)}'></figure>"
        for chart in drawn
    )
