"""The page: tables and pictures of a reproduction as Markdown, and as HTML that needs nothing else."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from lensmodel.bench.reproduce.tables import groups, number, states, summary, table
from lensmodel.types import ZONES

_PAPER = [
    ("without correction", "613", "383"),
    ("n = 1", "923", "545"),
    ("n = 2", "1013", "608"),
    ("n = 5", "1076", "654"),
    ("true (measured) PSF", "1120", "696"),
]

_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;max-width:1000px;margin:2rem auto;padding:0 1rem;color:#202124}
table{border-collapse:collapse;margin:1rem 0;font-size:14px}
td,th{border:1px solid #dadce0;padding:.25rem .6rem;text-align:right}
td:first-child,th:first-child{text-align:left}
img{max-width:100%;display:block;margin:.3rem 0}
figure{margin:1rem 0}figcaption{font-size:14px;color:#5f6368}h2{margin-top:2.5rem}
"""


class _Page:
    """Collects blocks; writes them twice."""

    def __init__(self) -> None:
        self._markdown: list[str] = []
        self._html: list[str] = []

    def title(self, text: str, level: int = 2) -> None:
        self._markdown.append(f"{'#' * level} {text}")
        self._html.append(f"<h{level}>{escape(text)}</h{level}>")

    def text(self, text: str) -> None:
        self._markdown.append(text)
        self._html.append(f"<p>{escape(text)}</p>")

    def table(self, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        self._markdown.append(table(head, rows))
        top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
        body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
        self._html.append(f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>")

    def picture(self, name: str, words: str) -> None:
        self._markdown.append(f"{words}:\n\n![{words}](pictures/{name})")
        self._html.append(
            f'<figure><img src="pictures/{escape(name)}" alt="{escape(words)}">'
            f"<figcaption>{escape(words)}</figcaption></figure>"
        )

    def write(self, folder: Path, title: str) -> tuple[Path, Path]:
        markdown = "\n\n".join(self._markdown) + "\n"
        html = (
            f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
            f"<style>{_STYLE}</style></head><body>\n" + "\n".join(self._html) + "\n</body></html>\n"
        )
        return _whole(folder / "reproduction.md", markdown), _whole(folder / "reproduction.html", html)


def write_page(result: Mapping[str, Any], folder: Path) -> tuple[Path, Path]:
    """Write `reproduction.md` and `reproduction.html`; the pictures lie in `pictures` beside them.

    Parameters
    ----------
    result : mapping
        What `run_reproduction` returned.

    Returns
    -------
    tuple of Path
    """
    folder.mkdir(parents=True, exist_ok=True)
    page = _Page()
    page.title("The paper's figures with this software", 1)
    page.text(_conditions(result))
    for label, group in groups(result).items():
        found = summary(group)
        _table1(page, found, label)
        _fidelity(page, found, label)
    _lenses(page, result)
    _fig1(page, result["figures"].get("fig1"))
    _fig2(page, result["figures"].get("fig2"))
    _fig4(page, result["figures"].get("fig4"))
    _before_after(page, result)
    return page.write(folder, "Reproduction")


def write_json(result: Mapping[str, Any], path: Path) -> Path:
    """Write every figure, and the summary of each group of lenses."""
    found = {label: summary(group) for label, group in groups(result).items()}
    return _whole(path, json.dumps({**result, "summary": found}, indent=1) + "\n")


def _conditions(result: Mapping[str, Any]) -> str:
    plan, cases = result["plan"], result["cases"]
    seeds = sorted({case["settings"]["seed"] for case in cases})
    frames = sorted({(c["settings"]["width"], c["settings"]["height"]) for c in cases})
    sizes = ", ".join(f"{w} x {h} ({w * h / 1e6:.1f} MP)" for w, h in frames)
    whose = "the library's own" if plan["own_scenes"] else "given from outside"
    seen = result["developed_on"]
    unseen = f"methods were developed on {len(seen)} of them" if seen else "nothing was developed on them"
    scenes = f"The scenes are {len(result['scenes'])} photographs, {whose}; {unseen}"
    made = "; ".join(sorted({c["frames"] for c in cases}))
    return (
        f"Size {plan['size']}: {len(cases)} simulated lenses, each at one setting, seeds "
        f"{_listed(seeds)}; no parameter was chosen on seeds from 1000 on. {scenes}; {made}; no part of any "
        f"photograph serves twice for one lens. Frames of {sizes}. The photos are Bayer DNG files of a "
        "14-bit sensor at base ISO with shot and read noise, clipping and lateral colour. "
        f"Calibrated and corrected {result['route']}, estimator {plan['estimator']}; "
        "the true PSF and the control go through the same correction in the library. "
        f"Code {result['code']}."
    )


def _listed(seeds: Sequence[int]) -> str:
    return ", ".join(str(seed) for seed in seeds)


def _table1(page: _Page, found: Mapping[str, Any], label: str) -> None:
    page.title(f"Table 1: MTF50 in line pairs per picture height, {label}")
    page.text(
        f"Mean over {found['lenses']} lenses; in each zone the median over its slanted edges. MTF50 "
        "alone proves nothing, because a PSF that is too wide scores above the truth: read it with the "
        "highest MTF (1.00 is right) and the overshoot of the edge in percent of the step, "
        "both the largest of the zone."
    )
    for method, rows in found["mtf"].items():
        page.title(f"Method {method}", 3)
        head = ["", *(f"{zone} {what}" for zone in ZONES for what in ("MTF50", "tan / sag", "max", "over"))]
        page.table(head, [[row["state"], *_edge_cells(row)] for row in rows])
        page.text("Share of the gain of the true PSF, mean over lenses where that gain is 5 percent or more:")
        page.table(["", *ZONES], _count_rows(found["share"][method], 2))
    page.text("The paper, Canon EF 24mm f/1.4 (center, corner), for comparison of shares, not of values:")
    page.table(["", "center", "corner"], _PAPER)


def _edge_cells(row: Mapping[str, Any]) -> list[str]:
    cells = []
    for zone in ZONES:
        edge = row[zone]
        cells += [
            number(edge["mtf50"]),
            f"{number(edge['tangential_mtf50'])} / {number(edge['sagittal_mtf50'])}",
            number(edge["mtf_max"], 2),
            number(edge["overshoot"], 1),
        ]
    return cells


def _fidelity(page: _Page, found: Mapping[str, Any], label: str) -> None:
    page.title(f"Error of the PSF, {label}")
    page.text(
        "Relative L2 against the truth after sub-pixel alignment, green; median of the zone, mean over "
        "lenses."
    )
    page.table(["", *ZONES], _count_rows(found["psf"], 3))
    page.text("All three channels:")
    page.table(["", *ZONES], _count_rows(found["psf_all_channels"], 3))
    right = ", ".join(f"n = {n}: {number(v, 2)}" for n, v in found["predicted_right"].items())
    page.text(
        "Share of places where the model's own prediction of this error is right within a factor of 1.5: "
        f"{right}."
    )
    page.title(f"A photo never used for calibration, {label}")
    page.text(
        "PSNR in dB of the sRGB-encoded picture against the sharp scene, each block of 128 pixels at "
        "its best shift, before and after alike. The control denoises and demosaics without deblurring: "
        "gains in dB over the photo as it was "
        + " / ".join(f"{number(found['psnr_control'][zone], 2)} ({zone})" for zone in ZONES)
        + "."
    )
    for method, rows in found["psnr"].items():
        page.title(f"Method {method}", 3)
        page.table(["", *ZONES], [[row["state"], *(number(row[z], 2) for z in ZONES)] for row in rows])
        page.text("Share of the PSNR gain of the true PSF, where that is at least 0.2 dB:")
        page.table(["", *ZONES], _count_rows(found["psnr_kept"][method], 2))
        page.text(
            "Zones of lenses that became worse: "
            + "; ".join(
                f"n = {n}: {row['worse']} of {row['zones']}, by more than 0.05 dB {row['clearly_worse']}"
                for n, row in found["worse"][method].items()
            )
            + "."
        )


def _lenses(page: _Page, result: Mapping[str, Any]) -> None:
    page.title("Every lens")
    for method in result["plan"]["methods"]:
        page.title(f"Method {method}", 3)
        rows = []
        for case in result["cases"]:
            for name, state in states(case, method).items():
                unit = case["learned"].get(name.removeprefix("n = "))
                psf = None if unit is None or unit["psf"] is None else unit["psf"]["rel_l2"]["g"]
                rows.append([case["title"], name, *_lens_cells(state, psf)])
        head = ["lens", "", *(f"{z} {what}" for z in ZONES for what in ("MTF50", "max", "PSNR", "PSF error"))]
        page.table(head, rows)
    refused = [
        f"{case['title']}: {reason}"
        for case in result["cases"]
        for reason in dict.fromkeys(r for unit in case["learned"].values() for r in unit["refused"])
    ]
    if refused:
        page.text("Photos that gave no usable patch and did not count: " + "; ".join(refused) + ".")


def _lens_cells(state: Mapping[str, Any], psf: Mapping[str, float] | None) -> list[str]:
    cells = []
    for zone in ZONES:
        edge = state["edges"].get(zone, {})
        cells += [
            number(edge.get("mtf50")),
            number(edge.get("mtf_max"), 2),
            number(state["psnr"].get(zone), 2),
            number(None if psf is None else psf.get(zone), 2),
        ]
    return cells


def _count_rows(rows: Mapping[str, Mapping[str, float | None]], digits: int) -> list[list[str]]:
    return [[f"n = {n}", *(number(row[zone], digits) for zone in ZONES)] for n, row in rows.items()]


def _fig1(page: _Page, fig: Mapping[str, Any] | None) -> None:
    if not fig:
        return
    page.title("Fig. 1: blind estimators on single patches")
    page.text(
        "Share of cases whose error ratio stays below a bound, higher is better; from "
        f"`lensmodel bench blind`, half {fig['settings']['half']}, "
        f"patches of {fig['settings']['patch']} pixels, "
        f"camera {fig['settings']['variant']}, judged by {fig['settings']['judge']}."
    )
    rows = [
        [
            row["method"],
            f"{100 * row['noise']:g} %",
            str(row["cases"]),
            number(100 * row["improved"]),
            number(100 * row["er_lt_3"]),
            number(row["er_median"], 2),
            number(row["rel_l2"], 2),
        ]
        for row in fig["rows"]
    ]
    page.table(["", "noise", "cases", "improved %", "ER < 3 %", "median ER", "PSF error"], rows)
    for name in fig["pictures"]:
        page.picture(name, "Cumulative error ratio")


def _fig2(page: _Page, fig: Mapping[str, Any] | None) -> None:
    if not fig:
        return
    page.title("Fig. 2: interpolation against regression")
    page.text(
        "True PSFs at the 24 patches of one photo; asked in between. Linear interpolation of PSFs in the "
        "image frame is what efficient filter flow does. Relative L2, mean over lenses of seeds "
        f"{fig['seeds'][0]} to {fig['seeds'][-1]}:"
    )
    page.table(
        ["", *ZONES],
        [[row["method"], *(number(row["errors"].get(zone), 3) for zone in ZONES)] for row in fig["table"]],
    )
    places = "; ".join(f"r = {r:g}, phi = {phi:g}" for r, phi in fig["places"])
    page.picture(
        fig["picture"], f"Rows: {', '.join(fig['rows'])}. Columns: {places}. {fig['lens']}, gamma 0.5"
    )


def _fig4(page: _Page, fig: Mapping[str, Any] | None) -> None:
    if not fig:
        return
    page.title("Fig. 4: from edges to the field")
    if "failed" in fig:
        page.text(f"The photo told nothing about the blur: {fig['failed']}.")
        return
    words = (
        "Confidence map",
        f"The {fig['patches']} patches",
        f"Local PSFs of {fig['samples']} patches",
        "Regressed field",
        "The truth",
    )
    page.text(f"{fig['lens']}, one photo, green, calibrated in the library. Kernels with gamma 0.5.")
    for name, label in zip(fig["pictures"], words, strict=True):
        page.picture(name, label)


def _before_after(page: _Page, result: Mapping[str, Any]) -> None:
    page.title("Figs. 5 and 6: before and after")
    page.text(
        "1:1 crops of the photo never used for calibration: center, upper left, upper right, lower left, "
        "lower right."
    )
    for case in result["cases"]:
        page.title(case["title"], 3)
        seen = {**case["truth"]["pictures"]}
        n = max(int(n) for n in case["learned"])
        for unit in case["learned"].values():
            seen |= unit["pictures"]
        labels = {"before": "as photographed"}
        labels |= {f"n{n}-{m}": f"corrected blindly, n = {n}, method {m}" for m in result["plan"]["methods"]}
        labels |= {f"true-{m}": f"corrected with the true PSF, method {m}" for m in result["plan"]["methods"]}
        labels["scene"] = "the scene itself"
        for label, words in labels.items():
            if label in seen:
                page.picture(seen[label], words)


def _whole(path: Path, text: str) -> Path:
    """Write a file that appears whole or not at all."""
    with tempfile.NamedTemporaryFile(
        "w", dir=path.parent, suffix=".part", delete=False, encoding="utf-8"
    ) as part:
        part.write(text)
    Path(part.name).chmod(0o644)
    Path(part.name).replace(path)
    return path
