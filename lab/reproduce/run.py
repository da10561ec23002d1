"""Run a reproduction case by case; whatever is stored already is not computed again.

Stored for each case, one JSON file each, under a name that hashes all that it depends on::

    <key>/truth.json                  as photographed, with the true PSF, denoised only
    <key>/learned-<n>.json            after n photos
    <key>/paper-<n>.json              the same the paper's own way from end to end
    <key>/measured.json               with PSFs measured on a target
    <key>/general.json                with a general profile of the lens model
    <key>/rival-<name>-<version>.json corrected with the PSFs of a rival, from the first photo
    <key>/program-<name>-<version>.json  corrected by a program of others

They hold figures only, some ten kilobytes a lens: carried to another machine they serve a run there. Photos
and models of an unfinished case lie in `work` of the output folder, pictures in `pictures`.
"""

from __future__ import annotations

import os
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from lab.cases import photo_half
from lab.code_version import version_of
from lab.reproduce import figures
from lab.reproduce.cases import Reproduction, fingerprint, key_of
from lab.reproduce.conditions import BASE
from lab.reproduce.job import CaseJob
from lab.reproduce.progress import FIGURES, OnWork, Progress, weight_of, with_paper
from lab.reproduce.routes import OpenRoute, paper_way
from lab.reproduce.store import Unit, stored
from lab.rivals import rivals


def run_reproduction(
    plan: Reproduction,
    open_route: OpenRoute,
    folder: Path,
    *,
    route: str,
    workers: int | None = None,
    with_figures: bool = True,
    results: Path | None = None,
    on_work: OnWork,
) -> dict[str, Any]:
    """Run what is missing and return everything.

    Parameters
    ----------
    plan : Reproduction
    open_route : OpenRoute
        What is under test.
    folder : Path
        Pictures go to `pictures` in it.
    route : str
        Name of the route: part of the keys and of the report.
    workers : int or None
        Processes that take photos; None means all cores.
    with_figures : bool
        Whether to draw Fig. 2 and Fig. 4 too.
    results : Path, optional
        Where results are stored and taken from; by default `cache` in `folder`.
    on_work : OnWork
        Called after each piece of work.

    Returns
    -------
    dict
        Plain values: `plan`, `route`, `code`, `scenes`, `cases`, `hard` (scenes and paths that
        hurt), `figures`.
    """
    version = fingerprint()
    cache, shown = results or folder / "cache", folder / "pictures"
    shown.mkdir(parents=True, exist_ok=True)
    keys = [key_of(case, plan, route, version) for case in plan.cases]
    weights = sum(weight_of(case, plan) for case in plan.cases)
    rival_code = rivals_version()
    progress = Progress(on_work, weights + (FIGURES if with_figures else 0.0))
    done = []
    for case, key in zip(plan.cases, keys, strict=True):
        job = CaseJob(
            case,
            case.truth(),
            plan,
            open_route,
            cache / key,
            folder / "work" / key,
            shown,
            progress,
            workers or os.cpu_count() or 1,
            rival_code,
        )
        done.append(_with_pictures_there(job.run(), shown))
    with suppress(OSError):  # not there, or another run's work is in it
        (folder / "work").rmdir()
    drawn: Unit = {}
    if with_figures:
        path = cache / keys[0] / f"figures-{figures.version()}.json"
        drawn, fresh = stored(path, partial(figures.draw, plan, plan.cases[0], shown, workers=workers))
        if not fresh and not all((shown / name).exists() for name in figures.names(drawn)):
            drawn, fresh = figures.draw(plan, plan.cases[0], shown, workers=workers), True
        progress.tell("figures 2 and 4", FIGURES, fresh=fresh)
    files = plan.files()
    return {
        "route": route,
        "code": version,
        "plan": {
            "size": plan.size,
            "estimator": plan.estimator,
            "methods": list(plan.methods),
            "rivals": {name: rivals.create(name).source for name in plan.rivals},
            "programs": list(plan.programs),
            "own_scenes": plan.scenes is None,
            "paper": plan.paper,
            "paper_kernel": max(
                (paper_way(case).kernel_size for case in plan.cases if with_paper(case, plan)), default=None
            ),
        },
        "scenes": [path.stem for path in files],
        "developed_on": [path.stem for path in files if photo_half(path.stem) == "dev"],
        "cases": [one for one in done if one["condition"] == BASE],
        "hard": [one for one in done if one["condition"] != BASE],
        "figures": drawn,
    }


def _with_pictures_there(case: Unit, shown: Path) -> Unit:
    """Leave out the names of pictures that another run made and that were not carried along."""

    def there(unit: Unit) -> Unit:
        kept = {key: there(value) if isinstance(value, dict) else value for key, value in unit.items()}
        if "pictures" in kept:
            kept["pictures"] = {k: v for k, v in kept["pictures"].items() if (shown / v).exists()}
        return kept

    return there(case)


def rivals_version() -> str:
    """Hash of the rivals' code and basis: they are no part of what a case's key depends on."""
    return version_of("lab.rivals")[:8]
