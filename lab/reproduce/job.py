"""Run a reproduction case by case: take photos, learn, correct, measure; nothing stored is computed again.

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

import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Final, Protocol, TypeAlias

import numpy as np
from PIL import Image

from lab.cases import photo_half
from lab.code_version import version_of
from lab.reproduce import figures, measure, programs
from lab.reproduce.cases import BASE, HARD_METHODS, Case, Reproduction, fingerprint, key_of
from lab.reproduce.fields import PointField, Remembered, general_field, general_words, measured_field
from lab.reproduce.frames import Shots, take
from lab.reproduce.learners import Answer, Learner, LibraryLearner, corrected_with, paper_way
from lab.rivals import rivals
from lab.store import Unit, read, stored
from lensmodel.core.errors import LensModelError
from lensmodel.core.psf import PsfField
from lensmodel.core.types import Planes
from lensmodel.photo import LinearPhoto, develop
from lensmodel.quality.images import as_shown
from lensmodel.workflow.sampling import PRESETS, Preset

CROP_PX: Final = 128  # side of a crop in a strip (chosen)
CONTROL: Final = "standard"
"""Method whose denoising alone is the control."""

_ALONE: Final = ("truth", "measured", "general")
NewLearner: TypeAlias = Callable[[Path, Preset, int], Learner]
"""From a folder that keeps what was learned, the way of learning, and a number of processes."""


class OnWork(Protocol):
    """Hears of progress."""

    def __call__(self, words: str, done: int, total: int, *, fresh: bool) -> None:
        """Say that `done` of `total` results are there, and whether the last was computed or found stored."""


def run_reproduction(
    plan: Reproduction,
    folder: Path,
    *,
    on_work: OnWork,
    results: Path | None = None,
    workers: int = 1,
    with_figures: bool = True,
    learner: NewLearner = LibraryLearner,
) -> dict[str, Any]:
    """Run what is missing and return everything.

    Returns
    -------
    dict
        Plain values: `code`, `plan`, `scenes`, `cases`, `hard` (scenes and paths that hurt), `figures`.
    """
    version = fingerprint()
    cache, shown = results or folder / "cache", folder / "pictures"
    shown.mkdir(parents=True, exist_ok=True)
    keys = [key_of(case, plan, version) for case in plan.cases]
    jobs = [
        CaseJob(case, plan, cache / key, folder / "work" / key, shown, workers, learner)
        for case, key in zip(plan.cases, keys, strict=True)
    ]
    done, total = 0, sum(len(job.files) for job in jobs) + with_figures

    def told(words: str, *, fresh: bool) -> None:
        nonlocal done
        done += 1
        on_work(words, done, total, fresh=fresh)

    finished = [_with_pictures_there(job.run(told), shown) for job in jobs]
    with suppress(OSError):  # not there, or another run's work is in it
        (folder / "work").rmdir()
    drawn: Unit = {}
    if with_figures:
        make = partial(figures.draw, plan, plan.cases[0], shown, workers=workers)
        drawn, fresh = stored(cache / keys[0] / f"figures-{figures.version()}.json", make)
        if not fresh and not all((shown / name).exists() for name in figures.names(drawn)):
            drawn, fresh = make(), True
        told("figures 2 and 4", fresh=fresh)
    files = plan.files()
    return {
        "code": version,
        "plan": {
            "size": plan.size,
            "estimator": plan.estimator,
            "methods": list(plan.methods),
            "rivals": {name: rivals.create(name).source for name in plan.rivals},
            "programs": list(plan.programs),
            "own_scenes": plan.scenes is None,
            "paper_kernel": max(
                (paper_way(case).kernel_size for case in plan.cases if plan.paper and case.is_whole),
                default=None,
            ),
        },
        "scenes": [path.stem for path in files],
        "developed_on": [path.stem for path in files if photo_half(path.stem) == "dev"],
        "cases": [one for one in finished if one["condition"] == BASE],
        "hard": [one for one in finished if one["condition"] != BASE],
        "figures": drawn,
    }


def _with_pictures_there(unit: Unit, shown: Path) -> Unit:
    """Leave out the names of pictures that another run made and that were not carried along."""
    kept = {
        key: _with_pictures_there(value, shown) if isinstance(value, dict) else value
        for key, value in unit.items()
    }
    if "pictures" in kept:
        kept["pictures"] = {k: v for k, v in kept["pictures"].items() if (shown / v).exists()}
    return kept


def rivals_version() -> str:
    """Hash of the rivals' code and basis: they are no part of what a case's key depends on."""
    return version_of("lab.rivals")[:8]


@dataclass(frozen=True)
class CaseJob:
    """One case of a reproduction."""

    case: Case
    plan: Reproduction
    folder: Path
    work: Path
    shown: Path
    workers: int
    learner: NewLearner

    @property
    def methods(self) -> tuple[str, ...]:
        """Non-blind methods of this case."""
        return self.plan.methods if self.case.condition == BASE else HARD_METHODS

    @cached_property
    def truth(self) -> Remembered:
        """The true PSFs, which are slow to make."""
        return Remembered(self.case.truth())

    @cached_property
    def files(self) -> dict[tuple[str, str], Path]:
        """Where each result of the case is stored, by part and name in it."""
        plan, folder, counts = self.plan, self.folder, [str(n) for n in self.case.photos]
        whole = self.case.is_whole  # what is compared with is done once for each lens
        found = {("truth", ""): folder / "truth.json"}
        found |= {("learned", n): folder / f"learned-{n}.json" for n in counts}
        found |= {("paper", n): folder / f"paper-{n}.json" for n in counts if whole and plan.paper}
        for part, wanted in (("measured", plan.target), ("general", plan.general)):
            found |= {(part, ""): folder / f"{part}.json"} if whole and wanted else {}
        if whole:
            code = rivals_version()
            found |= {("rivals", name): folder / f"rival-{name}-{code}.json" for name in plan.rivals}
            code = programs.version()
            for name in plan.programs:
                found["programs", name] = folder / f"program-{programs.label_of(name)}-{code}.json"
        return found

    def run(self, told: Callable[..., None]) -> Unit:
        """Compute what is missing, and return all of it."""
        case, complete = self.case, all(path.exists() for path in self.files.values())
        if not complete:
            shots = take(case, self.plan.files(), self.work / "photos", workers=self.workers)
        makers: dict[str, Callable[[str], Unit]] = {}
        if not complete:
            own, paper = PRESETS["default"], paper_way(case)
            own = replace(own, estimator=self.plan.estimator)
            makers = {
                "truth": lambda _: self._truth(shots),
                "learned": partial(self._learned, self._learning("models", own), shots, own_way=False),
                "paper": partial(self._learned, self._learning("paper", paper), shots, own_way=True),
                "measured": lambda _: self._measured(shots),
                "general": lambda _: self._by_field(general_field(case), 0.0, shots, "general"),
                "rivals": lambda name: self._rival(name, shots),
                "programs": lambda name: self._program(name, shots),
            }
        units: dict[str, dict[str, Unit]] = {part: {} for part in ("learned", "paper", "rivals", "programs")}
        for (part, name), path in self.files.items():
            words, fresh = f"{case.title}: {part} {name}".rstrip(), True
            try:
                unit, fresh = stored(path, partial(makers[part], name)) if makers else (read(path), False)
                units.setdefault(part, {})[name] = unit
            except LensModelError as error:
                if part != "programs":
                    raise
                words += f" left out: {error}"  # of others: the page goes without, the next run tries again
            told(words, fresh=fresh)
        if not complete:
            shutil.rmtree(self.work)
        return {
            "name": case.name,
            "title": case.title,
            "family": case.family,
            "unseen": case.unseen,
            "source": case.source,
            "general_profile": general_words(case) if ("general", "") in self.files else "",
            "condition": case.condition,
            "condition_title": case.conditions.title,
            "settings": {k: v for k, v in asdict(case).items() if k not in {"layout", "grid"}},
            "stops": case.stops,
            "frames": case.layout.words(),
            **{part: units.pop(part, {}).get("") for part in _ALONE},
            **units,
        }

    def _learning(self, name: str, way: Preset) -> _Learning:
        return _Learning(partial(self.learner, self.work / name, way, self.workers))

    def _truth(self, shots: Shots) -> Unit:
        case, photo = self.case, develop(shots.held_out)
        chart = None if shots.chart is None else develop(shots.chart)
        before = measure.state(None if chart is None else chart.planes, photo.planes, shots, case)
        if self._raw:
            before["light"] = measure.light(photo.planes, shots, case)
        unit: Unit = {
            "before": before,
            "true": {},
            "pictures": {
                "before": self._picture("before", photo.planes),
                "scene": self._picture("scene", self._as_photo(shots.truth())),
            },
        }
        for method in self.methods:
            unit["true"][method], name = self._corrected(chart, photo, self.truth, method, shots, "true")
            unit["pictures"] |= name
        unit["control"], _ = self._corrected(chart, photo, PointField(), CONTROL, shots, None)
        return unit

    def _measured(self, shots: Shots) -> Unit:
        """What a photo of the printed target makes of the lens: the paper's non-blind calibration."""
        try:
            began = time.monotonic()
            field = measured_field(self.case, self.work / "target.dng")
        except LensModelError as error:  # frames too small for a page: the row is left out
            return {"refused": str(error), "psf": None, "methods": {}, "pictures": {}}
        return self._by_field(field, time.monotonic() - began, shots, "measured")

    def _rival(self, name: str, shots: Shots) -> Unit:
        """What a rival makes of the first photo, corrected by our methods."""
        began = time.monotonic()
        try:
            field = rivals.create(name).field([develop(shots.learn[0])])
        except LensModelError as error:
            unit: Unit = {"refused": str(error), "psf": None, "pictures": {}}
            return {**unit, "methods": dict.fromkeys(self.methods, self._before)}
        return self._by_field(field, time.monotonic() - began, shots, name)

    def _by_field(self, psfs: PsfField, seconds: float, shots: Shots, label: str) -> Unit:
        """Errors of a PSF field, and what corrections with it come to."""
        field = Remembered(psfs)
        answers = [Answer(field.kernel_at(*place, measure.PSF_SIZE), np.nan) for place in measure.places()]
        unit: Unit = {
            "refused": "",
            "learning_seconds": round(seconds, 1),
            "psf": measure.psf_errors(answers, self.truth),
            "methods": {},
            "pictures": {},
        }
        chart = None if shots.chart is None else develop(shots.chart)
        photo = develop(shots.held_out)
        for method in self.methods:
            unit["methods"][method], made = self._corrected(chart, photo, field, method, shots, label)
            unit["pictures"] |= made
        return unit

    def _corrected(
        self,
        chart: LinearPhoto | None,
        photo: LinearPhoto,
        field: PsfField,
        method: str,
        shots: Shots,
        label: str | None,
    ) -> tuple[Unit, dict[str, str]]:
        """Correct and measure chart and photo with a field; the name of the picture, if it has a label."""
        edges = None if chart is None else corrected_with(chart, field, method, workers=self.workers)
        after = corrected_with(photo, field, method, workers=self.workers)
        name = {} if label is None else {f"{label}-{method}": self._picture(f"{label}-{method}", after)}
        before = None if chart is None else chart.planes
        return measure.state(edges, after, shots, self.case, before=before), name

    def _program(self, name: str, shots: Shots) -> Unit:
        """What a program of others makes of chart and photo, at its best setting."""
        peer, gains = programs.named(name), self.case.camera.white_balance
        setting, after = programs.best_setting(peer, develop(shots.held_out).planes, shots.truth(), gains)
        chart = None if shots.chart is None else develop(shots.chart).planes
        edges = None if chart is None else programs.corrected_by(peer, chart, setting, gains)
        label = programs.label_of(name)
        return {
            "setting": setting,
            "state": measure.state(edges, after, shots, self.case, before=chart),
            "pictures": {label: self._picture(label, after)},
        }

    def _learned(self, learning: _Learning, shots: Shots, number: str, *, own_way: bool) -> Unit:
        """What is known after so many photos, and what corrections with it come to."""
        case, n = self.case, int(number)
        methods = (PRESETS["paper"].method,) if own_way else self.methods
        label = f"way-paper-n{n}" if own_way else f"n{n}"
        learner, refused, seconds = learning.of(shots.learn[:n])
        unit: Unit = {
            "photos": n,
            "counted": n - len(refused),
            "refused": refused,
            "learning_seconds": round(seconds, 1),
            "pictures": {},
        }
        if n == len(refused):  # no model: a user gets no correction, so the photos stay as they are
            return {**unit, "psf": None, "methods": dict.fromkeys(methods, self._before)}
        unit["methods"] = {}
        chart = None if shots.chart is None else develop(shots.chart).planes
        for method in methods:
            after = learner.corrected(shots.held_out, method)
            edges = None if shots.chart is None else learner.corrected(shots.chart, method).planes
            state = measure.state(edges, after.planes, shots, case, before=chart)
            state["nothing_to_correct"] = after.nothing_to_correct
            if self._raw:
                light = self._before["light"]
                state["forecast"] = measure.forecast(light, after.planes, after.expected_db, shots, case)
            unit["methods"][method] = state
            unit["pictures"][f"{label}-{method}"] = self._picture(f"{label}-{method}", after.planes)
        answers = learner.answers(measure.places(), case.settings, measure.PSF_SIZE)
        unit["psf"] = measure.psf_errors(answers, self.truth)
        return unit

    @property
    def _before(self) -> Unit:
        state: Unit = read(self.folder / "truth.json")["before"]
        return state

    @property
    def _raw(self) -> bool:
        return self.case.conditions.container == "dng"

    def _as_photo(self, planes: Planes) -> Planes:
        """Planes of the sensor as the photo's file has them: white-balanced where it is not raw."""
        gains = np.asarray(self.case.camera.white_balance, dtype=np.float32)[:, None, None]
        return planes if self._raw else planes * gains

    def _picture(self, label: str, planes: Planes) -> str:
        name = f"{self.folder.name}-{label}.png"
        gains = self.case.camera.white_balance if self._raw else (1.0, 1.0, 1.0)
        crops = figures.strip(as_shown(planes, gains), CROP_PX)
        Image.fromarray(crops).save(self.shown / name, optimize=True)
        return name


class _Learning:
    """A learner that is opened when it is first needed, and the photos that did not count."""

    def __init__(self, opened: Callable[[], Learner]) -> None:
        self._opened = opened
        self._learner: Learner | None = None
        self._seconds = 0.0

    def of(self, photos: Sequence[Path]) -> tuple[Learner, list[str], float]:
        """Return what has learned from these photos, which of them did not count, and the seconds it took."""
        self._learner = self._learner or self._opened()
        began = time.monotonic()
        reasons = {photo: self._learner.learn(photo) for photo in photos}
        self._seconds += time.monotonic() - began
        refused = [f"{photo.stem}: {reason}" for photo, reason in reasons.items() if reason]
        return self._learner, refused, self._seconds
