"""`lensmodel correct FOLDER --lens auto`: sort photos by lens, learn each lens, correct what gains."""

from __future__ import annotations

import math
import re
import textwrap
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import accumulate, zip_longest
from pathlib import Path
from typing import Any, Final

from lensmodel.blind.sampling import CalibrationEvent, configured
from lensmodel.calibration import Calibration
from lensmodel.cli import files
from lensmodel.cli.console import Display, PacedProgress, aligned, gain_words
from lensmodel.cli.outputs import Correction
from lensmodel.core.errors import LensModelError, NotEnoughEvidenceError
from lensmodel.core.names import camera_name, name_key, serial_key
from lensmodel.core.types import LensSettings
from lensmodel.lens import Lens
from lensmodel.model.identity import SAME_FOCAL, Identity
from lensmodel.photo import inspect
from lensmodel.photo.values import PhotoMetadata

# Photos that a group is learned from: five are the advice (docs/guide.md), three more for other apertures
# (chosen); each takes about a minute
LEARN_FROM: Final = 8
# Columns for the names of a group (chosen): with them the table fits a terminal of 80
_LENS_WIDTH: Final = 27
PROFILES: Final = "lenses"
ENDING: Final = ".lensprofile"


def correct_folder(correction: Correction, profiles: Path, most: int) -> dict[str, Any]:
    """Learn the lens of every group of photos, correct those that gain, and tell what became of each.

    Lens profiles go to `profiles`; each group is learned from `most` photos.
    """
    shots: list[Shot] = []
    results: list[dict[str, Any]] = []
    rows: list[dict[str, Any]] = []
    display = correction.display
    for path in correction.targets:
        try:
            shots.append(Shot.of(path))
        except (LensModelError, OSError) as error:
            results.append({"photo": str(path), "output": None, **files.failed(error)})
            display.error(f"{path}: {files.reason(error)}")
    lens_groups, unread = groups(shots), len(results)
    counts = [min(most, group.scenes) for group in lens_groups]
    with display.progress("learning", sum(counts) + len(shots)) as bar:
        begins = accumulate(counts, initial=0)
        learned = [
            _learn(group, profiles, count, correction, bar, begin)
            for group, count, begin in zip(lens_groups, counts, begins, strict=False)
        ]
        for group, count in zip(lens_groups, learned, strict=True):
            target = group.profile_in(profiles)
            lens = Lens(files.profile_at(target)) if target.exists() else None
            begin = sum(counts) + len(results) - unread
            more = group is not lens_groups[-1]  # photos of another kind, which may be left or take longer
            done = correction.photos(group.paths, lens, bar, begin=begin, more=more)
            results += done
            rows.append(_row(group, None if lens is None else target, count, done))
    if rows or not unread:
        display.result(_table(rows))
    _say_more(display, rows, unread, {target.parent for target in correction.targets.values()}, profiles)
    return {"groups": rows, "results": results}


def _learn(
    group: PhotoGroup,
    profiles: Path,
    most: int,
    correction: Correction,
    bar: PacedProgress,
    begin: int,
) -> int:
    """Learn the lens of a group; return from how many photos, now or in an earlier run."""
    display, counted = correction.display, 0

    def on_event(event: CalibrationEvent) -> None:
        text = f"learning from {event.photo.name}: {event.stage}"
        bar.part(begin + counted, event.done, event.total, description=text, more=True)

    store = files.ProfileFile(group.profile_in(profiles))
    config = configured(store.model, LensSettings(aperture=correction.options["aperture"]))
    calibration = Calibration(store, config, any_lens=correction.any_lens)
    paths = [shot.path for shot in group.to_learn_from()]
    for event in calibration.learn(paths, on_event=on_event):
        if event.error is None:
            counted += 1
        else:
            correction.refused[event.photo] = event.error
            display.detail(f"{event.photo}: {event.error}")
        if counted == most:
            break
    bar.show(completed=begin + most, more=True)
    refused = [correction.refused.get(path) for path in paths]
    if not counted and all(isinstance(error, NotEnoughEvidenceError) for error in refused):
        reasons = set(map(str, refused))
        why = f" ({reasons.pop()})" if len(reasons) == 1 else ""
        display.note(f"{group.lens}, {group.focal}: no photo shows enough to learn its blur from{why}")
    return counted


