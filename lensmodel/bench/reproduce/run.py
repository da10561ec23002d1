"""Run a reproduction case by case; whatever is stored already is not computed again.

Stored for each case, one JSON file each, under a name that hashes all that it depends on::

    <key>/truth.json        as photographed, with the true PSF, denoised only
    <key>/learned-<n>.json  after n photos

The folder `<key>/work` holds photos and models while a case is unfinished.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from PIL import Image

from lensmodel.bench import pictures
from lensmodel.bench.cases import photo_half
from lensmodel.bench.reproduce import figures, measure
from lensmodel.bench.reproduce.cases import Case, Reproduction, fingerprint, key_of
from lensmodel.bench.reproduce.routes import OpenRoute, PointField, Route, corrected_with
from lensmodel.bench.reproduce.shots import Shots, take
from lensmodel.errors import InvalidInputError
from lensmodel.photo import develop
from lensmodel.psf import PsfField
from lensmodel.types import Planes

log = logging.getLogger(__name__)

CROP_PX = 128
CONTROL = "standard"
"""Method whose denoising alone is the control."""

Unit = dict[str, Any]


class OnWork(Protocol):
    """Hears of progress; weights are rough shares of the time."""

    def __call__(self, words: str, done: float, total: float, *, fresh: bool) -> None:
        """Say that `done` of `total` is over, and whether the last part was computed or found stored."""


@dataclass(slots=True)
class _Progress:
    on_work: OnWork
    total: float
    done: float = 0.0

    def tell(self, words: str, weight: float, *, fresh: bool = True) -> None:
        self.done += weight
        self.on_work(words, self.done, self.total, fresh=fresh)


def run_reproduction(
    plan: Reproduction,
    open_route: OpenRoute,
    folder: Path,
    *,
    route: str,
    code: Sequence[Path] = (),
    workers: int | None = None,
    with_figures: bool = True,
    on_work: OnWork,
) -> dict[str, Any]:
    """Run what is missing and return everything.

    Parameters
    ----------
    plan : Reproduction
    open_route : OpenRoute
        What is under test.
    folder : Path
        Results go to `cache` and `pictures` in it.
    route : str
        Name of the route: part of the keys and of the report.
    code : sequence of Path
        Code of the route outside the library; a change of it makes stored results void.
    workers : int or None
        Processes that take photos; None means all cores.
    with_figures : bool
        Whether to draw Fig. 2 and Fig. 4 too.
    on_work : OnWork
        Called after each piece of work.

    Returns
    -------
    dict
        Plain values: `plan`, `route`, `code`, `scenes`, `cases`, `figures`.
    """
    version = fingerprint(code)
    cache, shown = folder / "cache", folder / "pictures"
    shown.mkdir(parents=True, exist_ok=True)
    keys = [key_of(case, plan, route, version) for case in plan.cases]
    weights = sum(_weight(case, plan) for case in plan.cases)
    progress = _Progress(on_work, weights + (_FIGURES if with_figures else 0.0))
    results = []
    for case, key in zip(plan.cases, keys, strict=True):
        job = _Job(
            case, case.truth(), plan, open_route, cache / key, shown, progress, workers or os.cpu_count() or 1
        )
        results.append(job.run())
    drawn: Unit = {}
    if with_figures:
        path = cache / keys[0] / f"figures-{figures.version()}.json"
        drawn, fresh = stored(path, lambda: figures.draw(plan, plan.cases[0], shown, workers=workers))
        progress.tell("figures 2 and 4", _FIGURES, fresh=fresh)
    files = plan.files()
    return {
        "route": route,
        "code": version,
        "plan": {
            "size": plan.size,
            "estimator": plan.estimator,
            "methods": list(plan.methods),
            "own_scenes": plan.scenes is None,
        },
        "scenes": [path.stem for path in files],
        "developed_on": [path.stem for path in files if photo_half(path.stem) == "dev"],
        "cases": results,
        "figures": drawn,
    }


def stored(path: Path, make: Callable[[], Unit]) -> tuple[Unit, bool]:
    """Return the unit of a file, or make it and write it; the file appears whole or not at all.

    Returns
    -------
    unit : dict
    fresh : bool
        Whether it was made now.
    """
    if path.exists():
        return _read(path), False
    unit = make()
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".part", delete=False) as part:
        json.dump(unit, part, indent=1, allow_nan=False)
    Path(part.name).replace(path)
    return unit, True


_SHOT, _LEARN, _CORRECT, _FIGURES = 1.0, 6.0, 1.0, 12.0


def _weight(case: Case, plan: Reproduction) -> float:
    shots = (case.photos[-1] + 2) * _SHOT
    truth = (2 * len(plan.methods) + 2) * _CORRECT
    return shots + truth + case.photos[-1] * _LEARN + len(case.photos) * 2 * len(plan.methods) * _CORRECT


@dataclass(frozen=True, slots=True)
class _Job:
    """One case; `truth` keeps the kernels that were asked for, which are slow to make."""

    case: Case
    truth: PsfField
    plan: Reproduction
    open_route: OpenRoute
    folder: Path
    shown: Path
    progress: _Progress
    workers: int

    def run(self) -> Unit:
        case, learned = self.case, {n: self.folder / f"learned-{n}.json" for n in self.case.photos}
        truth, work = self.folder / "truth.json", self.folder / "work"
        if truth.exists() and all(path.exists() for path in learned.values()):
            self.progress.tell(f"{case.title}: stored", _weight(case, self.plan), fresh=False)
        else:
            shots = self._shots(work / "photos")
            self._truth(truth, shots)
            with self.open_route(case, work) as route:
                self._learned(route, shots, learned)
            shutil.rmtree(work)
        return {
            "name": case.name,
            "title": case.title,
            "kind": case.lens.model.split()[1].lower(),
            "settings": {key: value for key, value in asdict(case).items() if key != "layout"},
            "stops": case.stops,
            "frames": case.layout.words(),
            "truth": _read(truth),
            "learned": {str(n): _read(path) for n, path in learned.items()},
        }

    def _shots(self, folder: Path) -> Shots:
        total = (self.case.photos[-1] + 2) * _SHOT
        told = 0.0

        def on_step(done: int, count: int) -> None:
            nonlocal told
            share = total * done / count
            self.progress.tell(f"{self.case.title}: photo {done} of {count} taken", share - told)
            told = share

        shots = take(self.case, self.plan.files(), folder, workers=self.workers, on_step=on_step)
        self.progress.tell(f"{self.case.title}: photos are there", total - told, fresh=told > 0)
        return shots

    def _truth(self, path: Path, shots: Shots) -> None:
        weight = (2 * len(self.plan.methods) + 2) * _CORRECT
        _, fresh = stored(path, lambda: self._measured_truth(shots))
        self.progress.tell(f"{self.case.title}: with the true PSF", weight, fresh=fresh)

    def _measured_truth(self, shots: Shots) -> Unit:
        case = self.case
        chart, photo = develop(shots.chart), develop(shots.held_out)
        point = PointField()
        unit: Unit = {
            "before": measure.state(chart.planes, photo.planes, shots, case),
            "true": {},
            "pictures": {
                "before": self._picture("before", photo.planes),
                "scene": self._picture("scene", shots.truth()),
            },
        }
        for method in self.plan.methods:
            after = corrected_with(photo, self.truth, method)
            unit["true"][method] = measure.state(
                corrected_with(chart, self.truth, method), after, shots, case
            )
            unit["pictures"][f"true-{method}"] = self._picture(f"true-{method}", after)
        unit["control"] = measure.state(
            corrected_with(chart, point, CONTROL), corrected_with(photo, point, CONTROL), shots, case
        )
        return unit

    def _learned(self, route: Route, shots: Shots, targets: Mapping[int, Path]) -> None:
        refused: list[str] = []
        weight, seen = 2 * len(self.plan.methods) * _CORRECT, 0
        for n, path in targets.items():
            began = time.monotonic()
            for photo in shots.learn[seen:n]:
                if reason := route.learn(photo):
                    refused.append(f"{photo.stem}: {reason}")
                self.progress.tell(f"{self.case.title}: learned from {photo.stem}", _LEARN)
            seconds = time.monotonic() - began
            make = partial(self._measured, route, shots, n, tuple(refused), seconds)
            _, fresh = stored(path, make)
            self.progress.tell(f"{self.case.title}: measured after {n}", weight, fresh=fresh)
            seen = n

    def _measured(self, route: Route, shots: Shots, n: int, refused: Sequence[str], seconds: float) -> Unit:
        case = self.case
        unit: Unit = {
            "photos": n,
            "counted": n - len(refused),
            "refused": list(refused),
            "learning_seconds": round(seconds, 1),
            "pictures": {},
        }
        if n == len(refused):
            # no model: a user gets no correction, so the photos stay as they are
            before = _read(self.folder / "truth.json")["before"]
            return {**unit, "psf": None, "methods": dict.fromkeys(self.plan.methods, before)}
        answers = route.answers(measure.places(), case.settings, measure.PSF_SIZE)
        unit["psf"] = measure.psf_errors(answers, self.truth)
        unit["methods"] = {}
        for method in self.plan.methods:
            after = route.corrected(shots.held_out, method)
            unit["methods"][method] = measure.state(route.corrected(shots.chart, method), after, shots, case)
            unit["pictures"][f"n{n}-{method}"] = self._picture(f"n{n}-{method}", after)
        return unit

    def _picture(self, label: str, planes: Planes) -> str:
        name = f"{self.folder.name}-{label}.png"
        crops = pictures.strip(pictures.as_shown(planes, self.case.camera.white_balance), CROP_PX)
        Image.fromarray(crops).save(self.shown / name, optimize=True)
        return name


def _read(path: Path) -> Unit:
    try:
        unit: Unit = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"{path} is damaged; delete it and run again") from error
    return unit
