"""The page of a reproduction: its tables, figures and bars, and every figure as JSON."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lab.page import Page
from lab.reproduce.bars import Bar, bars, held
from lab.reproduce.cases import GENERAL, PAPER_WAY
from lab.reproduce.tables import counts, groups, number, summary
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import write_atomically
from lensmodel.core.types import ZONES

PICTURES = "pictures/"
_PAPER = [
    ("without correction", "613", "383"),
    ("n = 1", "923", "545"),
    ("n = 2", "1013", "608"),
    ("n = 5", "1076", "654"),
    ("true (measured) PSF", "1120", "696"),
]


def write_page(result: Mapping[str, Any], folder: Path) -> tuple[Path, Path]:
    """Write `reproduction.md` and `reproduction.html`; the pictures lie in `pictures` beside them."""
    page = Page()
    page.title("The paper's figures with this software", 1)
    page.text(_conditions(result))
    _which_lenses(page, result)
    _bars_table(page, bars(result))
    for label, group in groups(result).items():
        found = summary(group)
        _table1(page, found, label)
        _psf_tables(page, found, label)
        _photo_tables(page, found, label)
    _refused(page, result)
    _fig1(page, result["figures"].get("fig1"))
    _fig2(page, result["figures"].get("fig2"))
    _fig4(page, result["figures"].get("fig4"))
    _before_after(page, result)
    return page.write(folder / "reproduction.md", "Reproduction")


def write_json(result: Mapping[str, Any], path: Path) -> Path:
    """Write every figure, the summary of each group of lenses, the rows of what hurts, and the bars."""
    found = {label: summary(group) for label, group in groups(result).items()}
    every = bars(result)
    whole = {
        **result,
        "summary": found,
        "bars": [bar.plain() for bar in every],
        "bars_held": held(every),
    }
    write_atomically(path, (json.dumps(whole, indent=1) + "\n").encode())
    return path


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


def collected(folder: Path, pictures: Path) -> dict[str, Any] | None:
    """Take tables and curves of a finished benchmark; None where there is none."""
    path = folder / "blind.json"
    if not path.exists():
        return None
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        settings, rows = stored["settings"], stored["summary"]
        kept = {name: settings[name] for name in ("half", "patch")}
    except (OSError, ValueError, KeyError) as error:
        raise InvalidInputError(f"{path} is no benchmark; run `lensmodel bench blind` again") from error
    pictures.mkdir(parents=True, exist_ok=True)
    curves = sorted(folder.glob("blind-er-*.png"))
    for curve in curves:
        shutil.copyfile(curve, pictures / f"fig1-{curve.name}")
    return {"rows": rows, "settings": kept, "pictures": [f"fig1-{curve.name}" for curve in curves]}


# --- tables ---


def _table1(page: Page, found: Mapping[str, Any], label: str) -> None:
    """MTF50 by zone, with what makes it honest."""
    page.title(f"Table 1: MTF50 in line pairs per picture height, {label}")
    page.text(
        f"Mean over {found['lenses']} lenses; in each zone the median over its edges, and the largest "
        "MTF and overshoot (percent of the step), without which MTF50 proves nothing."
    )
    head = ["", *(f"{zone} {what}" for zone in ZONES for what in ("MTF50", "tan / sag", "max", "over"))]
    page.table(head, [[_shown(state), *_edge_cells(row)] for state, row in found["mtf"].items()])
    page.text("Share of the gain of the true PSF, mean over lenses where that gain is 5 percent or more:")
    page.table(["", *ZONES], _rows({f"n = {n}": row for n, row in found["share"].items()}, 2))
    page.text("The paper, Canon EF 24mm f/1.4 (centre, corner), for comparison of shares, not of values:")
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


def _psf_tables(page: Page, found: Mapping[str, Any], label: str) -> None:
    """Error of the PSF, ours and others'."""
    page.title(f"Error of the PSF, {label}")
    page.text(
        "Relative L2 against the truth after sub-pixel alignment, green; median of the zone, mean over "
        "lenses."
    )
    page.table(["", *ZONES], _rows({_shown(state): row["g"] for state, row in found["psf"].items()}, 3))


def _photo_tables(page: Page, found: Mapping[str, Any], label: str) -> None:
    """PSNR of the photo never learned from."""
    page.title(f"A photo never used for calibration, {label}")
    page.text(
        "PSNR in dB of the sRGB-encoded picture against the sharp scene, each block of 128 pixels at its "
        "best shift."
    )
    page.table(["", *ZONES], _rows({_shown(state): row for state, row in found["psnr"].items()}, 2))
    page.text("Share of the gain of the true PSF in PSNR, where that is measurable:")
    page.table(["", *ZONES], _rows({f"n = {n}": row for n, row in found["psnr_kept"].items()}, 2))


