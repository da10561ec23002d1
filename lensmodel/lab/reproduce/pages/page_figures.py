"""The figures of the paper on the page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lensmodel.core.types import ZONES
from lensmodel.lab.reproduce import programs
from lensmodel.lab.reproduce.pages.sheet import Page
from lensmodel.lab.reproduce.pages.tables import number


def fig1(page: Page, fig: Mapping[str, Any] | None) -> None:
    """Error ratio of blind estimators."""
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


def fig2(page: Page, fig: Mapping[str, Any] | None) -> None:
    """Interpolation against regression."""
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


def fig4(page: Page, fig: Mapping[str, Any] | None) -> None:
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
        page.picture(name, label)


def before_after(page: Page, result: Mapping[str, Any]) -> None:
    """Crops of the photo never learned from."""
    page.title("Figs. 5 and 6: before and after")
    page.text(
        "1:1 crops of the photo never used for calibration: center, upper left, upper right, lower left, "
        "lower right."
    )
    for case in result["cases"]:
        page.title(case["title"], 3)
        seen = {**case["truth"]["pictures"]}
        n = max(int(n) for n in case["learned"])
        others = case.get("programs", {})
        for unit in (*case["learned"].values(), *case["rivals"].values(), *others.values()):
            seen |= unit["pictures"]
        labels = {"before": "as photographed"}
        labels |= {f"n{n}-{m}": f"corrected blindly, n = {n}, method {m}" for m in result["plan"]["methods"]}
        labels |= {
            f"{name}-{m}": f"corrected with the PSFs of {source}, method {m}"
            for name, source in result["plan"]["rivals"].items()
            for m in result["plan"]["methods"]
        }
        labels |= {
            programs.label_of(name): f"corrected by {name}, its best setting {unit['setting']:g}"
            for name, unit in others.items()
        }
        labels |= {f"true-{m}": f"corrected with the true PSF, method {m}" for m in result["plan"]["methods"]}
        labels["scene"] = "the scene itself"
        for label, words in labels.items():
            if label in seen:
                page.picture(seen[label], words)
    hard = result.get("hard", ())
    if hard:
        page.title("Scenes and paths that hurt")
    for case in hard:
        page.title(f"{case['condition_title']}: {case['title']}", 3)
        unit = next(iter(case["learned"].values()))
        page.picture(case["truth"]["pictures"]["before"], "as photographed")
        for name in unit["pictures"].values():
            page.picture(name, "corrected blindly, learned from one photo of this kind")
