"""Tables and the cumulative curve of the blind benchmark: Markdown, CSV, JSON, SVG, PNG."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from lensmodel.lab.blind.results import UNTOUCHED, BlindReport, CaseResult
from lensmodel.report.drawing import COLOURS, GREY, PALE, Label, Line, svg

# Layout in points (chosen), as in `lensmodel.report.pictures`: the picture, then the margins of the plot.
WIDTH: Final = 640
HEIGHT: Final = 400
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 170, 34, 48

# Error ratios at the ends of the axis: 1 is the true kernel; few lie beyond 10 (chosen).
LOWEST: Final = 1.0
HIGHEST: Final = 10.0
_HEADS = (
    *("noise", "method", "cases", "better than blurry", "ER < 3", "ER < 2", "ER median (p90)"),
    *("NCC", "rel. L2", "MTF error", "width", "seconds"),
)
_PNG_SCALE = 2  # pixels a point (chosen): sharp on dense screens


def markdown_table(report: BlindReport) -> str:
    """Return the summary as a Markdown table, shares in percent."""
    rows = [f"| {' | '.join(_HEADS)} |", "|---" * len(_HEADS) + "|"]
    for s in report.summary:
        better = "" if s.method == UNTOUCHED else f"{100 * s.improved:.0f} %"
        rows.append(
            f"| {100 * s.noise:g} % | {s.method} | {s.cases} | {better} | {100 * s.er_lt_3:.0f} % "
            f"| {100 * s.er_lt_2:.0f} % | {s.er_median:.2f} ({s.er_p90:.1f}) | {s.ncc:.3f} | {s.rel_l2:.2f} "
            f"| {s.mtf_rmse:.3f} | {s.width_ratio:.2f} | {s.seconds:.2f} |"
        )
    return "\n".join(rows) + "\n"


def csv_table(results: Sequence[CaseResult]) -> str:
    """Return every case as CSV with a header line."""
    out = io.StringIO()
    names = [*CaseResult.__dataclass_fields__, "improved"]
    writer = csv.DictWriter(out, names, lineterminator="\n")
    writer.writeheader()
    for result in results:
        writer.writerow({**asdict(result), "improved": result.improved})
    return out.getvalue()


def cumulative(ratios: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Percent of ratios below each threshold."""
    return np.asarray(100.0 * (ratios[None, :] < at[:, None]).mean(axis=1))


def curve_svg(report: BlindReport, noise: float) -> str:
    """Draw the percent of cases with an error ratio below t, for t in 1..10, as SVG."""
    lines, labels = _drawing(report, noise)
    return svg(_title(noise), WIDTH, HEIGHT, [*lines, *labels])


def curve_png(report: BlindReport, noise: float) -> Image.Image:
    """Draw the same as `curve_svg` as an image."""
    lines, labels = _drawing(report, noise)
    image = Image.new("RGB", (WIDTH * _PNG_SCALE, HEIGHT * _PNG_SCALE), "white")
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(12 * _PNG_SCALE)
    for line in lines:
        points = [(x * _PNG_SCALE, y * _PNG_SCALE) for x, y in line.points]
        width = max(1, round(line.width * _PNG_SCALE))
        if line.dashed:
            for start, end in _dashes(points):
                draw.line([start, end], line.colour, width)
        else:
            draw.line(points, line.colour, width)
    anchors = {"start": "ls", "middle": "ms", "end": "rs"}
    for label in labels:
        place = (label.x * _PNG_SCALE, label.y * _PNG_SCALE)
        draw.text(place, label.text, label.colour, font, anchor=anchors[label.anchor])
    return image


def write_report(report: BlindReport, folder: Path) -> tuple[Path, ...]:
    """Write blind.json, blind.csv, blind.md and one curve a noise level as SVG and PNG."""
    folder.mkdir(parents=True, exist_ok=True)
    texts = {
        "blind.json": json.dumps(report.to_json(), indent=1) + "\n",
        "blind.csv": csv_table(report.results),
        "blind.md": markdown_table(report),
    }
    written = []
    for noise in report.settings.noise:
        stem = f"blind-er-{100 * noise:g}percent"
        texts[f"{stem}.svg"] = curve_svg(report, noise)
        curve_png(report, noise).save(folder / f"{stem}.png")
        written.append(folder / f"{stem}.png")
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
        written.append(folder / name)
    return tuple(sorted(written))


def _title(noise: float) -> str:
    return f"Cases with an error ratio below t, {100 * noise:g} % noise"


def _drawing(report: BlindReport, noise: float) -> tuple[list[Line], list[Label]]:
    across, down = WIDTH - _LEFT - _RIGHT, HEIGHT - _TOP - _BOTTOM

    def x_of(t: float) -> float:
        return _LEFT + across * (t - LOWEST) / (HIGHEST - LOWEST)

    def y_of(percent: float) -> float:
        return _TOP + down * (1.0 - percent / 100.0)

    lines, labels = [], [Label(_LEFT, 20, _title(noise))]
    for percent in range(0, 101, 20):
        y = y_of(percent)
        lines.append(Line(((_LEFT, y), (_LEFT + across, y)), PALE))
        labels.append(Label(_LEFT - 8, y + 4, f"{percent} %", GREY, "end"))
    ticks = range(int(LOWEST), int(HIGHEST) + 1)
    labels.extend(Label(x_of(t), _TOP + down + 18, str(t), GREY, "middle") for t in ticks)
    labels.append(Label(_LEFT + across / 2, HEIGHT - 10, "error ratio t", GREY, "middle"))
    grid = np.linspace(LOWEST, HIGHEST, 181)
    methods = [row.method for row in report.summary if row.noise == noise]
    coloured = [m for m in methods if m != UNTOUCHED]
    for place, method in enumerate(methods):
        ratios = np.array([r.error_ratio for r in report.results if r.method == method and r.noise == noise])
        percents = cumulative(ratios, grid)
        untouched = method == UNTOUCHED
        colour = GREY if untouched else COLOURS[coloured.index(method) % len(COLOURS)]
        points = tuple((x_of(float(t)), y_of(float(p))) for t, p in zip(grid, percents, strict=True))
        lines.append(Line(points, colour, 2.0, untouched))
        y = _TOP + 12 + 20 * place
        x = _LEFT + across + 14
        lines.append(Line(((x, y - 4), (x + 22, y - 4)), colour, 2.0, untouched))
        labels.append(Label(x + 28, y, "no correction" if untouched else method))
    return lines, labels


def _dashes(
    points: Sequence[tuple[float, float]], on: float = 12.0, off: float = 8.0
) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """Cut a polyline into dashes by its length."""
    corners = np.array(points)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    out = []
    for start in np.arange(0.0, length[-1], on + off):
        ends = [
            (float(np.interp(s, length, corners[:, 0])), float(np.interp(s, length, corners[:, 1])))
            for s in (start, min(start + on, length[-1]))
        ]
        out.append((ends[0], ends[1]))
    return out
