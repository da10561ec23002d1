"""A lens test as PDF, the same drawings as in HTML; reportlab, an extra, writes it."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

from lensmodel.report.charts import apertures_chart, charts_of, lateral_chart
from lensmodel.report.comparison import Comparison
from lensmodel.report.documents import error_map_words, facts, zone_table
from lensmodel.report.drawing import Area, Box, Label, Line, Part, ReportChart
from lensmodel.report.lens_test import LensTest

_MARGIN: Final = 42.0  # points, 15 mm (chosen: every printer reaches so far)
_FONT: Final = "Helvetica"
_ANCHORS: Final = {"start": "drawString", "middle": "drawCentredString", "end": "drawRightString"}


def to_pdf(test: LensTest) -> bytes:
    """Write a lens test as PDF, A4.

    Raises
    ------
    ModuleNotFoundError
        Without reportlab.
    """
    story = _Story(test.name)
    story.heading(test.name, 18)
    story.text(test.verdict, 12.5)
    story.text(f"{facts(test)}.", 9)
    story.table(*zone_table(test))
    whole = [chart for chart in (apertures_chart(test), lateral_chart(test)) if chart is not None]
    story.charts(whole)
    for aperture in test.apertures:
        tested = test.at(aperture)
        story.heading("Aperture unknown" if aperture is None else f"At f/{aperture:g}", 13)
        for line in tested.report.summary:
            story.text(f"- {line}", 9.5)
        story.charts(charts_of(test, aperture))
        story.text(error_map_words(tested), 8.5)
    story.heading("What would help most", 13)
    story.text(test.advice.text, 10)
    return story.done()


def comparison_pdf(comparison: Comparison) -> bytes:
    """Write a comparison as PDF, A4.

    Raises
    ------
    ModuleNotFoundError
        Without reportlab.
    """
    title = f"{comparison.first.name} and {comparison.second.name}"
    story = _Story(title)
    story.heading(title, 16)
    story.text(comparison.verdict, 12)
    for side in (comparison.first, comparison.second):
        story.text(f"{side.facts}.", 9)
    head = ["Zone", "First, c/px", "Second, c/px", "Difference"]
    rows = [[c.zone, f"{c.first:.3f}", f"{c.second:.3f}", f"{c.share:+.0%}"] for c in comparison.zones]
    story.table(head, rows)
    story.charts(comparison.charts)
    story.text(error_map_words(comparison.first.tested), 8.5)
    return story.done()


class _Story:
    """Text, tables and charts one below the other, on as many pages as it takes."""

    def __init__(self, title: str) -> None:
        from reportlab.lib.pagesizes import A4  # noqa: PLC0415 - an extra
        from reportlab.pdfgen.canvas import Canvas  # noqa: PLC0415 - an extra

        self._out = io.BytesIO()
        self._wide, self._high = A4
        # the same report is the same file: no time of day in it
        self._canvas: Any = Canvas(self._out, pagesize=A4, invariant=True)
        self._title = title
        self._canvas.setTitle(title)
        self._canvas.setCreator("lensmodel")
        self._y = self._high - _MARGIN

    @property
    def _room(self) -> float:
        return self._wide - 2.0 * _MARGIN

    def _need(self, high: float) -> None:
        """Begin a new page where so much does not fit."""
        if self._y - high < _MARGIN:
            self._end_page()
            self._y = self._high - _MARGIN

    def _end_page(self) -> None:
        """Write the number at the foot of a page and close it."""
        self._canvas.setFillColor("#55585d")
        self._canvas.setFont(_FONT, 8)
        foot = f"{self._title} - page {self._canvas.getPageNumber()}"
        self._canvas.drawRightString(self._wide - _MARGIN, _MARGIN / 2.0, _plain(foot))
        self._canvas.showPage()

    def heading(self, text: str, size: float) -> None:
        self._need(size * 4.0)
        self._y -= size * 1.5
        self._canvas.setFillColor("#111827")
        self._canvas.setFont(f"{_FONT}-Bold", size)
        self._canvas.drawString(_MARGIN, self._y, _plain(text))
        self._y -= size * 0.6

    def text(self, text: str, size: float) -> None:
        from reportlab.lib.utils import simpleSplit  # noqa: PLC0415 - an extra

        for line in simpleSplit(_plain(text), _FONT, size, self._room):
            self._need(size * 1.4)
            self._y -= size * 1.4
            self._canvas.setFillColor("#111827")
            self._canvas.setFont(_FONT, size)
            self._canvas.drawString(_MARGIN, self._y, line)
        self._y -= size * 0.3

    def table(self, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        size, step = 9.0, self._room / len(head)
        for number, row in enumerate([head, *rows]):
            self._need(size * 1.6)
            self._y -= size * 1.5
            self._canvas.setFillColor("#111827")
            self._canvas.setFont(f"{_FONT}-Bold" if number == 0 else _FONT, size)
            for k, cell in enumerate(row):
                self._canvas.drawString(_MARGIN + k * step, self._y, _plain(cell))
        self._y -= size

    def charts(self, charts: Sequence[ReportChart]) -> None:
        """Draw charts one below the other, so large that their lettering reads like small print."""
        gap = 12.0
        for chart in charts:
            scale = min(self._room / chart.width, (self._high - 2.0 * _MARGIN - gap) / chart.height)
            self._need(chart.height * scale + gap)
            self._chart(chart, _MARGIN, self._y - gap, scale)
            self._y -= chart.height * scale + gap

    def _chart(self, chart: ReportChart, left: float, top: float, scale: float) -> None:
        self._canvas.saveState()
        self._canvas.translate(left, top)
        self._canvas.scale(scale, scale)
        for part in chart.parts:
            _DRAWERS[type(part)](self._canvas, part)
        self._canvas.restoreState()

    def done(self) -> bytes:
        self._end_page()
        self._canvas.save()
        return self._out.getvalue()


def _plain(text: str) -> str:
    """Leave what the built-in fonts of PDF have."""
    return text.encode("cp1252", "replace").decode("cp1252")


def _line(canvas: Any, line: Line) -> None:  # noqa: ANN401 - reportlab has no types
    canvas.setStrokeColor(line.colour)
    canvas.setLineWidth(line.width)
    canvas.setDash([6, 4] if line.dashed else [])
    path = canvas.beginPath()
    path.moveTo(line.points[0][0], -line.points[0][1])
    for x, y in line.points[1:]:
        path.lineTo(x, -y)
    canvas.drawPath(path, stroke=1, fill=0)


def _label(canvas: Any, label: Label) -> None:  # noqa: ANN401 - same
    canvas.setFillColor(label.colour)
    canvas.setFont(_FONT, label.size)
    getattr(canvas, _ANCHORS[label.anchor])(label.x, -label.y, _plain(label.text))


def _box(canvas: Any, box: Box) -> None:  # noqa: ANN401 - same
    canvas.setFillColor(box.colour)
    canvas.rect(box.x, -box.y - box.height, box.width, box.height, stroke=0, fill=1)


def _area(canvas: Any, area: Area) -> None:  # noqa: ANN401 - same
    canvas.saveState()
    canvas.setFillColor(area.colour, alpha=area.opacity)
    path = canvas.beginPath()
    path.moveTo(area.points[0][0], -area.points[0][1])
    for x, y in area.points[1:]:
        path.lineTo(x, -y)
    path.close()
    canvas.drawPath(path, stroke=0, fill=1)
    canvas.restoreState()


_DRAWERS: Final[dict[type[Part], Callable[[Any, Any], None]]] = {
    Line: _line,
    Label: _label,
    Box: _box,
    Area: _area,
}
