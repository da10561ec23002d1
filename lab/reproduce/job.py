"""What a reproduction does for a lens: photograph, learn, correct, measure; nothing stored is computed anew.

Stored for each case, one JSON file each, under a name that hashes all that it depends on::

    <key>/truth.json                  as photographed, with the true PSF
    <key>/learned-<n>.json            after n photos
    <key>/path-<container>.json       learned and corrected as another kind of file
    <key>/paper-<n>.json              the same the paper's own way from end to end
    <key>/measured.json               with PSFs measured on a target
    <key>/general.json                with a general profile of the lens model
    <key>/rival.json                  corrected with the PSFs of a rival (`lab.schuler`), from the first photo

They hold figures only, by the names of states (`cases`), some ten kilobytes a lens. Photos lie in `photos` of
the output folder, pictures in `pictures`.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Final, TypeAlias

from PIL import Image

from lab.cases import photo_half
from lab.images import as_shown, strip
from lab.reproduce import figures, measure
from lab.reproduce.cases import (
    BEFORE,
    GENERAL,
    MEASURED,
    PAPER_WAY,
    RIVAL,
    TRUE,
    Case,
    Reproduction,
    fingerprint,
    key_of,
    learned,
    photos_of,
)
from lab.reproduce.fields import general_field, general_words, measured_field
from lab.reproduce.learners import Learner, Roi, corrected_with, paper_way
from lab.reproduce.shots import Container, Shots, in_container, take
from lab.schuler import Schuler
from lab.stored import Unit, read, stored
from lensmodel.blind.sampling import PRESETS
from lensmodel.core.errors import LensModelError
from lensmodel.core.psf import PsfField
from lensmodel.core.types import Planes
from lensmodel.photo import develop

CROP_PX: Final = 128  # side of a crop in a strip (chosen)

PATHS: Final[tuple[Container, ...]] = ("tiff", "jpeg")
"""Kinds of files that each lens is learned from and corrected in too, one photo of each."""

_PARTS: Final = ("states", "psf", "seconds", "refused", "paths", "pictures")
"""What stored results consist of: figures by state, errors of PSFs, and so on."""

OnWork: TypeAlias = Callable[[str, int, int], None]
"""Takes what was done, and how many of how many results are there."""


def run_reproduction(
    plan: Reproduction, folder: Path, *, on_work: OnWork, workers: int = 1
) -> dict[str, Any]:
    """Run what is missing and return everything."""
    version = fingerprint()
    cache, shown = folder / "cache", folder / "pictures"
    shown.mkdir(parents=True, exist_ok=True)
    jobs = [
        CaseJob(case, plan, cache / key_of(case, plan, version), folder / "photos", shown, workers)
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
        return self.taken / photos_of(self.case, self.plan)

    @cached_property
    def truth(self) -> PsfField:
        """The true PSFs."""
        return self.case.truth()

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
                name = f"{PAPER_WAY}, n = {n}"
                found[f"paper-{n}"] = partial(self._learned, paper, n, name, f"way-paper-n{n}")
            found["measured"] = self._measured
            found["general"] = lambda: self._by_field(general_field(self.case), 0.0, GENERAL, "general")
            found["rival"] = self._rival
        return found

    def run(self, told: Callable[[str], None]) -> Unit:
        """Compute what is missing, and return all of it."""
        case, parts = self.case, Unit({part: {} for part in _PARTS})
        for name, make in self.units.items():
            for part, values in stored(self.folder / f"{name}.json", make).items():
                parts[part] |= values
            told(f"{case.title}: {name}")
        return {
            "name": case.name,
            "title": case.title,
            "family": case.family,
            "unseen": case.unseen,
            "source": case.source,
            "general_profile": general_words(case) if self.plan.compare else "",
            "settings": {k: v for k, v in asdict(case).items() if k not in {"layout", "grid"}},
            **parts,
        }

    def _truth(self) -> Unit:
        shots = self.shots
        photo, chart = develop(shots.held_out).planes, develop(shots.chart).planes
        before = measure.state(chart, photo, shots, self.case)
        before["light"] = measure.light(photo, shots, self.case)
        pictures = {"before": self._picture("before", photo), "scene": self._picture("scene", shots.truth())}
        true = self._corrected(self.truth, TRUE, "true")
        return {"states": {BEFORE: before, **true["states"]}, "pictures": pictures | true["pictures"]}

    def _path(self, container: Container) -> Unit:
        """What becomes of the first and the held-out photo as files of another kind, learned from the one."""
        first, asked = (in_container(p, container) for p in (self.shots.learn[0], self.shots.held_out))
        photo, learner = develop(asked), Learner(PRESETS["default"], self.workers)
        refused = learner.learn([first])
        true = corrected_with(photo, self.truth, self._parts, workers=self.workers)
        after = photo.planes if refused else learner.corrected(asked, self._parts)[0]
        states = {BEFORE: photo.planes, TRUE: true, "after": after}
        made = {name: measure.state(None, v, self.shots, self.case, raw=False) for name, v in states.items()}
        return {
            "paths": {container: made},
            "pictures": {container: self._picture(container, after, raw=False)},
        }

    def _measured(self) -> Unit:
        """What a photo of the printed target makes of the lens: the paper's non-blind calibration."""
        began = time.monotonic()
        try:
            field = measured_field(self.case, self.shots.held_out.with_name("target.dng"))
        except LensModelError as error:  # frames too small for a page: the row is left out
            return {"refused": {MEASURED: [str(error)]}}
        return self._by_field(field, time.monotonic() - began, MEASURED, "measured")

    def _rival(self) -> Unit:
        """What the rival makes of the first photo, corrected by our method."""
        began = time.monotonic()
        try:
            field = Schuler().field(develop(self.shots.learn[0]))
        except LensModelError as error:
            return {"states": {RIVAL: self._before}, "refused": {RIVAL: [str(error)]}}
        return self._by_field(field, time.monotonic() - began, RIVAL, "schuler")

    def _by_field(self, field: PsfField, seconds: float, name: str, label: str) -> Unit:
        """Errors of a PSF field, and what corrections with it come to."""
        answers = [(field.kernel_at(*place, measure.PSF_SIZE), float("nan")) for place in measure.places()]
        return {
            **self._corrected(field, name, label),
            "psf": {name: measure.psf_errors(answers, self.truth)},
            "seconds": {name: round(seconds, 1)},
        }

    def _corrected(self, field: PsfField, name: str, label: str) -> Unit:
        """Correct and measure chart and photo with a field."""
        edges, after = (
            corrected_with(develop(path), field, parts, workers=self.workers)
            for path, parts in (
                (self.shots.chart, measure.chart_parts(self.case)),
                (self.shots.held_out, self._parts),
            )
        )
        return {
            "states": {name: measure.state(edges, after, self.shots, self.case)},
            "pictures": {label: self._picture(label, after)},
        }

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
            "psf": {name: measure.psf_errors(answers, self.truth)},
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
