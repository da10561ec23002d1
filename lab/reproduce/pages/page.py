"""The page: tables and pictures of a reproduction as Markdown and HTML, and every figure as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lab.reproduce.pages import page_figures, page_tables
from lab.reproduce.pages.bars import bars, held
from lab.reproduce.pages.sheet import Page, written_whole
from lab.reproduce.pages.tables import groups, hard_rows, summary


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
    page = Page()
    page.title("The paper's figures with this software", 1)
    page.text(_conditions(result))
    page_tables.which_lenses(page, result)
    page_tables.bars_table(page, bars(result))
    for label, group in groups(result).items():
        found = summary(group)
        page_tables.table1(page, found, label)
        page_tables.psf_tables(page, found, label)
        page_tables.photo_tables(page, found, label)
    page_tables.hard_table(page, result)
    page_tables.lenses(page, result)
    page_figures.fig1(page, result["figures"].get("fig1"))
    page_figures.fig2(page, result["figures"].get("fig2"))
    page_figures.fig4(page, result["figures"].get("fig4"))
    page_figures.before_after(page, result)
    return page.write(folder, "Reproduction")


def write_json(result: Mapping[str, Any], path: Path) -> Path:
    """Write every figure, the summary of each group of lenses, the rows of what hurts, and the bars."""
    found = {label: summary(group) for label, group in groups(result).items()}
    every = bars(result)
    whole = {
        **result,
        "summary": found,
        "hard_summary": hard_rows(result),
        "bars": [bar.plain() for bar in every],
        "bars_held": held(every),
    }
    return written_whole(path, json.dumps(whole, indent=1) + "\n")


def _conditions(result: Mapping[str, Any]) -> str:
    plan, cases = result["plan"], result["cases"]
    frames = sorted({(c["settings"]["width"], c["settings"]["height"]) for c in cases})
    sizes = ", ".join(f"{w} x {h} ({w * h / 1e6:.1f} MP)" for w, h in frames)
    whose = "the library's own" if plan["own_scenes"] else "given from outside"
    seen = result["developed_on"]
    unseen = f"methods were developed on {len(seen)} of them" if seen else "nothing was developed on them"
    scenes = f"The scenes are {len(result['scenes'])} photographs, {whose}; {unseen}"
    made = "; ".join(sorted({c["frames"] for c in cases}))
    families = ", ".join(
        f"{sum(c['family'] == name for c in cases)} {name}"
        for name in dict.fromkeys(c["family"] for c in cases)
    )
    paper = (
        "The paper's own way from end to end (Michaeli and Irani's kernels up to "
        f"{plan['paper_kernel']} pixels, its regression, Richardson-Lucy deconvolution alone) stands beside "
        "the default; it runs in the library. "
        if plan.get("paper_kernel")
        else ""
    )
    return (
        f"Size {plan['size']}: {len(cases)} simulated lenses ({families}), each at one setting. {scenes}; "
        f"{made}; no part of any photograph serves twice for one lens. Frames of {sizes}. The photos are "
        "Bayer DNG files of a 14-bit sensor at base ISO with shot and read noise, clipping and lateral "
        f"colour. {paper}{_rivals(plan['rivals'])}{_programs(plan.get('programs', ()))}"
        f"Calibrated and corrected {result['route']}, estimator {plan['estimator']}; "
        "the true PSF and the control go through the same correction in the library. "
        f"Code {result['code']}."
    )


def _rivals(sources: Mapping[str, str]) -> str:
    if not sources:
        return ""
    named = "; ".join(f"{name}: {source}" for name, source in sources.items())
    return f"Beside it, made anew by us, the blind rivals {named}. "


def _programs(names: Sequence[str]) -> str:
    if not names:
        return "No program of others was installed to compare with. "
    return (
        f"Beside it the programs {', '.join(names)}, each at the best of its settings, chosen against the "
        "truth. "
    )
