"""Photos that were made to measure a lens: one task, whose positions and kernels are checked and stored."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from app.jobs.context import JobContext, JobFailedError
from app.jobs.sample_files import DAMAGED, returned_samples
from app.store import NewPatch, NewSample
from app.store.owners import ANY_OWNER
from app.store.photos import stored_settings
from app.store.tables import PhotoRow
from app.ways import configured_way
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import CHANNELS

MAX_PLACES: Final = 1000
"""Most places of a measurement (chosen): no method has so many cells, a child that returns more is broken."""

WAIT_S: Final = 60.0
"""How long the open photo of a pair waits until the closed one is inspected (chosen): that takes
seconds, unless many photos are before it."""

_UNREAD: Final = ("received", "inspecting")
_BYTES_A_PIXEL: Final = 96  # chosen, by counting: two mapped photos, a float64 plane of each, intermediates


class MeasurementWork:
    """Measures a photo in the sandbox."""

    def __init__(self, context: JobContext) -> None:
        self._context = context

    def measure(self, photo: PhotoRow, developed: Path, wanted: Callable[[], bool]) -> None:
        """Measure the PSF all over a photo and store it as patches with samples.

        A repeated call adds nothing twice.
        """
        folders = [developed, *self._reference(photo, wanted)]
        settings = self._context.settings
        arguments = {
            "kind": photo.given["kind"],
            "developed": [str(folder) for folder in folders],
            "photo": photo.public_id,
            "settings": stored_settings(photo),
            "size": configured_way(settings, photo.way).kernel_size,
        }
        limits = self._context.limits(photo, settings.task_seconds, _BYTES_A_PIXEL)
        with self._context.sandbox.folder() as folder:
            listed = self._context.attempt(
                "measure-lens", arguments, folder=folder, limits=limits, wanted=wanted, reads=folders
            )
            patches, samples = _checked(listed, folder)
        store = self._context.store
        store.patches.add(photo.public_id, photo.epoch, patches)
        store.photos.set_state(photo.public_id, ("selecting",), "estimating", epoch=photo.epoch)
        store.patches.finish(photo.public_id, photo.epoch, samples)

    def _reference(self, photo: PhotoRow, wanted: Callable[[], bool]) -> list[Path]:
        """Return the folder of the developed closed photo of a pair."""
        name = photo.given.get("reference_id")
        if name is None:
            return []
        row = self._context.store.photos.get(name, ANY_OWNER)
        end = time.monotonic() + WAIT_S
        while row is not None and row.state in _UNREAD and time.monotonic() < end and wanted():
            time.sleep(0.2)
            row = self._context.store.photos.get(name, ANY_OWNER)
        if row is None or row.owner_id != photo.owner_id:
            raise JobFailedError(
                "unknown_photo", f"the reference photo {name} is not there any more; send both photos again"
            )
        if row.width is None:
            raise JobFailedError(
                "not_ready", f"the reference photo {name} was not read yet; send the open photo again"
            )
        return [self._context.developed(row, wanted)]


def _checked(listed: Any, folder: Path) -> tuple[list[NewPatch], list[NewSample]]:  # noqa: ANN401 - a child's JSON
    """Validate the measurements of a child as untrusted input."""
    try:
        if not 0 < len(listed) <= MAX_PLACES * len(CHANNELS):
            raise InvalidInputError(f"{len(listed)} samples")
        patches: dict[int, NewPatch] = {}
        samples = []
        for sample, entry in zip(returned_samples(folder, count=len(listed)), listed, strict=True):
            number, error = int(entry["idx"]), sample.error
            if error is None or not error <= 1.0 or not 0 <= number < MAX_PLACES:
                raise InvalidInputError(f"a sample of place {number} with error {error}")
            patches.setdefault(
                number,
                NewPatch(
                    idx=number,
                    row=int(entry["row"]),
                    col=int(entry["col"]),
                    size=int(entry["side"]),
                    r=sample.position.r,
                    phi=sample.position.phi,
                    cell=number,
                    score=1.0 - error,
                ),
            )
            samples.append(NewSample(number, sample))
    except DAMAGED as error:
        raise JobFailedError("internal_error", f"the measurement gave no kernels: {error}") from error
    return list(patches.values()), samples
