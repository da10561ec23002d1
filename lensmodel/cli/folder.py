"""`lensmodel correct FOLDER --lens auto`: sort photos by lens, learn each lens, correct what gains."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import typer
from rich.progress import Progress, TaskID

from lensmodel import correction as corrections
from lensmodel import estimation
from lensmodel.cli import calibration, correction
from lensmodel.cli.console import files
from lensmodel.cli.console.display import Display
from lensmodel.cli.console.table import aligned
from lensmodel.cli.grouping import PhotoGroup, Shot, groups
from lensmodel.cli.journal import Journal
from lensmodel.cli.words import gain_words
from lensmodel.core.errors import LensModelError
from lensmodel.core.types import LensSettings
from lensmodel.correction.expected_gain import WORTH_DB
from lensmodel.workflow import pipeline
from lensmodel.workflow.lens import Lens

LEARN_FROM: Final = 8
"""Photos that a group is learned from: five are the advice (docs/guide.md), three more for other
apertures (chosen); each takes about a minute."""

PROFILES: Final = "lenses"
ENDING: Final = ".lensprofile"


@dataclass(frozen=True, slots=True)
class Learning:
    """What the options said of learning.

    Parameters
    ----------
    profiles : Path or None
        Folder of the lens profiles; None is `lenses` in the folder of the corrected photos.
    most : int
        Photos that each group is learned from.
    estimator, selector : str
    """

    profiles: Path | None
    most: int
    estimator: str
    selector: str


@dataclass(frozen=True, slots=True)
class GroupResult:
    """What became of a group of photos; a line of the table."""

    group: PhotoGroup
    profile: Path
    learned: int
    states: Mapping[str, int]
    gains_db: tuple[float, ...]

    @property
    def gain_db(self) -> float | None:
        """Expected gain, the mean over the photos that were corrected in this run."""
        return sum(self.gains_db) / len(self.gains_db) if self.gains_db else None


def run(
    names: Sequence[str],
    output: str | None,
    options: correction.CorrectionOptions,
    learning: Learning,
    display: Display,
    *,
    as_json: bool,
) -> None:
    """Learn the lens of every group of photos and correct them all."""
    paths = files.photos(names)
    targets, twice = correction.targets_of(paths, output, options.file_format)
    with files.as_usage():
        estimation.estimators.create(learning.estimator)
        estimation.patches.selectors.create(learning.selector)
        if options.method is not None:
            corrections.deconvolvers.create(options.method)
        LensSettings(aperture=options.aperture)
    base = next(iter({**targets, **twice})).parent
    options = replace(options, least_gain_db=WORTH_DB)
    work = _Folder(base, learning.profiles or base / PROFILES, options, learning, display)
    shots, failed = _read(list(targets.values()), display)
    results = [*correction.clashes(twice, display), *failed]
    lens_groups = groups(shots)
    by_path = {path: target for target, path in targets.items()}
    with display.progress() as bars:
        for group in lens_groups:
            work.learn(group, bars)
        rows = [work.correct(group, by_path, bars, results, as_json=as_json) for group in lens_groups]
    if as_json:
        display.document({"groups": [_document(row) for row in rows], "results": results})
    else:
        display.result(_table(rows))
    if any(result["state"] == "failed" for result in results):
        raise typer.Exit(1)


def _read(paths: Sequence[Path], display: Display) -> tuple[list[Shot], list[dict[str, Any]]]:
    """Read the headers of the files; those that cannot be read become results."""
    shots: list[Shot] = []
    results: list[dict[str, Any]] = []
    for path in paths:
        try:
            shots.append(Shot.of(path))
        except (LensModelError, OSError) as error:
            results.append({"photo": str(path), "output": None, **files.failed(error)})
            display.error(f"{path}: {files.reason(error)}")
    return shots, results


class _Folder:
    """The work on one folder, and its journal."""

    def __init__(
        self,
        output: Path,
        profiles: Path,
        options: correction.CorrectionOptions,
        learning: Learning,
        display: Display,
    ) -> None:
        self._profiles, self._options, self._learning = profiles, options, learning
        self._display = display
        self._journal = Journal(output)
        self._learned: Counter[tuple[str, str]] = Counter()
        self._calibrations: dict[Path, pipeline.Calibration] = {}

    def profile_of(self, group: PhotoGroup) -> Path:
        """Name the file of a group's lens profile."""
        return self._profiles / f"{group.name}{ENDING}"

    def learn(self, group: PhotoGroup, bars: Progress) -> None:
        """Learn a group's lens from its usable photos, at most as many as the options say."""
        target = self.profile_of(group)
        if target not in self._calibrations:
            self._calibrations[target] = self._calibration(target)
        calibrated = self._calibrations[target]
        counted, most = 0, min(self._learning.most, group.scenes)
        task = bars.add_task(f"learning {group.lens}", total=most)
        for shot in group.to_learn_from():
            if counted == most:
                break
            if self._learns(calibrated, shot, partial(_learning, bars, task, counted)):
                counted += 1
                bars.update(task, completed=counted)
        if not counted:
            self._display.note(f"{group.lens}, {group.focal}: no photo shows enough to learn its blur from")
        bars.remove_task(task)
        self._learned[group.name, group.focal] = counted

    def _calibration(self, target: Path) -> pipeline.Calibration:
        options = calibration.CalibrationOptions(
            aperture=self._options.aperture,
            estimator=self._learning.estimator,
            workers=self._options.workers,
            any_lens=self._options.any_lens,
            force=False,
            selector=self._learning.selector,
        )
        return calibration.calibration_of(target, options)

    def _learns(self, calibrated: pipeline.Calibration, shot: Shot, on_event: pipeline.EventHook) -> bool:
        """Learn from one photo; return whether it counts, now or from an earlier run."""
        photo = pipeline.photo_id(shot.path)
        learning, options = self._learning, self._options
        under = (
            f"{learning.estimator}, {learning.selector}, aperture {options.aperture}, any {options.any_lens}"
        )
        refused = self._journal.verdict("not learned from", photo, under)
        if refused is not None:
            self._display.detail(f"{shot.path}: {refused}")
            return False
        try:
            calibrated.add(shot.path, on_event=on_event)
        except LensModelError as error:
            self._journal.note("not learned from", photo, under, str(error))
            self._display.detail(f"{shot.path}: {error}")
            return False
        except OSError as error:  # another time it may be readable
            self._display.detail(f"{shot.path}: {files.reason(error)}")
            return False
        return True

    def correct(
        self,
        group: PhotoGroup,
        targets: Mapping[Path, Path],
        bars: Progress,
        results: list[dict[str, Any]],
        *,
        as_json: bool,
    ) -> GroupResult:
        """Correct the photos of a group that gain from it; leave the others."""
        profile = self.profile_of(group)
        lens = Lens(files.profile_at(profile)) if profile.exists() else None
        states: Counter[str] = Counter()
        gains: list[float] = []
        task = bars.add_task(f"correcting {group.lens}", total=len(group.shots))
        for number, shot in enumerate(group.shots):
            bars.update(task, description=f"correcting {shot.path.name}")
            target = targets[shot.path]
            result = self._correct_shot(
                shot, target, lens, partial(correction.show_share, bars, task, number)
            )
            states[result["state"]] += 1
            self._say(shot.path, target, result, as_json=as_json)
            if result["state"] == "corrected":
                gains.append(result["expected_gain_db"])
            results.append({"photo": str(shot.path), "output": str(target), **result})
            bars.update(task, completed=number + 1)
        bars.remove_task(task)
        return GroupResult(group, profile, self._learned[group.name, group.focal], states, tuple(gains))

    def _correct_shot(
        self, shot: Shot, target: Path, lens: Lens | None, on_step: Callable[[int, int], None]
    ) -> dict[str, Any]:
        if lens is None:
            return {"state": "left", "reason": "its lens could not be learned from these photos"}
        photo = pipeline.photo_id(shot.path)
        samples = len(lens.profile.model.samples)
        options = self._options
        under = (
            f"{target.name}, {samples} samples, {options.method or 'standard'}, "
            f"strength {options.strength:g}, {options.bounds}, aperture {options.aperture}"
        )
        known = self._journal.verdict("left", photo, under)
        if known is not None and not self._options.force:
            return {"state": "left", "reason": known}
        settings = LensSettings(aperture=self._options.aperture)
        try:
            result = correction.correct_one(
                shot.path, target, lens, settings, self._options, self._display, on_step
            )
        except (LensModelError, OSError) as error:
            return files.failed(error)
        if result["state"] == "left":
            result["reason"] = "next to nothing would be gained"
            self._journal.note("left", photo, under, result["reason"])
        return result

    def _say(self, path: Path, target: Path, result: Mapping[str, Any], *, as_json: bool) -> None:
        if result["state"] == "failed":
            self._display.error(f"{path}: {result['reason']}")
        elif result["state"] == "left":
            self._display.detail(f"{path}: left as it is, {result['reason']}")
        elif result["state"] == "kept":
            self._display.detail(f"{target} is there already and was left alone; --force replaces it")
        else:
            if not as_json:
                self._display.detail(f"{target}: {gain_words(result['expected_gain_db'])} expected")
            for line in correction.remarks(result):
                self._display.detail(f"{path.name}, {line}")