def _bars_table(page: Page, every: Sequence[Bar]) -> None:
    """Every bar, its value, and whether it holds: for each family a table, a column for each n."""
    if not every:
        return
    page.title("What is asked, and what holds")
    count = held(every)
    page.text(
        f"{count['held']} bars hold, {count['missed']} do not, {count['unknown']} are not told by this run. "
        "They are of lenses wide open at base ISO, raw where nothing else is said, learned and corrected by "
        "default, means over the lenses of a family."
    )
    for family in dict.fromkeys(bar.family for bar in every):
        page.title(family.capitalize(), 3)
        rows: dict[tuple[str, str], dict[str, Bar]] = {}
        for bar in every:
            if bar.family == family:
                rows.setdefault((bar.name, bar.place), {})[bar.n] = bar
        counts = sorted({bar.n for bar in every if bar.family == family})
        head = ["", "where", *(f"n = {n}" for n in counts)]
        page.table(head, [[*key, *(_cell(row.get(n)) for n in counts)] for key, row in rows.items()])


def _cell(bar: Bar | None) -> str:
    if bar is None:
        return ""
    value = number(bar.value, 0 if isinstance(bar.value, int) else 2)
    band = f"at most {bar.high:g}" if bar.low is None else f"at least {bar.low:.2g}"
    verdict = {None: "not told", True: "held", False: "MISSED"}[bar.met]
    return f"{value} ({band}) {verdict}"


def _which_lenses(page: Page, result: Mapping[str, Any]) -> None:
    """Name every lens, where it comes from, and whether anything was developed on it."""
    page.title("The lenses")
    page.text(
        "Nothing was developed, chosen or trained on photos of an unseen lens. Ray-traced lenses are of "
        "published designs, traced to all orders."
    )
    rows = [
        [
            case["family"],
            case["title"],
            case["source"],
            "unseen" if case["unseen"] else "looked at during development",
            case.get("general_profile", ""),
        ]
        for case in result["cases"]
    ]
    page.table(["family", "lens", "source", "", "general profile"], rows)


def _refused(page: Page, result: Mapping[str, Any]) -> None:
    """Name the photos that did not count."""
    refused = [
        f"{case['title']}: {reason}"
        for case in result["cases"]
        for reason in dict.fromkeys(
            reason
            for state, reasons in case["refused"].items()
            if state.startswith(("n = ", PAPER_WAY))
            for reason in reasons
        )
    ]
    if refused:
        page.text("Photos that gave no usable patch and did not count: " + "; ".join(refused) + ".")


def _rows(rows: Mapping[str, Mapping[str, float | None]], digits: int) -> list[list[str]]:
    return [[name, *(number(row[zone], digits) for zone in ZONES)] for name, row in rows.items()]


def _shown(state: str) -> str:
    """Name of a state on pages: what was learned by default says so."""
    return f"default, {state}" if state.startswith("n = ") else state


# --- figures ---


def _fig1(page: Page, fig: Mapping[str, Any] | None) -> None:
    """Error ratio of blind estimators."""
    if not fig:
        return
    page.title("Fig. 1: blind estimators on single patches")
    page.text(
        "Share of cases whose error ratio stays below a bound, higher is better; from "
        f"`lensmodel bench blind`, half {fig['settings']['half']}, "
        f"patches of {fig['settings']['patch']} pixels."
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
        page.picture(PICTURES + name, "Cumulative error ratio")


def _fig2(page: Page, fig: Mapping[str, Any] | None) -> None:
    """Interpolation against regression."""
    if not fig:
        return
    page.title("Fig. 2: interpolation against regression")
    page.text(
        "Ways to answer between 24 true PSFs of one lens: of a regular grid of windows, blurred by the "
        "operator of efficient filter flow (half overlap, Bartlett-Hann windows), and regressions of one PSF "
        "at a random place of each window. Relative L2, mean over the lenses of a family:"
    )
    page.table(
        ["family", "", *ZONES],
        [
            [
                f"{row['family']} ({row['lenses']})",
                row["method"],
                *(number(row["errors"].get(zone), 3) for zone in ZONES),
            ]
            for row in fig["table"]
        ],
    )
    places = "; ".join(f"r = {r:g}, phi = {phi:g}" for r, phi in fig["places"])
    page.picture(
        PICTURES + fig["picture"],
        f"Rows: {', '.join(fig['rows'])}. Columns: {places}. {fig['lens']}, gamma 0.5",
    )


def _fig4(page: Page, fig: Mapping[str, Any] | None) -> None:
    """From edges to the field."""
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
        page.picture(PICTURES + name, label)


def _before_after(page: Page, result: Mapping[str, Any]) -> None:
    """Crops of the photo never learned from."""
    page.title("Figs. 5 and 6: before and after")
    page.text(
        "1:1 crops of the photo never used for calibration: centre, upper left, upper right, lower left, "
        "lower right."
    )
    for case in result["cases"]:
        page.title(case["title"], 3)
        for label, words in _labels(case).items():
            if label in case["pictures"]:
                page.picture(PICTURES + case["pictures"][label], words)


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
