"""Pictures of the gallery calibrated from themselves and corrected by default, unless that is stored."""

from __future__ import annotations

import hashlib
import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

import lensmodel
from lab.gallery.pictures import Picture, Rendered, read_rendered, rendered
from lab.stored import Unit, stored, version_of
from lensmodel.blind.sampling import CalibrationEvent
from lensmodel.core.errors import LensModelError
from lensmodel.core.files import atomic
from lensmodel.photo import develop

BEFORE, AFTER = "before.npy", "after.npy"
"""Pictures as stored, rendered."""

ANY_APERTURE: Final = 5.6
"""f-number of photos that do not say theirs: chosen, of no effect where one photo is the whole profile."""

Words = Callable[[str], None]


def work(picture: Picture, cache: Path, workers: int, say: Words) -> tuple[Path, Unit]:
    """Return the folder of the pictures, before and after, and how they were made."""
    with picture.path.open("rb") as file:
        content = hashlib.file_digest(file, "sha256").hexdigest()[:8]
    folder = cache / f"{picture.slug}-{content}-{version_of('lab.gallery.work')[:8]}"
    return folder, stored(folder / "work.json", lambda: _worked(picture, folder, workers, say))


def _worked(picture: Picture, folder: Path, workers: int, say: Words) -> Unit:
    say("developing")
    developed = develop(picture.path)
    _save(folder / BEFORE, rendered(developed.planes, developed.encoding))
    aperture = ANY_APERTURE if developed.info.metadata.aperture is None else None
    note = "" if aperture is None else "the file does not say its aperture, which was given as by --aperture"
    unit: Unit = {"state": "left alone", "reason": "", "note": note, "announced": {}}
    reasons: list[str] = []

    def heard(event: CalibrationEvent) -> None:
        if event.stage == "skipped":
            reasons.append(event.detail)

    say("calibrating")
    try:
        lens = lensmodel.calibrate(picture.path, aperture=aperture, workers=workers, on_event=heard)
    except LensModelError as error:
        return {**unit, "reason": f"calibration was refused: {reasons[0] if reasons else error}"}
    say("correcting")
    with tempfile.TemporaryDirectory(prefix="lensmodel-gallery-") as name:
        output = Path(name) / "corrected.tif"
        try:
            corrected = lensmodel.correct(
                picture.path, lens, output, aperture=aperture, color_space="srgb", workers=workers
            )
        except LensModelError as error:
            return {**unit, "reason": f"correction was refused: {error}"}
        _save(folder / AFTER, read_rendered(output))
    announced = {zone: _finite(report.expected_gain_db) for zone, report in corrected.zones.items()}
    return {**unit, "state": "corrected", "announced": announced}


def _save(path: Path, values: Rendered) -> None:
    """Keep an array, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic(path) as file:
        np.save(file, values, allow_pickle=False)


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)
