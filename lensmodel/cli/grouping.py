"""A folder of photos, sorted by what took them: one copy of a lens, one focal length."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Final

from lensmodel.core.names import name_key, serial_key
from lensmodel.photo import inspect
from lensmodel.photo.values import PhotoMetadata
from lensmodel.workflow.identity import Identity

SAME_FOCAL: Final = 1.19
"""Focal lengths up to this ratio count as one: 2^(1/4), the reach of the lens model over focal lengths
(`focal_octaves` in `lensmodel.model.variables`)."""

BURST: Final = timedelta(seconds=2)
"""Photos at the same settings that follow each other within this time show the same (chosen)."""

MOST_IN_NAME: Final = 80
"""Characters of a file name (chosen): file systems take 255 bytes, and the ending needs some."""


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
        return cls(path, info.metadata, math.hypot(info.width, info.height) / 2.0 * pitch / 1000.0)

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
    """Photos of one lens, of one body where the lens has no serial, and of about one focal length.

    Parameters
    ----------
    shots : tuple of Shot
        By name; at least one.
    name : str
        Of the lens profile that the group belongs to, without an ending. A lens that the files name has one
        for all its focal lengths, since a profile tells them apart; photos that name no lens may be of as
        many lenses as there are focal lengths.
    """

    shots: tuple[Shot, ...]
    name: str

    @property
    def camera(self) -> str:
        """The body in words."""
        return self.shots[0].metadata.camera_model or "unknown camera"

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
