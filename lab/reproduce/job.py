"""What a reproduction does for a lens: photograph, learn, correct, measure; nothing stored is computed anew.

Each result (`CaseJob.units`) is a JSON file of figures by states, in a folder whose name hashes all that it
depends on. Photos lie in `photos` of the output folder, pictures in `pictures`.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from PIL import Image

from lab.cases import photo_half
from lab.images import as_shown, strip
from lab.reproduce import cases, figures, measure
from lab.reproduce.cases import BEFORE, Case, Container, Reproduction, Shots, learned, take
from lab.reproduce.fields import general_field, general_words, measured_field
from lab.reproduce.measure import Place, Roi
from lab.schuler import Schuler
from lab.stored import Unit, read, stored, version_of
from lensmodel import api
from lensmodel.blind import sampling
from lensmodel.blind.sampling import PRESETS, Config
from lensmodel.core.errors import LensModelError
from lensmodel.core.psf import PsfField
from lensmodel.core.types import Kernel, LensSettings, Planes
from lensmodel.correction import correct_planes
from lensmodel.model import LensModel
from lensmodel.photo import LinearPhoto, develop

CROP_PX: Final = 128  # side of a crop in a strip (chosen)

PATHS: Final[tuple[Container, ...]] = ("tiff", "jpeg")  # that each lens is learned from and corrected in too
_PARTS: Final = ("states", "psf", "seconds", "refused", "paths", "pictures")  # of stored results
_SMALL_FRAME: Final = 2e6  # pixels (chosen): below, the paper's way takes kernels of the default's size

OnWork: TypeAlias = Callable[[str, int, int], None]  # takes what was done, and how many of how many


def run_reproduction(
    plan: Reproduction, folder: Path, *, on_work: OnWork, workers: int = 1
) -> dict[str, Any]:
    """Run what is missing and return everything."""
    version = version_of(__name__)
    cache, shown = folder / "cache", folder / "pictures"
    shown.mkdir(parents=True, exist_ok=True)
    jobs = [
        CaseJob(case, plan, cache / cases.key_of(case, plan, version), folder / "photos", shown, workers)
        for case in plan.cases
    ]
    done, total = 0, sum(len(job.units) for job in jobs) + plan.compare

    def told(words: str) -> None:
        nonlocal done
        done += 1
        on_work(words, done, total)

    finished = [job.run(told) for job in jobs]
    drawn: Unit = {}
    if plan.compare:
        # of all lenses: another choice of them has figures of its own, stored beside their pictures
        whole = hashlib.sha256(" ".join(job.folder.name for job in jobs).encode()).hexdigest()[:12]
        make = partial(figures.draw, plan, jobs[0].photos, shown, whole, workers=workers)
        drawn = stored(shown / f"{whole}-figures.json", make)
        told("figures 2 and 4")
    files = plan.files()
    return {
        "code": version,
        "plan": {"size": plan.size, "own_scenes": plan.scenes is None},
        "scenes": [path.stem for path in files],
        "developed_on": [path.stem for path in files if photo_half(path.stem) == "dev"],
        "cases": finished,
        "figures": drawn,
    }


@dataclass(frozen=True)
class CaseJob:
    """One case of a reproduction."""

    case: Case
    plan: Reproduction
    folder: Path
    taken: Path  # where photos of all cases lie
    shown: Path
    workers: int

    @property
    def photos(self) -> Path:
        """Folder of its photos."""
        return self.taken / cases.photos_of(self.case, self.plan)

    @cached_property
    def shots(self) -> Shots:
        """Its photos, taken where they are missing."""
        return take(self.case, self.plan.files(), self.photos)

    @cached_property
    def units(self) -> dict[str, Callable[[], Unit]]:
        """What makes each result of the case, by the name that it is stored under."""
        default, paper = (Learner(way, self.workers) for way in (PRESETS["default"], paper_way(self.case)))
        found: dict[str, Callable[[], Unit]] = {"truth": self._truth}
        for n in self.case.photos:
            found[f"learned-{n}"] = partial(self._learned, default, n, learned(n), f"n{n}")
        found |= {f"path-{name}": partial(self._path, name) for name in PATHS}
        if self.plan.compare:
            for n in self.case.photos:
                name = f"{cases.PAPER_WAY}, {learned(n)}"
                found[f"paper-{n}"] = partial(self._learned, paper, n, name, f"way-paper-n{n}")
            found["measured"] = self._measured
            found["general"] = lambda: self._by_field(general_field(self.case), 0.0, cases.GENERAL, "general")
            found["rival"] = self._rival
        return found

    def run(self, told: Callable[[str], None]) -> Unit:
        """Compute what is missing, and return all of it."""
        case, parts = self.case, Unit({part: {} for part in _PARTS})
        for name, make in self.units.items():
            for part, values in stored(self.folder / f"{name}.json", make).items():
                parts[part] |= values
            told(f"{case.title}: {name}")
        told_of = ("name", "title", "family", "unseen", "source")
        return {
            **{name: getattr(case, name) for name in told_of},
            "general_profile": general_words(case) if self.plan.compare else "",
            "settings": {
                **asdict(case.settings),
                "seed": case.seed,
                "height": case.height,
                "width": case.width,
            },
            **parts,
        }

    def _truth(self) -> Unit:
        shots = self.shots
        photo, chart = develop(shots.held_out).planes, develop(shots.chart).planes
        before = measure.state(chart, photo, shots, self.case)
        before["light"] = measure.light(photo, shots, self.case)
        pictures = {"before": self._picture("before", photo), "scene": self._picture("scene", shots.truth())}
        true = self._corrected(self.case.truth(), cases.TRUE, "true")
        return {"states": {BEFORE: before, **true["states"]}, "pictures": pictures | true["pictures"]}

    def _path(self, container: Container) -> Unit:
        """What becomes of the first and the held-out photo as files of another kind, learned from the one."""
        first, asked = (cases.in_container(p, container) for p in (self.shots.learn[0], self.shots.held_out))
        photo, learner = develop(asked), Learner(PRESETS["default"], self.workers)
        refused = learner.learn([first])
        true = corrected_with(photo, self.case.truth(), self._parts, workers=self.workers)
        after = photo.planes if refused else learner.corrected(asked, self._parts)[0]
        states = {BEFORE: photo.planes, cases.TRUE: true, "after": after}
        made = {name: measure.state(None, v, self.shots, self.case, raw=False) for name, v in states.items()}
        picture = self._picture(container, after, raw=False)
        return {"paths": {container: made}, "pictures": {container: picture}}

    def _measured(self) -> Unit:
        """What a photo of the printed target makes of the lens: the paper's non-blind calibration."""
        began = time.monotonic()
        try:
            field = measured_field(self.case, self.shots.held_out.with_name("target.dng"))
        except LensModelError as error:  # frames too small for a page: the row is left out
            return {"refused": {cases.MEASURED: [str(error)]}}
        return self._by_field(field, time.monotonic() - began, cases.MEASURED, "measured")

    def _rival(self) -> Unit:
        """What the rival makes of the first photo, corrected by our method."""
        began = time.monotonic()
        try:
            field = Schuler().field(develop(self.shots.learn[0]))
        except LensModelError as error:
            return {"states": {cases.RIVAL: self._before}, "refused": {cases.RIVAL: [str(error)]}}
        return self._by_field(field, time.monotonic() - began, cases.RIVAL, "schuler")

    def _by_field(self, field: PsfField, seconds: float, name: str, label: str) -> Unit:
        """Errors of a PSF field, and what corrections with it come to."""
        answers = [(field.kernel_at(*place, measure.PSF_SIZE), float("nan")) for place in measure.places()]
        return {
            **self._corrected(field, name, label),
            "psf": {name: measure.psf_errors(answers, self.case.truth())},
            "seconds": {name: round(seconds, 1)},
        }

    def _corrected(self, field: PsfField, name: str, label: str) -> Unit:
        """Correct and measure chart and photo with a field."""
        photos = (self.shots.chart, measure.chart_parts(self.case)), (self.shots.held_out, self._parts)
        edges, after = (corrected_with(develop(p), field, parts, workers=self.workers) for p, parts in photos)
        state = measure.state(edges, after, self.shots, self.case)
        return {"states": {name: state}, "pictures": {label: self._picture(label, after)}}

    @property
    def _parts(self) -> list[Roi]:
        return measure.parts(self.case.camera.frame)

    def _learned(self, learner: Learner, n: int, name: str, label: str) -> Unit:
        """What is known after so many photos, and what corrections with it come to."""
        case, shots = self.case, self.shots
        refused = learner.learn(shots.learn[:n])
        unit: Unit = {"seconds": {name: round(learner.seconds, 1)}, "refused": {name: refused}}
        if n == len(refused):  # no model: a user gets no correction, so the photos stay as they are
            return {**unit, "states": {name: self._before}}
        after, expected = learner.corrected(shots.held_out, self._parts)
        edges, _ = learner.corrected(shots.chart, measure.chart_parts(case))
        state = measure.state(edges, after, shots, case)
        made = measure.light(after, shots, case)
        state["forecast"] = measure.forecast(self._before["light"], made, expected)
        answers = learner.answers(measure.places(), case.settings, measure.PSF_SIZE)
        return {
            **unit,
            "states": {name: state},
            "psf": {name: measure.psf_errors(answers, self.case.truth())},
            "pictures": {label: self._picture(label, after)},
        }

    @property
    def _before(self) -> Unit:
        state: Unit = read(self.folder / "truth.json")["states"][BEFORE]
        return state

    def _picture(self, label: str, planes: Planes, *, raw: bool = True) -> str:
        name = f"{self.folder.name}-{label}.png"
        gains = self.case.camera.white_balance if raw else (1.0, 1.0, 1.0)
        crops = strip(as_shown(planes, gains), CROP_PX)
        Image.fromarray(crops).save(self.shown / name, optimize=True)
        return name


