"""Photos sorted by lens, and the order in which each lens is learned from its own."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import zip_longest
from pathlib import Path
from typing import Final

from lensmodel.core.names import camera_name, name_key, serial_key
from lensmodel.model.identity import SAME_FOCAL, Identity
from lensmodel.photo import inspect
from lensmodel.photo.values import PhotoMetadata

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
        return folder / f"{self.name}.lensprofile"

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