def _learning(bars: Progress, task: TaskID, number: int, event: pipeline.CalibrationEvent) -> None:
    share = event.done / event.total if event.total else 0.0
    bars.update(
        task, description=f"learning from {event.photo.name}: {event.stage}", completed=number + share
    )


def _document(row: GroupResult) -> dict[str, Any]:
    return {
        "camera": row.group.camera,
        "lens": row.group.lens,
        "focal_length": row.group.focal,
        "profile": str(row.profile) if row.profile.exists() else None,
        "photos": len(row.group.shots),
        "learned_from": row.learned,
        "corrected": row.states.get("corrected", 0),
        "corrected_before": row.states.get("kept", 0),
        "left": row.states.get("left", 0),
        "failed": row.states.get("failed", 0),
        "expected_gain_db": row.gain_db,
    }


def _table(rows: Sequence[GroupResult]) -> str:
    head = [
        *("camera", "lens", "focal length", "photos", "learned from", "corrected", "left", "failed"),
        "expected gain",
    ]
    lines = [
        [
            row.group.camera,
            row.group.lens,
            row.group.focal,
            str(len(row.group.shots)),
            str(row.learned),
            str(row.states.get("corrected", 0) + row.states.get("kept", 0)),
            str(row.states.get("left", 0)),
            str(row.states.get("failed", 0)),
            "" if row.gain_db is None else gain_words(row.gain_db),
        ]
        for row in rows
    ]
    return aligned(head, lines, numbers=range(3, 9))
