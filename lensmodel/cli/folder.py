"""`lensmodel correct FOLDER --lens auto`: sort photos by lens, learn each lens, correct what gains.

What a run found out and need not find out again is kept in a small JSON file beside its results.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any, Final

from rich.progress import TaskID

from lensmodel.cli import calibrate, files, outputs
from lensmodel.cli.console import Display, PacedProgress, aligned, gain_words, show_share
from lensmodel.core.errors import LensModelError, NotEnoughEvidenceError, UnreadablePhotoError
from lensmodel.core.files import atomic
from lensmodel.core.names import camera_name, name_key, serial_key
from lensmodel.core.types import LensSettings
from lensmodel.photo import inspect
from lensmodel.photo.values import PhotoMetadata
from lensmodel.workflow import calibrating, sampling
from lensmodel.workflow.calibrating import Identity
from lensmodel.workflow.correcting import SEEN_DB
from lensmodel.workflow.lens import Lens

# Photos that a group is learned from: five are the advice (docs/guide.md), three more for other apertures
# (chosen); each takes about a minute
LEARN_FROM: Final = 8
# Expected error of the PSFs from which on a small gain is for want of knowledge (chosen)
_UNSURE: Final = 0.5
_SAID: Final = 3  # photos of a group that are left for one reason and named (chosen); -v names all
PROFILES: Final = "lenses"
ENDING: Final = ".lensprofile"


class Folder:
    """The work on one folder, and its journal.

    Corrected photos go to `output`, lens profiles to `profiles`; each group is learned from `most` photos.
    """

    def __init__(
        self,
        output: Path,
        profiles: Path,
        most: int,
        options: outputs.CorrectionOptions,
        display: Display,
    ) -> None:
        self._profiles, self._most, self._display = profiles, most, display
        self._options = replace(options, least_gain_db=SEEN_DB)
        self._journal = Journal(output)
        self._learned: Counter[tuple[str, str]] = Counter()
        self._calibrations: dict[Path, calibrating.Calibration] = {}
        self._refused: dict[Path, LensModelError | OSError] = {}  # photos that taught nothing, and why

    def correct(self, targets: Mapping[Path, Path], *, as_json: bool) -> dict[str, Any]:
        """Learn the lens of every group of photos, correct those that gain, and tell what became of each.

        Photos are given by the file that each becomes.
        """
        shots: list[Shot] = []
        results: list[dict[str, Any]] = []
        for path in targets.values():
            try:
                shots.append(Shot.of(path))
            except (LensModelError, OSError) as error:
                results.append({"photo": str(path), "output": None, **files.failed(error)})
                self._display.error(f"{path}: {files.reason(error)}")
        lens_groups, unread = groups(shots), len(results)
        most = [min(self._most, group.scenes) for group in lens_groups]
        with self._display.progress() as bars:
            task = bars.add_task("learning", total=sum(most) + len(shots))
            self._learn_all(lens_groups, most, bars, task)
            by_path = {path: target for target, path in targets.items()}
            rows = self._correct_all(lens_groups, by_path, bars, task, sum(most), results, as_json=as_json)
        if not as_json:
            self._display.result(_table(rows))
            self._say_more(rows, unread, {target.parent for target in targets})
        return {"groups": rows, "results": results}

    def _say_more(self, rows: Sequence[Mapping[str, Any]], unread: int, folders: Iterable[Path]) -> None:
        """Say what the table does not: what was not read, which lens is little known, and where files are."""
        if unread:
            self._display.note(f"not in the table: files that could not be read, {unread}; see above why")
        for row in rows:
            if row["learned_from"] == 1:
                self._display.note(
                    f"{row['camera']}, {row['lens']}: learned from one photo; with five or more its blur is "
                    "known better, and scenes do not pass for it"
                )
        if any(row["corrected"] for row in rows):
            where = ", ".join(str(folder) for folder in sorted(set(folders)))
            self._display.note(f"corrected photos are in {where}, lens profiles in {self._profiles}")

    def _profile_of(self, group: PhotoGroup) -> Path:
        return self._profiles / f"{group.name}{ENDING}"

    def _learn_all(
        self, lens_groups: Sequence[PhotoGroup], most: Sequence[int], bars: PacedProgress, task: TaskID
    ) -> None:
        """Learn the lenses of all groups from their usable photos, `most` of each."""
        for number, group in enumerate(lens_groups):
            target = self._profile_of(group)
            if target not in self._calibrations:
                self._calibrations[target] = calibrating.Calibration(
                    calibrate.ProfileFile(target),
                    sampling.Config(LensSettings(aperture=self._options.aperture)),
                    any_lens=self._options.any_lens,
                )
            self._learn(group, self._calibrations[target], most[number], bars, task, sum(most[:number]))

    def _learn(
        self,
        group: PhotoGroup,
        calibration: calibrating.Calibration,
        most: int,
        bars: PacedProgress,
        task: TaskID,
        before: int,
    ) -> None:
        counted = 0
        for shot in group.to_learn_from():
            if counted == most:
                break
            on_event = partial(_learning, bars, task, before + counted)
            counted += self._learns(calibration, shot, group, on_event)
        bars.update(task, completed=before + most, more=True)
        refused = [self._refused.get(shot.path) for shot in group.shots]
        if not counted and all(isinstance(error, NotEnoughEvidenceError) for error in refused):
            reasons = set(map(str, refused))
            why = f" ({reasons.pop()})" if len(reasons) == 1 else ""
            self._display.note(
                f"{group.lens}, {group.focal}: no photo shows enough to learn its blur from{why}"
            )
        self._learned[group.name, group.focal] = counted

    def _learns(
        self,
        calibrated: calibrating.Calibration,
        shot: Shot,
        group: PhotoGroup,
        on_event: sampling.EventHook,
    ) -> bool:
        """Learn from one photo; return whether it counts, now or from an earlier run."""
        photo = sampling.photo_id(shot.path)
        under = f"aperture {self._options.aperture}, any {self._options.any_lens}"
        known = self._journal.verdict("not learned from", photo, under)
        if known is not None:
            self._refused[shot.path] = NotEnoughEvidenceError(known)
            self._display.detail(f"{shot.path}: {known}")
            return False
        try:
            calibrated.add(shot.path, siblings=group.paths, on_event=on_event)
        except NotEnoughEvidenceError as error:
            self._journal.note("not learned from", photo, under, str(error))
            self._refused[shot.path] = error
            self._display.detail(f"{shot.path}: {error}")
            return False
        except (LensModelError, OSError) as error:  # is found again at once, or may be mended meanwhile
            self._refused[shot.path] = error
            return False
        return True

    def _correct_all(
        self,
        lens_groups: Sequence[PhotoGroup],
        targets: Mapping[Path, Path],
        bars: PacedProgress,
        task: TaskID,
        before: int,
        results: list[dict[str, Any]],
        *,
        as_json: bool,
    ) -> list[dict[str, Any]]:
        """Correct the photos that gain from it, leave the others, and return a row for each group."""
        rows, number = [], before
        for group in lens_groups:
            profile = self._profile_of(group)
            lens = Lens(files.profile_at(profile)) if profile.exists() else None
            states: Counter[str] = Counter()
            left: Counter[str] = Counter()
            gains: list[float] = []
            for shot in group.shots:
                more = group is not lens_groups[-1]  # of other photos, which may be left or take longer
                bars.update(task, description=f"correcting {shot.path.name}", more=more)
                target = targets[shot.path]
                result = self._correct_shot(
                    shot, group, target, lens, partial(show_share, bars, task, number, more=more)
                )
                states[result["state"]] += 1
                if result["state"] == "corrected":
                    gains.append(result["expected_gain_db"])
                    if not as_json:
                        self._display.detail(f"{target}: {gain_words(gains[-1])} expected")
                left[result.get("reason", "")] += 1
                few = result["state"] == "left" and left[result["reason"]] <= _SAID
                tell = self._display.note if few else self._display.detail
                outputs.say(shot.path, target, result, self._display, tell)
                results.append({"photo": str(shot.path), "output": str(target), **result})
                number += 1
                bars.update(task, completed=number, more=more)
            rows.append(
                {
                    "camera": group.camera,
                    "lens": group.lens,
                    "focal_length": group.focal,
                    "profile": str(profile) if profile.exists() else None,
                    "photos": len(group.shots),
                    "learned_from": self._learned[group.name, group.focal],
                    "corrected": states["corrected"],
                    "corrected_before": states["kept"],
                    "left": states["left"],
                    "failed": states["failed"],
                    "expected_gain_db": sum(gains) / len(gains) if gains else None,  # of this run
                }
            )
        return rows

    def _correct_shot(
        self,
        shot: Shot,
        group: PhotoGroup,
        target: Path,
        lens: Lens | None,
        on_step: Callable[[int, int], None],
    ) -> dict[str, Any]:
        refused = self._refused.get(shot.path)
        if isinstance(refused, UnreadablePhotoError) or (
            lens is None and refused is not None and not isinstance(refused, NotEnoughEvidenceError)
        ):
            return files.failed(refused)
        if lens is None:
            return {"state": "left", "reason": "no photo of its lens shows enough to learn the blur from"}
        photo = sampling.photo_id(shot.path)
        samples = len(lens.profile.model.samples)
        options = self._options
        under = (
            f"{target.name}, {samples} samples, {options.method or 'standard'}, "
            f"strength {options.strength:g}, {options.bounds}, aperture {options.aperture}, least {SEEN_DB:g}"
        )
        known = self._journal.verdict("left", photo, under)
        if known is not None and not options.force:
            return {"state": "left", "reason": known}
        result = outputs.correct_one(shot.path, target, lens, options, self._display, on_step, group.paths)
        if result["state"] == "left":
            result["reason"] = why_left(result, lossy=shot.lossy)
            self._journal.note("left", photo, under, result["reason"])
        return result


def why_left(result: Mapping[str, Any], *, lossy: bool) -> str:
    """Say in a sentence why a photo is not worth correcting."""
    zones = result["zones"].values()
    error = sum(zone.cells * zone.psf_error for zone in zones) / max(sum(zone.cells for zone in zones), 1)
    why = (
        "not enough is known about its lens yet; take more photos that are full of detail"
        if error > _UNSURE
        else "the camera has sharpened and compressed it, and no more can be restored safely"
        if lossy
        else "at this aperture the lens is about as sharp as its pixels, or the photo shows little detail"
    )
    return f"a correction would gain too little to be seen (less than {SEEN_DB:g} dB): {why}"


def _learning(bars: PacedProgress, task: TaskID, number: int, event: sampling.CalibrationEvent) -> None:
    share = event.done / event.total if event.total else 0.0
    bars.update(
        task,
        description=f"learning from {event.photo.name}: {event.stage}",
        completed=number + share,
        more=True,
    )


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    head = ("camera", "lens", "focal length", "photos", "learned from", "corrected", "left", "failed")
    lines = [
        [
            *(row[name] for name in ("camera", "lens", "focal_length")),
            *(str(row[name]) for name in ("photos", "learned_from")),
            str(row["corrected"] + row["corrected_before"]),
            *(str(row[name]) for name in ("left", "failed")),
            "" if row["expected_gain_db"] is None else gain_words(row["expected_gain_db"]),
        ]
        for row in rows
    ]
    return aligned([*head, "expected gain"], lines, numbers=range(3, 9))


# Focal lengths up to this ratio count as one: 2^(1/4), the reach of the lens model over focal lengths
# (`focal_octaves` in `lensmodel.model.variables`)
SAME_FOCAL: Final = 1.19
# Photos at the same settings that follow each other within this time show the same (chosen)
BURST: Final = timedelta(seconds=2)
# Characters of a file name (chosen): file systems take 255 bytes, and the ending needs some
MOST_IN_NAME: Final = 80


@dataclass(frozen=True, slots=True)
class Shot:
    """One photo and what its file says."""

    path: Path
    metadata: PhotoMetadata
    half_diagonal_mm: float = 0.0
    lossy: bool = False

    @classmethod
    def of(cls, path: Path) -> Shot:
        """Read the header of a photo."""
        info = inspect(path)
        pitch = info.metadata.pixel_pitch_um or 0.0
        half = math.hypot(info.width, info.height) / 2.0 * pitch / 1000.0
        return cls(path, info.metadata, half, lossy=info.kind == "jpeg")

    @property
    def owner(self) -> tuple[str, ...]:
        """What two photos of one copy of a lens agree in: its serial, or that of the body it was on."""
        said = self.metadata
        lens = (name_key(said.lens.model), serial_key(said.lens.serial))
        if said.lens.serial:
            return lens
        return (*lens, name_key(said.camera_model), serial_key(said.body_serial))

    @property
    def names_lens(self) -> bool:
        """Whether the file says which lens it was."""
        return Identity.of(self.metadata).names_lens


@dataclass(frozen=True, slots=True)
class PhotoGroup:
    """Photos of one lens, of one body where the lens has no serial, and of about one focal length."""

    shots: tuple[Shot, ...]  # by name; at least one
    # Of the lens profile that the group belongs to, without an ending. A lens that the files name has one for
    # all its focal lengths, since a profile tells them apart; photos that name no lens may be of as many
    # lenses as there are focal lengths.
    name: str

    @property
    def camera(self) -> str:
        """The body in words."""
        said = self.shots[0].metadata
        return camera_name(said.camera_maker, said.camera_model) or "unknown camera"

    @property
    def lens(self) -> str:
        """The lens in words; its serial shortened, as tables are shown around."""
        said = self.shots[0].metadata.lens
        serial = f" #{said.serial[-4:]}" if said.serial else ""
        return f"{said.model or 'lens not named'}{serial}"

    @property
    def focal(self) -> str:
        """The focal length in words."""
        known = [shot.metadata.focal_mm for shot in self.shots if shot.metadata.focal_mm]
        if not known:
            return "unknown"
        low, high = f"{min(known):.3g}", f"{max(known):.3g}"
        return f"{low} mm" if low == high else f"{low}-{high} mm"

    @property
    def paths(self) -> list[Path]:
        """The files."""
        return [shot.path for shot in self.shots]

    @property
    def scenes(self) -> int:
        """How many different things the photos show: the frames of a burst are one."""
        return len(_bursts(self.shots)[0])

    def to_learn_from(self) -> list[Shot]:
        """Return the photos in the order in which they tell most: each aperture's first one, then the second.

        A photo whose aperture is unknown comes last, and later frames of a burst after all (`scenes`).
        """
        first, again = _bursts(self.shots)
        return [*_by_aperture(first), *_by_aperture(again)]


def _by_aperture(shots: Sequence[Shot]) -> list[Shot]:
    by_aperture: dict[float, list[Shot]] = {}
    # a smaller frame is the middle of what the lens draws: the largest ones tell of all of it
    for shot in sorted(shots, key=lambda shot: -round(shot.half_diagonal_mm)):
        by_aperture.setdefault(shot.metadata.aperture or float("inf"), []).append(shot)
    ordered = [by_aperture[aperture] for aperture in sorted(by_aperture)]
    longest = max(map(len, ordered), default=0)
    return [group[i] for i in range(longest) for group in ordered if i < len(group)]


def _bursts(shots: Sequence[Shot]) -> tuple[list[Shot], list[Shot]]:
    """Part the photos into the first of each burst, and those that follow it at the same settings."""
    first: list[Shot] = []
    again: list[Shot] = []
    last: dict[tuple[float | None, float | None], datetime] = {}
    for shot in sorted(shots, key=lambda shot: (shot.metadata.taken_at or datetime.min, shot.path)):  # noqa: DTZ901  cameras' clocks have no zone
        said = shot.metadata
        settings = said.aperture, said.focal_mm
        before = last.get(settings)
        follows = said.taken_at is not None and before is not None and said.taken_at - before <= BURST
        (again if follows else first).append(shot)
        if said.taken_at is not None:
            last[settings] = said.taken_at
    return sorted(first, key=lambda shot: shot.path), sorted(again, key=lambda shot: shot.path)


def groups(shots: Iterable[Shot]) -> list[PhotoGroup]:
    """Sort photos by body, lens and focal length."""
    owners: dict[tuple[str, ...], list[Shot]] = {}
    for shot in shots:
        owners.setdefault(shot.owner, []).append(shot)
    all_groups: list[PhotoGroup] = []
    names: set[str] = set()
    for owner in sorted(owners):
        runs = _by_focal(owners[owner])
        shared = _free(_name(runs[0][0], with_focal=False), names) if runs[0][0].names_lens else None
        for run in runs:
            name = shared or _free(_name(run[0], with_focal=True), names)
            names.add(name)
            all_groups.append(PhotoGroup(tuple(sorted(run, key=lambda shot: shot.path)), name))
    return all_groups


def _by_focal(shots: Sequence[Shot]) -> list[list[Shot]]:
    """Cut into runs in which no focal length is more than `SAME_FOCAL` times the shortest."""
    runs: list[list[Shot]] = []
    start = -1.0
    for shot in sorted(shots, key=lambda shot: shot.metadata.focal_mm or 0.0):
        focal = shot.metadata.focal_mm or 0.0
        if not runs or focal > start * SAME_FOCAL:
            runs.append([])
            start = focal
        runs[-1].append(shot)
    return runs


def _name(shot: Shot, *, with_focal: bool) -> str:
    said = shot.metadata
    focal = f"{said.focal_mm:g}mm" if with_focal and said.focal_mm else None
    words = [said.camera_model, said.lens.model, said.lens.serial and said.lens.serial[-4:], focal]
    plain = re.sub(r"[^\w.+-]+", "-", "-".join(word for word in words if word)).strip("-.")
    return plain[:MOST_IN_NAME] or "unknown-camera"


def _free(name: str, taken: set[str]) -> str:
    """Two copies whose serials end alike get a number."""
    number, free = 2, name
    while free in taken:
        free, number = f"{name}-{number}", number + 1
    return free


NAME: Final = ".lensmodel-folder.json"


class Journal:
    """Verdicts by photo, each valid as long as what it was given under is unchanged.

    Written after each verdict, complete or not at all: a run that was stopped goes on where it was.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / NAME
        self._verdicts: dict[str, list[str]] = {}
        try:
            stored = json.loads(self._path.read_text(encoding="utf-8"))
        except (OSError, ValueError):  # none yet, or damaged: every verdict is determined anew
            return
        if isinstance(stored, dict):
            self._verdicts = {
                key: [str(text) for text in value]
                for key, value in stored.items()
                if isinstance(value, list) and len(value) == 2  # a condition and a verdict
            }

    def verdict(self, kind: str, photo: str, under: str) -> str | None:
        """Return the verdict on a photo under the same conditions, or None."""
        given, text = self._verdicts.get(f"{kind} {photo}", ["", ""])
        return text if given == under and text else None

    def note(self, kind: str, photo: str, under: str, text: str) -> None:
        """Store the verdict on a photo."""
        self._verdicts[f"{kind} {photo}"] = [under, text]
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with atomic(self._path) as file:
            file.write(json.dumps(self._verdicts, indent=1, ensure_ascii=False).encode())
