"""The gallery: each picture calibrated from itself, corrected by default, and measured.

Whatever is stored already is not made again.
"""

from __future__ import annotations

import hashlib
import math
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import Image

import lensmodel
from lab.gallery import crops, measure
from lab.gallery.pictures import FRAMES, Picture, Rendered, read_rendered, rendered, take
from lab.images import BLOCK
from lab.stored import Unit, stored, version_of
from lensmodel.core.errors import LensModelError
from lensmodel.core.files import atomic
from lensmodel.core.types import LensSettings
from lensmodel.photo import develop
from lensmodel.workflow.sampling import CalibrationEvent

OnPicture = Callable[[str, int, int], None]
"""Hears what is being done, and how many of how many pictures are finished."""

CACHE = "cache"
CROPS = "crops"
BEFORE, AFTER = "before.npy", "after.npy"
"""Pictures as stored, rendered."""

ANY_APERTURE: Final = 5.6
"""f-number of photos that do not say theirs: chosen, of no effect where one photo is the whole profile."""

Words = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class PicturePlace:
    """One place of a picture that is looked at."""

    name: str  # which place
    row: int  # first pixel
    col: int
    file: str  # crops side by side, in the order of `GalleryEntry.columns`, relative to the page


@dataclass(frozen=True, slots=True)
class GalleryEntry:
    """What the page shows of one picture."""

    picture: Picture
    work: Unit  # how it was made, see `work`
    figures: dict[str, Any]  # see `measured`; empty for an unreadable file
    bars: dict[str, bool]  # which it keeps
    columns: tuple[str, ...]  # what stands side by side in the crops
    places: tuple[PicturePlace, ...]


def entries_of(
    pictures: Sequence[Picture], output: Path, *, workers: int, on_picture: OnPicture
) -> Iterator[GalleryEntry]:
    """Make what the page shows, one picture after the other."""
    (output / CROPS).mkdir(parents=True, exist_ok=True)
    for done, picture in enumerate(pictures):

        def say(words: str, done: int = done, name: str = picture.name) -> None:
            on_picture(f"{name}: {words}", done, len(pictures))

        entry = _entry(picture, output, workers, say)
        say("done", done + 1)
        yield entry


def _entry(picture: Picture, output: Path, workers: int, say: Words) -> GalleryEntry:
    if picture.unreadable:
        unit: Unit = {"state": "not read", "reason": picture.unreadable, "notes": []}
        return GalleryEntry(picture, unit, {}, {}, (), ())
    folder, unit = work(picture, output / CACHE, workers, say)
    before = _mapped(folder / BEFORE)
    shown = _mapped(folder / AFTER) if (folder / AFTER).exists() else before
    known = None if picture.truth is None else _mapped(picture.truth)
    say("measuring")
    name = f"figures-{version_of('lab.gallery.measure')[:8]}.json"
    found = stored(folder / name, lambda: measure.measured(before, shown, known))
    columns, sheets = ["original", "corrected"], [before, shown]
    if known is not None:
        columns.append("truth")
        sheets.append(known)
    say("cutting crops")
    side = crops.side_of(before)
    named: list[tuple[str, Sequence[int] | None]] = [("subject", picture.subject)]
    named += [("most dots", found["dots_at"]), ("most hue flips", found["hue_flips_at"])]
    if found["gains"] is not None and found["gains"]["worst_db"] < 0.0:
        middle = [k + BLOCK // 2 for k in found["gains"]["worst_at"]]
        named.append((f"worst block, {found['gains']['worst_db']:+.2f} dB", middle))
    where = crops.places(before, shown, named)
    made = []
    for number, (words, row, col) in enumerate(where, start=1):
        file = f"{CROPS}/{picture.slug}-{number}.png"
        Image.fromarray(crops.sheet(sheets, row, col, side)).save(output / file, optimize=True)
        made.append(PicturePlace(words, row, col, file))
    return GalleryEntry(picture, unit, found, measure.bars(found), tuple(columns), tuple(made))


def work(picture: Picture, cache: Path, workers: int, say: Words) -> tuple[Path, Unit]:
    """Calibrate a picture from itself and correct it, unless that is stored."""
    _taken(picture, say)
    content = _hash(picture.path)
    code = version_of("lab.gallery.run", without=("lab.gallery.measure", "lab.gallery.crops"))
    folder = cache / f"{picture.slug}-{content[:8]}-{code[:8]}"
    unit = stored(folder / "work.json", lambda: _worked(picture, folder, workers, say))
    return folder, unit


def _mapped(path: Path) -> Rendered:
    return np.load(path, mmap_mode="r", allow_pickle=False)


def _save(path: Path, values: Rendered) -> None:
    """Keep an array, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic(path) as file:
        np.save(file, values, allow_pickle=False)


def _taken(picture: Picture, say: Words) -> None:
    """Take a simulated frame whose turn has come."""
    if picture.truth is None or (picture.path.exists() and picture.truth.exists()):
        return
    say("taking the photo")
    take(next(frame for frame in FRAMES if frame.file == picture.path.name), picture.path.parent)


def _worked(picture: Picture, folder: Path, workers: int, say: Words) -> Unit:
    say("developing")
    developed = develop(picture.path)
    _save(folder / BEFORE, rendered(developed.planes, developed.encoding))
    notes = []
    override = LensSettings()
    if developed.info.metadata.aperture is None:
        override = LensSettings(aperture=ANY_APERTURE)
        notes.append("the file does not say its aperture, which was given as by --aperture")
    unit: Unit = {
        "state": "left alone",
        "reason": "",
        "notes": notes,
        "announced": {},
    }
    began = time.monotonic()
    say("calibrating")
    reasons: list[str] = []

    def heard(event: CalibrationEvent) -> None:
        if event.stage == "skipped":
            reasons.append(event.detail)

    try:
        lens = lensmodel.calibrate(picture.path, aperture=override.aperture, workers=workers, on_event=heard)
    except LensModelError as error:
        reason = f"calibration was refused: {reasons[0] if reasons else error}"
        return {**unit, "reason": reason, "seconds": [_since(began), 0.0]}
    calibrated = _since(began)
    began = time.monotonic()
    say("correcting")
    with tempfile.TemporaryDirectory(prefix="lensmodel-gallery-") as name:
        output = Path(name) / "corrected.tif"
        try:
            corrected = lensmodel.correct(
                picture.path, lens, output, aperture=override.aperture, color_space="srgb", workers=workers
            )
        except LensModelError as error:
            reason = f"correction was refused: {error}"
            return {**unit, "reason": reason, "seconds": [calibrated, _since(began)]}
        seconds = [calibrated, _since(began)]
        _save(folder / AFTER, read_rendered(output))
    announced = {zone: _finite(report.expected_gain_db) for zone, report in corrected.zones.items()}
    return {**unit, "state": "corrected", "announced": announced, "seconds": seconds}


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _since(began: float) -> float:
    return round(time.monotonic() - began, 1)


def _hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:12]