def paper_way(case: Case) -> Config:
    """Return the paper's own way from end to end, as it suits the frames of a case."""
    if case.height * case.width >= _SMALL_FRAME:
        return PRESETS["paper"]
    return replace(PRESETS["paper"], kernel_size=sampling.DEFAULT_KERNEL_SIZE)


class Learner:
    """One lens that learns from photos by a preset, answers for its PSF, and corrects photos."""

    def __init__(self, way: Config, workers: int) -> None:
        self.seconds = 0.0  # that learning took
        self._way, self._workers = way, workers
        self._seen: dict[str, str] = {}  # why photos did not count, by their identity
        self.model: LensModel | None = None  # None until a photo has counted

    def learn(self, photos: Sequence[Path]) -> list[str]:
        """Learn from photos that are new; say which of all did not count, and why."""
        began, refused = time.monotonic(), []
        for photo in photos:
            name = sampling.photo_id(photo)
            if name not in self._seen:
                self._seen[name] = self._learned(photo)
            if self._seen[name]:
                refused.append(f"{photo.stem}: {self._seen[name]}")
        self.seconds += time.monotonic() - began
        return refused

    def _learned(self, photo: Path) -> str:
        try:
            samples = sampling.samples_of_photo(photo, self._way, workers=self._workers)
        except LensModelError as error:
            return str(error)
        self.model = (
            LensModel.fit(samples, self._way.model) if self.model is None else self.model.added(samples)
        )
        return ""

    def answers(
        self, places: Sequence[Place], settings: LensSettings, size: int
    ) -> list[tuple[Kernel, float]]:
        """Return the PSFs at some places, and the relative L2 error that the model expects of each."""
        assert self.model is not None, "only asked after a photo has counted"
        found = [self.model.query(place, settings.with_channel(channel), size) for place, channel in places]
        return [(answer.kernel, answer.predicted_error) for answer in found]

    def corrected(self, photo: Path, parts: Sequence[Roi]) -> tuple[Planes, Mapping[str, float | None]]:
        """Correct parts of a photo; also the expected gain in PSNR by zone, mean over the parts."""
        assert self.model is not None, "only asked after a photo has counted"
        developed = develop(photo)
        settings = developed.info.metadata.settings()
        field = api.psfs_for(developed, self.model, settings, method=self._way.method)
        lateral = api.lateral_of(developed)
        planes, said = developed.planes.copy(), dict[str, list[float | None]]()
        for roi in parts:
            done = api.correct_photo(
                developed, self.model, settings, method=self._way.method, lateral=lateral, known=field,
                roi=roi, workers=self._workers,
            )  # fmt: skip
            planes[_inside(roi)] = done.planes
            for zone, report in done.zones.items():
                said.setdefault(zone, []).append(report.expected_gain_db)
        expected = {
            zone: None if None in told else float(np.mean([v for v in told if v is not None]))
            for zone, told in said.items()
        }
        return planes, expected


def corrected_with(
    developed: LinearPhoto, field: PsfField, parts: Sequence[Roi], *, workers: int = 1
) -> Planes:
    """Correct parts of a photo with a PSF field taken as right, as a learner does with its own."""
    lateral, made = api.lateral_of(developed), developed.planes.copy()
    for roi in parts:
        made[_inside(roi)] = correct_planes(
            developed.planes, field, developed.frame, method="standard", noise=developed.correction_noise,
            clip=developed.clip, lateral=lateral, cfa=developed.cfa, roi=roi, workers=workers,
        ).planes  # fmt: skip
    return made


def _inside(roi: Roi) -> tuple[slice, slice, slice]:
    row, col, height, width = roi
    return slice(None), slice(row, row + height), slice(col, col + width)
