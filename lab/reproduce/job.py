"""One case of a reproduction: take its photos, learn, correct, measure; keep every result."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from lab.figure_parts import strip
from lab.reproduce import measure, programs
from lab.reproduce.cases import Case, Reproduction
from lab.reproduce.general import general_field, general_key, general_words
from lab.reproduce.measured import measured_field, photograph_target
from lab.reproduce.progress import (
    CORRECT,
    LEARN,
    MEASURE,
    PAPER_CORRECT,
    PAPER_LEARN,
    PROGRAM,
    RIVAL,
    SHOT,
    Progress,
    corrections,
    methods_of,
    programs_of,
    rivals_of,
    weight_of,
    with_general,
    with_paper,
    with_target,
)
from lab.reproduce.routes import (
    Answer,
    DirectRoute,
    OpenRoute,
    PointField,
    Remembered,
    Route,
    corrected_with,
    paper_way,
)
from lab.reproduce.shots import Shots, take
from lab.reproduce.store import Unit, read, stored
from lab.rivals import rivals
from lensmodel.core.errors import LensModelError
from lensmodel.core.psf import PsfField
from lensmodel.core.types import Planes
from lensmodel.photo import LinearPhoto, develop
from lensmodel.quality import images
from lensmodel.workflow.ways import WAYS

CROP_PX = 128  # side of a crop in a strip (chosen)
_ALONE = ("truth", "measured", "general")
CONTROL = "standard"
"""Method whose denoising alone is the control."""


@dataclass(frozen=True, slots=True)
class CaseJob:
    """One case; `truth` keeps the kernels that were asked for, which are slow to make."""

    case: Case
    truth: PsfField
    plan: Reproduction
    open_route: OpenRoute
    folder: Path
    work: Path
    shown: Path
    progress: Progress
    workers: int
    rival_code: str

    @property
    def methods(self) -> tuple[str, ...]:
        """Non-blind methods of this case."""
        return methods_of(self.case, self.plan)

    def run(self) -> Unit:
        """Compute what is missing, and return all of it."""
        case, files = self.case, self._files()
        every = [path for part in files.values() for path in part.values()]
        if all(path.exists() for path in every):
            self.progress.tell(f"{case.title}: stored", weight_of(case, self.plan), fresh=False)
        else:
            shots = self._shots(self.work / "photos")
            for path in files["truth"].values():
                self._truth(path, shots)
            for path in files["measured"].values():
                self._target(path, shots)
            if all(path.exists() for path in files["learned"].values()):
                self.progress.tell(f"{case.title}: learned before", self._learning(), fresh=False)
            else:
                with self.open_route(case, self.work) as route:
                    self._learned(route, shots, files["learned"])
            self._paper(shots, files["paper"])
            for path in files["general"].values():
                self._general(path, shots)
            self._beside(files["rivals"], shots)
            self._programs(files["programs"], shots)
            shutil.rmtree(self.work)
        units = {
            part: {name: read(path) for name, path in paths.items() if part != "programs" or path.exists()}
            for part, paths in files.items()
        }
        return {
            "name": case.name,
            "title": case.title,
            "family": case.family,
            "unseen": case.unseen,
            "source": case.source,
            "general_profile": general_words(case) if with_general(case, self.plan) else "",
            "kind": case.lens.model.split()[1].lower(),
            "condition": case.condition,
            "condition_title": case.conditions.title,
            "settings": {k: v for k, v in asdict(case).items() if k not in {"layout", "grid"}},
            "stops": case.stops,
            "frames": case.layout.words(),
            **{name: units[name][""] if units[name] else None for name in _ALONE},
            **{name: units[name] for name in units if name not in _ALONE},
        }

    def _files(self) -> dict[str, dict[str, Path]]:
        """Where each unit of the case is stored, by part of the result and name in it."""
        case, plan, folder = self.case, self.plan, self.folder
        program = programs.version()
        counts = [str(n) for n in case.photos]
        return {
            "truth": {"": folder / "truth.json"},
            "measured": {"": folder / "measured.json"} if with_target(case, plan) else {},
            "general": {"": folder / f"general{general_key(case)}.json"} if with_general(case, plan) else {},
            "learned": {n: folder / f"learned-{n}.json" for n in counts},
            "paper": {n: folder / f"paper-{n}.json" for n in counts} if with_paper(case, plan) else {},
            "rivals": {
                name: folder / f"rival-{name}-{self.rival_code}.json" for name in rivals_of(case, plan)
            },
            "programs": {
                name: folder / f"program-{programs.label_of(name)}-{program}.json"
                for name in programs_of(case, plan)
            },
        }

    def _learning(self) -> float:
        return self.case.photos[-1] * LEARN + len(self.case.photos) * corrections(self.case, self.plan)

    def _shots(self, folder: Path) -> Shots:
        total = (self.case.photos[-1] + 2) * SHOT
        reported = 0.0

        def on_step(done: int, count: int) -> None:
            nonlocal reported
            share = total * done / count
            self.progress.tell(f"{self.case.title}: photo {done} of {count} taken", share - reported)
            reported = share

        shots = take(self.case, self.plan.files(), folder, workers=self.workers, on_step=on_step)
        self.progress.tell(f"{self.case.title}: photos are there", total - reported, fresh=reported > 0)
        return shots

    def _truth(self, path: Path, shots: Shots) -> None:
        weight = corrections(self.case, self.plan) + 2 * CORRECT
        _, fresh = stored(path, lambda: self._measured_truth(shots))
        self.progress.tell(f"{self.case.title}: with the true PSF", weight, fresh=fresh)

    def _target(self, path: Path, shots: Shots) -> None:
        weight = MEASURE + corrections(self.case, self.plan)
        _, fresh = stored(path, lambda: self._measured_by_target(shots))
        self.progress.tell(f"{self.case.title}: measured with a target", weight, fresh=fresh)

    def _measured_by_target(self, shots: Shots) -> Unit:
        """What a photo of the printed target makes of the lens: the paper's non-blind calibration."""
        page = self.work / "target.dng"
        try:
            photograph_target(self.case, page)
            began = time.monotonic()
            field = measured_field(self.case, page)
        except LensModelError as error:  # frames too small for a page: the row is left out
            return {"refused": str(error), "psf": None, "methods": {}, "pictures": {}}
        return self._by_field(field, time.monotonic() - began, shots, "measured")

    def _general(self, path: Path, shots: Shots) -> None:
        weight = MEASURE + corrections(self.case, self.plan)
        make = partial(self._by_field, general_field(self.case), 0.0, shots, "general")
        _, fresh = stored(path, make)
        self.progress.tell(f"{self.case.title}: with a general profile", weight, fresh=fresh)

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

    def _measured_truth(self, shots: Shots) -> Unit:
        case = self.case
        chart = None if shots.chart is None else develop(shots.chart)
        photo = develop(shots.held_out)
        before = measure.state(None if chart is None else chart.planes, photo.planes, shots, case)
        unit: Unit = {
            "before": {**before, "light": measure.light(photo.planes, shots, case)} if self._raw else before,
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

    def _as_photo(self, planes: Planes) -> Planes:
        """Planes of the sensor as the photo's file has them: white-balanced where it is not raw."""
        if self._raw:
            return planes
        return planes * np.asarray(self.case.camera.white_balance, dtype=np.float32)[:, None, None]

    def _beside(self, targets: Mapping[str, Path], shots: Shots) -> None:
        weight = RIVAL + corrections(self.case, self.plan)
        for name, path in targets.items():
            _, fresh = stored(path, partial(self._measured_rival, name, shots))
            self.progress.tell(f"{self.case.title}: rival {name}", weight, fresh=fresh)

    def _measured_rival(self, name: str, shots: Shots) -> Unit:
        """What a rival makes of the first photo, corrected by our methods."""
        began = time.monotonic()
        try:
            field = rivals.create(name).field([develop(shots.learn[0])])
        except LensModelError as error:
            before = read(self.folder / "truth.json")["before"]
            unit: Unit = {"refused": str(error), "psf": None, "pictures": {}}
            return {**unit, "methods": dict.fromkeys(self.methods, before)}
        return self._by_field(field, time.monotonic() - began, shots, name)

    def _programs(self, targets: Mapping[str, Path], shots: Shots) -> None:
        for name, path in targets.items():
            words, fresh = f"{self.case.title}: {name}", True
            try:
                _, fresh = stored(path, partial(self._measured_program, name, shots))
            except (
                LensModelError
            ) as error:  # of another program: the page goes without, the next run tries again
                words = f"{words} left out: {error}"
            self.progress.tell(words, PROGRAM, fresh=fresh)

    def _measured_program(self, name: str, shots: Shots) -> Unit:
        """What a program of others makes of chart and photo, at its best setting."""
        peer, gains = programs.named(name), self.case.camera.white_balance
        photo = develop(shots.held_out).planes
        setting, after = programs.best_setting(peer, photo, shots.truth(), gains)
        chart = None if shots.chart is None else develop(shots.chart).planes
        edges = None if chart is None else programs.corrected_by(peer, chart, setting, gains)
        label = programs.label_of(name)
        return {
            "setting": setting,
            "state": measure.state(edges, after, shots, self.case, before=chart),
            "pictures": {label: self._picture(label, after)},
        }

    def _paper(self, shots: Shots, targets: Mapping[str, Path]) -> None:
        """Learn and correct the paper's own way from end to end, in the library."""
        if not targets:
            return
        weight = self.case.photos[-1] * PAPER_LEARN + len(targets) * PAPER_CORRECT
        if all(path.exists() for path in targets.values()):
            self.progress.tell(f"{self.case.title}: the paper's way, stored", weight, fresh=False)
            return
        route = DirectRoute(self.work / "paper", workers=self.workers, way=paper_way(self.case))
        self._learned(route, shots, targets, own_way=True)

    def _learned(
        self, route: Route, shots: Shots, targets: Mapping[str, Path], *, own_way: bool = False
    ) -> None:
        refused: list[str] = []
        learn = PAPER_LEARN if own_way else LEARN
        weight = PAPER_CORRECT if own_way else corrections(self.case, self.plan)
        said, seen = "the paper's way, " if own_way else "", 0
        for number, path in targets.items():
            n, began = int(number), time.monotonic()
            for photo in shots.learn[seen:n]:
                if reason := route.learn(photo):
                    refused.append(f"{photo.stem}: {reason}")
                self.progress.tell(f"{self.case.title}: {said}learned from {photo.stem}", learn)
            seconds = time.monotonic() - began
            make = partial(self._measured, route, shots, n, tuple(refused), seconds, own_way)
            _, fresh = stored(path, make)
            self.progress.tell(f"{self.case.title}: {said}measured after {n}", weight, fresh=fresh)
            seen = n

    def _measured(
        self, route: Route, shots: Shots, n: int, refused: Sequence[str], seconds: float, own_way: bool
    ) -> Unit:
        case, methods = self.case, (WAYS["paper"].method,) if own_way else self.methods
        label = f"way-paper-n{n}" if own_way else f"n{n}"
        unit: Unit = {
            "photos": n,
            "counted": n - len(refused),
            "refused": list(refused),
            "learning_seconds": round(seconds, 1),
            "pictures": {},
        }
        before = read(self.folder / "truth.json")["before"]
        if n == len(refused):
            # no model: a user gets no correction, so the photos stay as they are
            return {**unit, "psf": None, "methods": dict.fromkeys(methods, before)}
        unit["methods"] = {}
        chart = None if shots.chart is None else develop(shots.chart).planes
        for method in methods:
            after = route.corrected(shots.held_out, method)
            edges = None if shots.chart is None else route.corrected(shots.chart, method).planes
            state = measure.state(edges, after.planes, shots, case, before=chart)
            state["nothing_to_correct"] = after.nothing_to_correct
            if self._raw:
                light = before["light"]
                state["forecast"] = measure.forecast(light, after.planes, after.expected_db, shots, case)
            unit["methods"][method] = state
            unit["pictures"][f"{label}-{method}"] = self._picture(f"{label}-{method}", after.planes)
        # not before: until a correction, or its own leisure, has fitted the model, a service answers in part
        answers = route.answers(measure.places(), case.settings, measure.PSF_SIZE)
        unit["psf"] = measure.psf_errors(answers, self.truth)
        return unit

    @property
    def _raw(self) -> bool:
        return self.case.conditions.container == "dng"

    def _picture(self, label: str, planes: Planes) -> str:
        name = f"{self.folder.name}-{label}.png"
        gains = self.case.camera.white_balance if self._raw else (1.0, 1.0, 1.0)
        crops = strip(images.as_shown(planes, gains), CROP_PX)
        Image.fromarray(crops).save(self.shown / name, optimize=True)
        return name
