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
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lab.blind.results import UNTOUCHED, BlindReport, CaseResult

# Error ratios at the ends of the axis: 1 is the true kernel; few lie beyond 10 (chosen).
LOWEST: Final = 1.0
HIGHEST: Final = 10.0
_HEADS = (
    *("noise", "method", "cases", "better than blurry", "ER < 3", "ER < 2", "ER median (p90)"),
    *("NCC", "rel. L2", "MTF error", "width", "seconds"),
)


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


def curve_figure(report: BlindReport, noise: float) -> Figure:
    """Draw the percent of cases with an error ratio below t, for t in 1..10."""
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    ax = figure.add_subplot()
    grid = np.linspace(LOWEST, HIGHEST, 181)
    for method in (row.method for row in report.summary if row.noise == noise):
        ratios = np.array([r.error_ratio for r in report.results if r.method == method and r.noise == noise])
        untouched = method == UNTOUCHED
        (line,) = ax.plot(grid, cumulative(ratios, grid), label="no correction" if untouched else method)
        if untouched:
            line.set(color="grey", linestyle="--")
    ax.set(xlabel="error ratio t", ylabel="percent of cases", xlim=(LOWEST, HIGHEST), ylim=(0.0, 100.0))
    ax.set_title(f"Cases with an error ratio below t, {100 * noise:g} % noise", loc="left", fontsize=10)
    ax.grid(color="#e5e5e0")
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


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
        for ending in ("svg", "png"):
            path = folder / f"blind-er-{100 * noise:g}percent.{ending}"
            curve_figure(report, noise).savefig(path, dpi=160)
            written.append(path)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
        written.append(folder / name)
    return tuple(sorted(written))
