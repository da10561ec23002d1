"""The figures of the paper on the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lab.reproduce import programs
from lab.reproduce.pages.sheet import Page
from lab.reproduce.pages.tables import GENERAL, PAPER_WAY, deconvolution, number
from lensmodel.core.types import ZONES


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
    absent = sum(not case["truth"]["pictures"] for case in result["cases"])
    if absent:
        page.text(
            f"Crops of {absent} of {len(result['cases'])} lenses were made by other runs and are not here."
        )
    for case in result["cases"]:
        names = _pictures(case)
        if names:
            page.title(case["title"], 3)
        for label, words in _labels(case, result["plan"]).items():
            if label in names:
                page.picture(names[label], words)
    _hard(page, [case for case in result.get("hard", ()) if "before" in case["truth"]["pictures"]])


def _hard(page: Page, cases: Sequence[Mapping[str, Any]]) -> None:
    if cases:
        page.title("Scenes and paths that hurt")
    for case in cases:
        page.title(f"{case['condition_title']}: {case['title']}", 3)
        page.picture(case["truth"]["pictures"]["before"], "as photographed")
        for name in next(iter(case["learned"].values()))["pictures"].values():
            page.picture(name, "corrected blindly, learned from one photo of this kind")


def _pictures(case: Mapping[str, Any]) -> dict[str, str]:
    """Files of all pictures of a lens by label."""
    units = [case["truth"], *(case[part] for part in ("general", "measured") if case.get(part))]
    units += [
        unit for part in ("learned", "paper", "rivals", "programs") for unit in case.get(part, {}).values()
    ]
    return {label: name for unit in units for label, name in unit["pictures"].items()}


def _labels(case: Mapping[str, Any], plan: Mapping[str, Any]) -> dict[str, str]:
    """Pictures of a lens in their order, with what they show."""

    def each(label: str, words: str) -> dict[str, str]:
        return {f"{label}-{m}": f"{words}, deconvolution {deconvolution(m)}" for m in plan["methods"]}

    n = max(int(n) for n in case["learned"])
    found = {"before": "as photographed", **each(f"n{n}", f"corrected blindly by default, n = {n}")}
    found[f"way-paper-n{n}-paper"] = f"corrected blindly, {PAPER_WAY}, n = {n}"
    for name, source in plan["rivals"].items():
        found |= each(name, f"corrected with the PSFs of {source}")
    found |= {
        programs.label_of(name): f"corrected by {name}, its best setting {unit['setting']:g}"
        for name, unit in case.get("programs", {}).items()
    }
    found |= each("general", f"corrected with a {GENERAL} (in place of a commercial one)")
    found |= each("measured", "corrected with PSFs measured with a target (non-blind)")
    return {**found, **each("true", "corrected with the true PSF"), "scene": "the scene itself"}