def _row(
    group: PhotoGroup, profile: Path | None, learned: int, results: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Say what became of the photos of a group."""
    states = Counter(result["state"] for result in results)
    gains = [result["expected_gain_db"] for result in results if result["state"] == "corrected"]
    return {
        "camera": group.camera,
        "lens": group.lens,
        "focal_length": group.focal,
        "profile": None if profile is None else str(profile),
        "photos": len(group.shots),
        "learned_from": learned,
        "corrected": states["corrected"],
        "corrected_before": states["kept"],
        "left": states["left"],
        "failed": states["failed"],
        "expected_gain_db": sum(gains) / len(gains) if gains else None,  # of this run
    }


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    lines = [
        [
            textwrap.fill(", ".join(row[name] for name in ("camera", "lens", "focal_length")), _LENS_WIDTH),
            *(str(row[name]) for name in ("photos", "learned_from")),
            str(row["corrected"] + row["corrected_before"]),
            *(str(row[name]) for name in ("left", "failed")),
            "" if row["expected_gain_db"] is None else gain_words(row["expected_gain_db"]),
        ]
        for row in rows
    ]
    head = ("camera, lens, focal length", "photos", "learned\nfrom", "corrected", "left", "failed")
    return aligned([*head, "expected\ngain"], lines, numbers=range(1, 7))


def _say_more(
    display: Display, rows: Sequence[Mapping[str, Any]], unread: int, folders: Iterable[Path], profiles: Path
) -> None:
    """Say what the table does not: what was not read, which lens is little known, and where files are."""
    if display.as_json:
        return
    if unread and rows:
        display.note(f"not in the table: files that could not be read, {unread}; see above why")
    for row in rows:
        if row["learned_from"] == 1:
            display.note(
                f"{row['camera']}, {row['lens']}: learned from one photo; with five or more its blur is "
                "known better, and scenes do not pass for it"
            )
    if any(row["corrected"] for row in rows):
        where = ", ".join(str(folder) for folder in sorted(folders))
        display.note(f"corrected photos are in {where}, lens profiles in {profiles}")


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

    @classmethod
    def of(cls, path: Path) -> Shot:
        """Read the header of a photo."""
        info = inspect(path)
        pitch = info.metadata.pixel_pitch_um or 0.0
        half = math.hypot(info.width, info.height) / 2.0 * pitch / 1000.0
        return cls(path, info.metadata, half)

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
        """The bodies in words."""
        said = [shot.metadata for shot in self.shots]
        names = (camera_name(one.camera_maker, one.camera_model) or "unknown camera" for one in said)
        return ", ".join(dict.fromkeys(names))

    @property
    def lens(self) -> str:
        """The lens in words; its serial shortened, as tables are shown around."""
        said = self.shots[0].metadata.lens
        serial = f" #{said.serial[-4:]}" if said.serial else ""
        return f"{said.model or 'unknown lens'}{serial}"

    @property
    def focal(self) -> str:
        """The focal length in words."""
        known = [shot.metadata.focal_mm for shot in self.shots if shot.metadata.focal_mm]
        if not known:
            return "unknown focal length"
        low, high = f"{min(known):.3g}", f"{max(known):.3g}"
        return f"{low} mm" if low == high else f"{low}-{high} mm"

    @property
    def paths(self) -> list[Path]:
        """The files."""
        return [shot.path for shot in self.shots]

    def profile_in(self, folder: Path) -> Path:
        """The file of its lens."""
        return folder / f"{self.name}{ENDING}"

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
        by_aperture.setdefault(shot.metadata.aperture or math.inf, []).append(shot)
    turns = zip_longest(*(by_aperture[aperture] for aperture in sorted(by_aperture)))
    return [shot for turn in turns for shot in turn if shot is not None]


def _bursts(shots: Sequence[Shot]) -> tuple[list[Shot], list[Shot]]:
    """Part the photos into the first of each burst, and those that follow it at the same settings."""
    parts: tuple[list[Shot], list[Shot]] = [], []
    last: dict[tuple[float | None, float | None], datetime] = {}
    for shot in sorted(shots, key=lambda shot: (shot.metadata.taken_at or datetime.min, shot.path)):  # noqa: DTZ901  cameras' clocks have no zone
        said = shot.metadata
        settings, time = (said.aperture, said.focal_mm), said.taken_at
        follows = time is not None and settings in last and time - last[settings] <= BURST
        parts[follows].append(shot)
        if time is not None:
            last[settings] = time
    return sorted(parts[0], key=lambda shot: shot.path), sorted(parts[1], key=lambda shot: shot.path)


def groups(shots: Iterable[Shot]) -> list[PhotoGroup]:
    """Sort photos by body, lens and focal length; lengths within `SAME_FOCAL` of the shortest are one."""
    runs: list[tuple[str, list[Shot]]] = []
    for shot in sorted(shots, key=lambda shot: (shot.owner, shot.metadata.focal_mm or 0.0)):
        name, run = runs[-1] if runs else ("", [])
        same = bool(run) and run[0].owner == shot.owner
        if same and (shot.metadata.focal_mm or 0.0) <= (run[0].metadata.focal_mm or 0.0) * SAME_FOCAL:
            run.append(shot)
            continue
        if not (same and shot.names_lens):
            name = _free(_name(shot), {taken for taken, _ in runs})
        runs.append((name, [shot]))
    return [PhotoGroup(tuple(sorted(run, key=lambda shot: shot.path)), name) for name, run in runs]


def _name(shot: Shot) -> str:
    said = shot.metadata
    focal = f"{said.focal_mm:g}mm" if said.focal_mm and not shot.names_lens else None
    words = [said.camera_model, said.lens.model, said.lens.serial and said.lens.serial[-4:], focal]
    plain = re.sub(r"[^\w.+-]+", "-", "-".join(word for word in words if word)).strip("-.")
    return plain[:MOST_IN_NAME] or "unknown-camera"


def _free(name: str, taken: set[str]) -> str:
    """Two copies whose serials end alike get a number."""
    number, free = 2, name
    while free in taken:
        free, number = f"{name}-{number}", number + 1
    return free
