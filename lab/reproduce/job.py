"""Run a reproduction case by case: take photos, learn, correct, measure; nothing stored is computed again.

Stored for each case, one JSON file each, under a name that hashes all that it depends on::

    <key>/truth.json                  as photographed, with the true PSF, denoised only
    <key>/learned-<n>.json            after n photos
    <key>/path-<container>.json       learned and corrected as another kind of file
    <key>/paper-<n>.json              the same the paper's own way from end to end
    <key>/measured.json               with PSFs measured on a target
    <key>/general.json                with a general profile of the lens model
    <key>/rival-<version>.json        corrected with the PSFs of a rival (`lab.schuler`), from the first photo

They hold figures only, some ten kilobytes a lens. Photos lie in `photos` of the output folder, pictures in
`pictures`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Final, TypeAlias, cast

import numpy as np
from PIL import Image

from lab.cases import photo_half
from lab.images import as_shown
from lab.reproduce import figures, measure
from lab.reproduce.cases import Case, Reproduction, fingerprint, key_of, photos_of
from lab.reproduce.fields import PointField, Remembered, general_field, general_words, measured_field
from lab.reproduce.learners import Answer, Learner, LibraryLearner, Roi, corrected_with, paper_way
from lab.reproduce.shots import Container, Shots, in_container, take
from lab.schuler import Schuler
from lab.stored import Unit, read, stored, version_of
from lensmodel.core.errors import LensModelError
from lensmodel.core.psf import PsfField
from lensmodel.core.types import Planes
from lensmodel.photo import LinearPhoto, develop
from lensmodel.workflow.sampling import PRESETS, Preset

CROP_PX: Final = 128  # side of a crop in a strip (chosen)
CONTROL: Final = "standard"
"""Method whose denoising alone is the control."""

PATHS: Final[tuple[Container, ...]] = ("tiff", "jpeg")
"""Kinds of files that each lens is learned from and corrected in too, one photo of each."""

_SEVERAL: Final = ("learned", "paths", "paper")
_ALONE: Final = ("truth", "measured", "general", "rival")
NewLearner: TypeAlias = Callable[[Preset, int], Learner]
"""From the way of learning and a number of processes."""


OnWork: TypeAlias = Callable[[str, int, int], None]
"""Hears what was done, and how many of how many results are there."""


def run_reproduction(
    plan: Reproduction,
    folder: Path,
    *,
    on_work: OnWork,
    workers: int = 1,
    learner: NewLearner = LibraryLearner,
) -> dict[str, Any]:
    """Run what is missing and return everything."""
    version = fingerprint()
    cache, shown = folder / "cache", folder / "pictures"
    shown.mkdir(parents=True, exist_ok=True)
    keys = [key_of(case, plan, version) for case in plan.cases]
    jobs = [
        CaseJob(case, plan, cache / key, folder / "photos" / photos_of(case, plan), shown, workers, learner)
        for case, key in zip(plan.cases, keys, strict=True)
    ]
    done, total = 0, sum(len(job.files) for job in jobs) + plan.compare

    def told(words: str) -> None:
        nonlocal done
        done += 1
        on_work(words, done, total)

    finished = [job.run(told) for job in jobs]
    drawn: Unit = {}
    if plan.compare:
        make = partial(figures.draw, plan, jobs[0].photos, shown, workers=workers)
        drawn = stored(cache / keys[0] / f"figures-{figures.version()}.json", make)
        if not all((shown / name).exists() for name in figures.names(drawn)):
            drawn = make()
        told("figures 2 and 4")
    files = plan.files()
    return {
        "code": version,
        "plan": {
            "size": plan.size,
            "methods": list(plan.methods),
            "own_scenes": plan.scenes is None,
            "paper_kernel": paper_way(plan.cases[0]).kernel_size if plan.compare else None,
        },
        "scenes": [path.stem for path in files],
        "developed_on": [path.stem for path in files if photo_half(path.stem) == "dev"],
        "cases": finished,
        "figures": drawn,
    }


def rival_version() -> str:
    """Hash of the rival's code and basis: they are no part of what a case's key depends on."""
    return version_of("lab.schuler")[:8]


@dataclass(frozen=True)
class CaseJob:
    """One case of a reproduction."""

    case: Case
    plan: Reproduction
    folder: Path
    photos: Path
    shown: Path
    workers: int
    learner: NewLearner

    @cached_property
    def truth(self) -> Remembered:
        """The true PSFs, which are slow to make."""
        return Remembered(self.case.truth())

    @cached_property
    def files(self) -> dict[tuple[str, str], Path]:
        """Where each result of the case is stored, by part and name in it."""
        plan, folder, counts = self.plan, self.folder, [str(n) for n in self.case.photos]
        found = {("truth", ""): folder / "truth.json"}
        found |= {("learned", n): folder / f"learned-{n}.json" for n in counts}
        found |= {("paths", name): folder / f"path-{name}.json" for name in PATHS}
        if plan.compare:
            found |= {("paper", n): folder / f"paper-{n}.json" for n in counts}
            found |= {(part, ""): folder / f"{part}.json" for part in ("measured", "general")}
            found |= {("rival", ""): folder / f"rival-{rival_version()}.json"}
        return found

    def run(self, told: Callable[[str], None]) -> Unit:
        """Compute what is missing, and return all of it."""
        case, complete = self.case, all(path.exists() for path in self.files.values())
        makers: dict[str, Callable[[str], Unit]] = {}
        if not complete:
            shots = take(case, self.plan.files(), self.photos)
            own, paper = PRESETS["default"], paper_way(case)
            makers = {
                "truth": lambda _: self._truth(shots),
                "learned": partial(self._learned, self._learning(own), shots, own_way=False),
                "paths": lambda name: self._path(cast("Container", name), own, shots),
                "paper": partial(self._learned, self._learning(paper), shots, own_way=True),
                "measured": lambda _: self._measured(shots),
                "general": lambda _: self._by_field(general_field(case), 0.0, shots, "general"),
                "rival": lambda _: self._rival(shots),
            }
        units: dict[str, dict[str, Unit]] = {part: {} for part in _SEVERAL}
        for (part, name), path in self.files.items():
            unit = stored(path, partial(makers[part], name)) if makers else read(path)
            units.setdefault(part, {})[name] = unit
            told(f"{case.title}: {part} {name}".rstrip())
        return {
            "name": case.name,
            "title": case.title,
            "family": case.family,
            "unseen": case.unseen,
            "source": case.source,
            "general_profile": general_words(case) if self.plan.compare else "",
            "settings": {k: v for k, v in asdict(case).items() if k not in {"layout", "grid"}},
            **{part: units.pop(part, {}).get("") for part in _ALONE},
            **units,
        }

    def _learning(self, way: Preset) -> _Learning:
        return _Learning(partial(self.learner, way, self.workers))

    def _truth(self, shots: Shots) -> Unit:
        case, photo, chart = self.case, develop(shots.held_out), develop(shots.chart)
        before = measure.state(chart.planes, photo.planes, shots, case)
        before["light"] = measure.light(photo.planes, shots, case)
        unit: Unit = {
            "before": before,
            "true": {},
            "pictures": {
                "before": self._picture("before", photo.planes),
                "scene": self._picture("scene", shots.truth()),
            },
        }
        for method in self.plan.methods:
            unit["true"][method], name = self._corrected(chart, photo, self.truth, method, shots, "true")
            unit["pictures"] |= name
        unit["control"] = None
        if self.plan.compare:
            unit["control"], _ = self._corrected(chart, photo, PointField(), CONTROL, shots, None)
        return unit

    def _path(self, container: Container, way: Preset, shots: Shots) -> Unit:
        """What becomes of the first and the held-out photo as files of another kind, learned from the one."""
        learned, asked = (in_container(path, container) for path in (shots.learn[0], shots.held_out))
        photo, method = develop(asked), self.plan.methods[0]
        learner, refused, _ = self._learning(way).of([learned])
        true = corrected_with(photo, self.truth, method, self._parts, workers=self.workers)
        after = photo.planes if refused else learner.corrected(asked, method, self._parts).planes
        states = {"before": photo.planes, "true": true, "after": after}
        made = {name: measure.state(None, v, shots, self.case, raw=False) for name, v in states.items()}
        return {
            **made,
            "refused": refused,
            "pictures": {container: self._picture(container, after, raw=False)},
        }

    def _measured(self, shots: Shots) -> Unit:
        """What a photo of the printed target makes of the lens: the paper's non-blind calibration."""
        try:
            began = time.monotonic()
            field = measured_field(self.case, self.photos / "target.dng")
        except LensModelError as error:  # frames too small for a page: the row is left out
            return {"refused": str(error), "psf": None, "methods": {}, "pictures": {}}
        return self._by_field(field, time.monotonic() - began, shots, "measured")

    def _rival(self, shots: Shots) -> Unit:
        """What the rival makes of the first photo, corrected by our methods."""
        began = time.monotonic()
        try:
            field = Schuler().field([develop(shots.learn[0])])
        except LensModelError as error:
            unit: Unit = {"refused": str(error), "psf": None, "pictures": {}}
            return {**unit, "methods": dict.fromkeys(self.plan.methods, self._before)}
        return self._by_field(field, time.monotonic() - began, shots, "schuler")

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
        chart, photo = develop(shots.chart), develop(shots.held_out)
        for method in self.plan.methods:
            unit["methods"][method], made = self._corrected(chart, photo, field, method, shots, label)
            unit["pictures"] |= made
        return unit

    def _corrected(
        self,
        chart: LinearPhoto,
        photo: LinearPhoto,
        field: PsfField,
        method: str,
        shots: Shots,
        label: str | None,
    ) -> tuple[Unit, dict[str, str]]:
        """Correct and measure chart and photo with a field; the name of the picture, if it has a label."""
        edges, after = (
            corrected_with(seen, field, method, parts, workers=self.workers)
            for seen, parts in ((chart, measure.chart_parts(self.case)), (photo, self._parts))
        )
        name = {} if label is None else {f"{label}-{method}": self._picture(f"{label}-{method}", after)}
        return measure.state(edges, after, shots, self.case), name

    @property
    def _parts(self) -> list[Roi]:
        return measure.parts(self.case.camera.frame)

    def _learned(self, learning: _Learning, shots: Shots, number: str, *, own_way: bool) -> Unit:
        """What is known after so many photos, and what corrections with it come to."""
        case, n = self.case, int(number)
        methods = (PRESETS["paper"].method,) if own_way else self.plan.methods
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
        for method in methods:
            after = learner.corrected(shots.held_out, method, self._parts)
            edges = learner.corrected(shots.chart, method, measure.chart_parts(case)).planes
            state = measure.state(edges, after.planes, shots, case)
            state["nothing_to_correct"] = after.nothing_to_correct
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

    def _picture(self, label: str, planes: Planes, *, raw: bool = True) -> str:
        name = f"{self.folder.name}-{label}.png"
        gains = self.case.camera.white_balance if raw else (1.0, 1.0, 1.0)
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
