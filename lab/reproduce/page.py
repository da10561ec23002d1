"""The page of a reproduction: its tables, figures and bars, and every figure as JSON."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lab.page import Page
from lab.reproduce.cases import GENERAL, PAPER_WAY
from lab.reproduce.tables import Bar, bars, counts, groups, held, number, summary
from lensmodel.core.files import write_atomically
from lensmodel.core.types import ZONES

PICTURES = "pictures/"
_PAPER = [
    ("without correction", "613", "383"), ("n = 1", "923", "545"), ("n = 2", "1013", "608"),
    ("n = 5", "1076", "654"), ("true (measured) PSF", "1120", "696"),
]  # fmt: skip


def write_page(result: Mapping[str, Any], folder: Path) -> tuple[Path, Path]:
    """Write `reproduction.md` and `reproduction.html`; the pictures lie in `pictures` beside them."""
    page = Page()
    page.title("The paper's figures with this software", 1)
    page.text(_conditions(result))
    _lenses(page, result)
    _bars(page, bars(result))
    for label, group in groups(result).items():
        _tables(page, summary(group), label)
    drawn = result["figures"]
    if drawn.get("fig1"):
        page.title("Fig. 1: blind estimators on single patches")
        page.text("Share of cases whose error ratio stays below a bound; from `lensmodel bench blind`.")
        page.markdown(drawn["fig1"]["table"])
        for name in drawn["fig1"]["pictures"]:
            page.picture(PICTURES + name, "Cumulative error ratio")
    if drawn.get("fig2"):
        _fig2(page, drawn["fig2"])
        _fig4(page, drawn["fig4"])
    page.title("Figs. 5 and 6: before and after")
    page.text("1:1 crops of the photo never used for calibration: centre, then the four corners.")
    for case in result["cases"]:
        page.title(case["title"], 3)
        for label, words in _labels(case).items():
            if label in case["pictures"]:
                page.picture(PICTURES + case["pictures"][label], words)
    return page.write(folder / "reproduction.md", "Reproduction")


def write_json(result: Mapping[str, Any], path: Path) -> Path:
    """Write every figure, the summary of each group of lenses, and the bars."""
    every = bars(result)
    whole = {
        **result,
        "summary": {label: summary(group) for label, group in groups(result).items()},
        "bars": [bar.plain() for bar in every],
        "bars_held": held(every),
    }
    write_atomically(path, (json.dumps(whole, indent=1) + "\n").encode())
    return path


def collected(folder: Path, pictures: Path) -> dict[str, Any] | None:
    """Take table and curves of a finished `lensmodel bench blind`; None where there is none."""
    if not (folder / "blind.md").exists():
        return None
    pictures.mkdir(parents=True, exist_ok=True)
    curves = sorted(folder.glob("blind-er-*.png"))
    for curve in curves:
        shutil.copyfile(curve, pictures / f"fig1-{curve.name}")
    table = (folder / "blind.md").read_text(encoding="utf-8")
    return {"table": table, "pictures": [f"fig1-{curve.name}" for curve in curves]}


def _conditions(result: Mapping[str, Any]) -> str:
    """What was run, in numbers; docs/lab/reproduction.md says how."""
    plan, cases, seen = result["plan"], result["cases"], result["developed_on"]
    frames = sorted({(c["settings"]["width"], c["settings"]["height"]) for c in cases})
    sizes = ", ".join(f"{w} x {h}" for w, h in frames)
    whose = "the library's own" if plan["own_scenes"] else "given from outside"
    unseen = f"methods were developed on {len(seen)} of them" if seen else "nothing was developed on them"
    return (
        f"Size {plan['size']}: {len(cases)} simulated lenses, wide open, at base ISO, in frames of {sizes}. "
        f"The scenes are {len(result['scenes'])} photographs, {whose}; {unseen}. "
        f"How it is done, and what the figures mean: docs/lab/reproduction.md. Code {result['code']}."
    )


def _lenses(page: Page, result: Mapping[str, Any]) -> None:
    """Name every lens, where it comes from, whether anything was developed on it, and refused photos."""
    page.title("The lenses")
    page.text("Nothing was developed, chosen or trained on photos of an unseen lens.")
    head = ["family", "lens", "source", "", "general profile", "photos that did not count"]
    rows = []
    for case in result["cases"]:
        refused = [reason for name, reasons in case["refused"].items()
                   if name.startswith(("n = ", PAPER_WAY)) for reason in reasons]  # fmt: skip
        seen = "unseen" if case["unseen"] else "looked at during development"
        own = [case["family"], case["title"], case["source"], seen, case.get("general_profile", "")]
        rows.append([*own, "; ".join(dict.fromkeys(refused))])
    page.table(head, rows)


def _bars(page: Page, every: list[Bar]) -> None:
    """Every bar, its value, and whether it holds: for each family a table, a column for each n."""
    page.title("What is asked, and what holds")
    count = held(every)
    page.text(
        f"{count['held']} bars hold, {count['missed']} do not, {count['unknown']} are not told by this run. "
        "They are of lenses wide open at base ISO, raw where nothing else is said, learned and corrected by "
        "default, means over the lenses of a family."
    )
    for family in dict.fromkeys(bar.family for bar in every):
        own = [bar for bar in every if bar.family == family]
        page.title(family.capitalize(), 3)
        rows: dict[tuple[str, str], dict[str, str]] = {}
        for bar in own:
            value = number(bar.value, 0 if isinstance(bar.value, int) else 2)
            verdict = {None: "not told", True: "held", False: "MISSED"}[bar.met]
            rows.setdefault((bar.name, bar.place), {})[bar.n] = f"{value} ({bar.asked}) {verdict}"
        numbers = sorted({bar.n for bar in own})
        head = ["", "where", *(f"n = {n}" for n in numbers)]
        page.table(head, [[*key, *(row.get(n, "") for n in numbers)] for key, row in rows.items()])


def _tables(page: Page, found: Mapping[str, Any], label: str) -> None:
    """Table 1, errors of the PSF and PSNR of a family of lenses."""

    def zones(words: str, rows: Mapping[str, Mapping[str, float | None]], digits: int) -> None:
        page.text(words)
        head = ["", *ZONES]
        page.table(head, [[name, *(number(row[z], digits) for z in ZONES)] for name, row in rows.items()])

    def named(rows: Mapping[str, Any]) -> dict[str, Any]:  # what was learned by default says so
        return {f"default, {name}" if name.startswith("n = ") else name: row for name, row in rows.items()}

    page.title(f"Table 1: MTF50 in line pairs per picture height, {label}")
    page.text(
        f"Mean over {found['lenses']} lenses; in each zone the median over its edges, and the largest "
        "MTF and overshoot (percent of the step), without which MTF50 proves nothing."
    )
    head = ["", *(f"{zone} {what}" for zone in ZONES for what in ("MTF50", "tan / sag", "max", "over"))]
    page.table(head, [[name, *_edge_cells(row)] for name, row in named(found["mtf"]).items()])
    by_count = {name: {f"n = {n}": row for n, row in found[name].items()} for name in ("share", "psnr_kept")}
    words = "Share of the gain of the true PSF, mean over lenses where that gain is 5 percent or more:"
    zones(words, by_count["share"], 2)
    page.text("The paper, Canon EF 24mm f/1.4 (centre, corner), for comparison of shares, not of values:")
    page.table(["", "center", "corner"], _PAPER)
    page.title(f"Error of the PSF, {label}")
    words = "Relative L2 to the truth after sub-pixel alignment, green; median of the zone, mean over lenses."
    zones(words, {name: row["g"] for name, row in named(found["psf"]).items()}, 3)
    page.title(f"A photo never used for calibration, {label}")
    words = "PSNR in dB of the sRGB-encoded picture, each block of 128 pixels at its best shift."
    zones(words, named(found["psnr"]), 2)
    zones("Share of the gain of the true PSF in PSNR, where that is measurable:", by_count["psnr_kept"], 2)


def _edge_cells(row: Mapping[str, Any]) -> list[str]:
    cells = []
    for edge in (row[zone] for zone in ZONES):
        directions = f"{number(edge['tangential_mtf50'])} / {number(edge['sagittal_mtf50'])}"
        cells += [number(edge["mtf50"]), directions, number(edge["mtf_max"], 2), number(edge["overshoot"], 1)]
    return cells


def _fig2(page: Page, fig: Mapping[str, Any]) -> None:
    """Interpolation against regression."""
    page.title("Fig. 2: interpolation against regression")
    page.text(
        "Ways to answer between 24 true PSFs of one lens: of a regular grid of windows, blurred by the "
        "operator of efficient filter flow (half overlap, Bartlett-Hann windows), and regressions of one PSF "
        "at a random place of each window. Relative L2, mean over the lenses of a family:"
    )
    rows = []
    for row in fig["table"]:
        errors = (number(row["errors"].get(z), 3) for z in ZONES)
        rows.append([f"{row['family']} ({row['lenses']})", row["method"], *errors])
    page.table(["family", "", *ZONES], rows)
    page.picture(PICTURES + fig["picture"], f"{fig['lens']}, gamma 0.5")


def _fig4(page: Page, fig: Mapping[str, Any]) -> None:
    """From edges to the field."""
    page.title("Fig. 4: from edges to the field")
    if "failed" in fig:
        page.text(f"The photo told nothing about the blur: {fig['failed']}.")
        return
    words = f"{fig['lens']}, one photo: {fig['samples']} green PSFs of {fig['patches']} patches, gamma 0.5"
    page.picture(PICTURES + fig["picture"], words)


def _labels(case: Mapping[str, Any]) -> dict[str, str]:
    """Pictures of a lens in their order, with what they show."""
    n = counts([case])[-1]
    return {
        "before": "as photographed",
        f"n{n}": f"corrected blindly by default, n = {n}",
        "tiff": "a 16-bit TIFF corrected, n = 1",
        "jpeg": "a JPEG corrected, n = 1",
        f"way-paper-n{n}": f"corrected blindly, {PAPER_WAY}, n = {n}",
        "schuler": "corrected with the PSFs of Schuler et al. 2012 (a basis of lenses)",
        "general": f"corrected with a {GENERAL} (in place of a commercial one)",
        "measured": "corrected with PSFs measured with a target (non-blind)",
        "true": "corrected with the true PSF",
        "scene": "the scene itself",
    }
