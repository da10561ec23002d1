"""The job of a photo: inspect, identify the lens, develop, choose patches, estimate PSFs, count.

Each step reads the tables first and does only what is not done yet. So the job may be started again at any
time, by any worker, and still every effect happens once.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from app.jobs import inspection
from app.jobs.answers import ReadProfile, Selected, checked
from app.jobs.context import SPARE_MB, JobContext, JobFailedError, NotWantedError
from app.jobs.queue import DbosEngine
from app.jobs.sample_files import DAMAGED, returned_samples
from app.other_lens import REMEDY, Described, difference
from app.presets import configured_preset
from app.sandbox.outcome import TaskLimits
from app.store import NewPatch, NewSample, Store
from app.store.jobs import Job
from app.store.owners import ANY_OWNER
from app.store.photos import stored_settings
from app.store.tables import PHOTO_RUNNING, PROFILE_FILE, PatchRow, PhotoRow
from lensmodel.core import codec
from lensmodel.core.errors import InvalidInputError, NoUsablePatchesError
from lensmodel.core.types import CHANNELS, FieldPosition
from lensmodel.patches import Patch
from lensmodel.workflow import sampling

log = logging.getLogger(__name__)

# Seconds between two looks at the open cells of a photo (chosen): a cell takes seconds, a look one query
WAIT_S: Final = 0.2
# Seconds between two checks that each open cell still has a job (chosen): only dead workers lose one
LOOK_AFTER_S: Final = 5.0
# Who chooses the patches of a photo that names nobody, of `lensmodel.patches.selectors`
SELECTOR: Final = "r-map"
# Most places of a measurement (chosen): no method has so many cells, a child that returns more is broken
MAX_PLACES: Final = 1000
# How long the open photo of a pair waits until the closed one is inspected (chosen): that takes seconds,
# unless many photos are before it
WAIT_FOR_REFERENCE_S: Final = 60.0
_UNREAD: Final = ("received", "inspecting")
_MEASURING: Final = 96  # bytes a pixel (chosen, by counting): two mapped photos, a float64 plane of each

# Times the unpacked size that reading takes (chosen, by counting): bytes, float32, float64, the model
COPIES: Final = 8
# Bytes to which a profile may unpack (chosen): kernels of 20,000 samples of 55 pixels, which no lens has
MAX_UNPACKED: Final = 256 << 20


class PhotoWork:
    """Jobs of photos and of their cells."""

    def __init__(self, context: JobContext, engine: DbosEngine) -> None:
        self._context, self._engine = context, engine
        self._store = context.store

    def photo(self, photo_id: str, epoch: int) -> None:
        """Take a photo through all steps, as far as it can get."""
        if not self._store.photos.is_live(photo_id, epoch):
            return
        try:
            photo = _begun(self._store, photo_id, epoch)
            if photo.kind == PROFILE_FILE:
                _read_profile(self._context, photo)
                return
            steps = _Measured if photo.given.get("kind") else _Steps
            steps(self._context, self._engine, photo).run()
        except NotWantedError:
            log.info("photo %s is not wanted any more", photo_id)
        except JobFailedError as error:
            self._store.photos.fail(photo_id, epoch, error.code, error.detail)

    def cell(self, photo_id: str, epoch: int, cell: int) -> None:
        """Estimate the PSF of one field cell of a photo."""
        rows = self._context.store.photos.patches_of_cell(photo_id, epoch, cell)
        if not rows:
            return
        numbers = [row.idx for row in rows]
        try:
            samples = self._samples(_row(self._store, photo_id), rows)
        except NotWantedError:
            return
        except JobFailedError as error:
            log.info("cell %d of photo %s: %s: %s", cell, photo_id, error.code, error.detail)
            rejected = error.code in {"no_samples", "no_usable_patches", "invalid_parameter"}
            reason = "not-enough-evidence" if rejected else error.code
            self._store.photos.fail_patches(photo_id, epoch, reason, indices=numbers, rejected=rejected)
            return
        self._store.photos.add_samples(photo_id, epoch, samples)
        left = set(numbers) - {sample.idx for sample in samples}
        if left:
            reason = "not-enough-evidence"
            self._store.photos.fail_patches(photo_id, epoch, reason, indices=sorted(left), rejected=True)

    def _samples(self, photo: PhotoRow, rows: list[PatchRow]) -> list[NewSample]:
        def wanted() -> bool:
            return self._store.photos.is_live(photo.public_id, photo.epoch)

        settings = self._context.settings
        preset = configured_preset(settings)
        developed = self._context.developed(photo, wanted)
        arguments = {
            "developed": str(developed),
            "photo": photo.public_id,
            "patches": [codec.to_json(_patch_of(row)) for row in rows],
            "numbers": [row.idx for row in rows],
            "settings": stored_settings(photo),
            "estimator": preset.estimator,
            "size": preset.kernel_size,
        }
        limits = self._context.limits(photo, settings.patch_seconds, 24)
        with self._context.sandbox.folder() as folder:
            listed = self._context.attempt(
                "estimate",
                arguments,
                folder=folder,
                limits=limits,
                wanted=wanted,
                reads=[developed],
            )
            places = {row.idx: FieldPosition(row.r, row.phi) for row in rows}
            return _checked(listed, folder, places)


class _Steps:
    """The work on a photo by rows and tasks: each step does only what the tables do not have yet."""

    def __init__(self, context: JobContext, engine: DbosEngine, photo: PhotoRow) -> None:
        self._context, self._engine, self._photo = context, engine, photo
        self._store = context.store
        self._preset = configured_preset(context.settings)
        self._developed = Path()

    def _wanted(self) -> bool:
        return self._store.photos.is_live(self._photo.public_id, self._photo.epoch)

    def run(self) -> None:
        """Take the photo through all steps."""
        if not self.inspect():
            return
        self.enter("developing")
        self.develop()
        self.enter("selecting")
        self.select()
        self.enter("estimating")
        self.estimate()
        self.count()

    def inspect(self) -> bool:
        """Read the header and assign the lens; return whether to go on and calibrate it."""
        if self._photo.state != "inspecting":
            return True
        inspection.inspect(self._context, self._photo, self._wanted)
        self._photo = _row(self._store, self._photo.public_id)
        photo, photos = self._photo, self._store.photos
        single = self._context.settings.assume_single_copy
        lens = photos.assign_lens(photo.public_id, single_copy=single)
        if not photo.calibrate:
            photos.set_state(
                photo.public_id, ("inspecting",), "stored", epoch=photo.epoch, finished_at=datetime.now(UTC)
            )
            return False
        missing = _missing(photo, lens_known=lens is not None)
        if missing:
            photos.set_state(
                photo.public_id,
                ("inspecting",),
                "needs_lens",
                epoch=photo.epoch,
                error_code="metadata_missing",
                error_detail=missing,
            )
        return not missing

    def enter(self, stage: sampling.Stage) -> None:
        """Move to the next state; a photo that is already further stays there."""
        photo, before = self._photo, _BEFORE[stage]
        if not self._store.photos.set_state(photo.public_id, (before, stage), stage, epoch=photo.epoch):
            state = _row(self._store, photo.public_id).state
            if state not in _BEFORE:
                raise NotWantedError

    def develop(self) -> None:
        """Develop the photo, unless this machine has it developed."""
        self._developed = self._context.developed(self._photo, self._wanted)

    def select(self) -> None:
        """Choose the patches, and measure the lateral colour."""
        photo, developed = self._photo, self._developed
        if self._store.photos.patches(photo.public_id, photo.epoch):
            return
        limits = self._context.limits(photo, self._context.settings.develop_seconds, 120)
        arguments = {
            "developed": str(developed),
            "count": self._preset.patches,
            "estimator": self._preset.estimator,
            "selector": photo.given.get("selector") or SELECTOR,
        }
        with self._context.sandbox.folder() as folder:
            try:
                selection = self._context.attempt(
                    "select", arguments, folder=folder, limits=limits, wanted=self._wanted, reads=[developed]
                )
            except JobFailedError as error:
                if error.code != "invalid_parameter":
                    raise
                size = f"{photo.width}x{photo.height}"
                text = f"the photo of {size} pixels is too small to tell about its lens; send it in full size"
                raise JobFailedError("no_usable_patches", text) from error
        selection = checked(Selected, selection)
        if selection["lateral"] is not None:
            self._store.photos.record_lateral(photo.public_id, photo.epoch, selection["lateral"])
        windows = enumerate([*selection["patches"], *selection["rejected"]])
        plan = [NewPatch(idx=number, **window) for number, window in windows]
        self._store.photos.plan_patches(photo.public_id, photo.epoch, plan)

    def estimate(self) -> None:
        """Hand out the cells and wait until each is done, rejected or given up."""
        photo = self._photo
        owner = f"owner-{photo.owner_id}"
        jobs = {
            cell: Job("cell", (photo.public_id, photo.epoch, cell), owner)
            for cell in self._store.photos.cells(photo.public_id, photo.epoch)
        }
        for job in jobs.values():
            self._engine.enqueue(job)
        looked = time.monotonic()
        while self._wanted():
            still_open = self._store.photos.cells(photo.public_id, photo.epoch)
            if not still_open:
                return
            if time.monotonic() - looked > LOOK_AFTER_S:
                looked = time.monotonic()
                for cell in still_open:
                    self._look_after(cell, jobs.get(cell))
            time.sleep(WAIT_S)
        raise NotWantedError

    def _look_after(self, cell: int, job: Job | None) -> None:
        """Repair a cell whose job the engine lost, or gave up after it killed its workers."""
        if job is None:
            return
        photo = self._photo
        status = self._engine.status(job)
        if status == "unknown":
            self._engine.enqueue(job)
        elif status in {"done", "lost"}:
            self._store.photos.fail_patches(photo.public_id, photo.epoch, "crashed_repeatedly", cell=cell)

    def count(self) -> None:
        """Count the photo, if enough of its patches gave a PSF, and not all in one place."""
        photo = self._photo
        rows = self._store.photos.patches(photo.public_id, photo.epoch)
        tried = [row for row in rows if row.cell is not None]
        done = [row for row in tried if row.state == "done"]
        if done:
            try:
                sampling.require_spread([_patch_of(row) for row in done], count=self._preset.patches)
            except NoUsablePatchesError as error:
                raise JobFailedError(error.code, str(error)) from error
        if not done:
            raise JobFailedError(*_why_not(tried, len(done)))
        self._finish()

    def _finish(self) -> None:
        version = self._store.photos.finish(self._photo.public_id, self._photo.epoch)
        if version is not None:
            log.info("photo %s counted, lens version %d", self._photo.public_id, version)


class _Measured(_Steps):
    """A photo that was made to measure the lens: one task measures all over it."""

    def select(self) -> None:
        """Measure; the places are the patches, and their samples are there at once."""
        # A repeated call adds nothing twice
        photo, settings = self._photo, self._context.settings
        folders = [self._developed, *self._reference()]
        arguments = {
            "kind": photo.given["kind"],
            "developed": [str(folder) for folder in folders],
            "photo": photo.public_id,
            "settings": stored_settings(photo),
            "size": self._preset.kernel_size,
        }
        limits = self._context.limits(photo, settings.task_seconds, _MEASURING)
        with self._context.sandbox.folder() as folder:
            listed = self._context.attempt(
                "measure-lens", arguments, folder=folder, limits=limits, wanted=self._wanted, reads=folders
            )
            patches, samples = _measured(listed, folder)
        photos, which = self._store.photos, (photo.public_id, photo.epoch)
        photos.plan_patches(*which, patches)
        photos.set_state(photo.public_id, ("selecting",), "estimating", epoch=photo.epoch)
        photos.add_samples(*which, samples)

    def _reference(self) -> list[Path]:
        """Return the folder of the developed closed photo of a pair."""
        name, photos = self._photo.given.get("reference_id"), self._store.photos
        if name is None:
            return []
        row, end = photos.get(name, ANY_OWNER), time.monotonic() + WAIT_FOR_REFERENCE_S
        while row is not None and row.state in _UNREAD and time.monotonic() < end and self._wanted():
            time.sleep(WAIT_S)
            row = photos.get(name, ANY_OWNER)
        if row is None or row.owner_id != self._photo.owner_id:
            raise JobFailedError(
                "unknown_photo", f"the reference photo {name} is not there any more; send both photos again"
            )
        if row.width is None:
            raise JobFailedError(
                "not_ready", f"the reference photo {name} was not read yet; send the open photo again"
            )
        return [self._context.developed(row, self._wanted)]

    def estimate(self) -> None:
        """Nothing is left to estimate."""

    def count(self) -> None:
        """Count it: it states its own error, and one place is enough."""
        self._finish()


# States of a photo that is being worked on, with the one that comes before each
_BEFORE: Final[Mapping[str, str]] = {
    "developing": "inspecting",
    "selecting": "developing",
    "estimating": "selecting",
}


def _row(store: Store, photo_id: str) -> PhotoRow:
    photo = store.photos.get(photo_id, ANY_OWNER)
    if photo is None:
        raise NotWantedError
    return photo


def _begun(store: Store, photo_id: str, epoch: int) -> PhotoRow:
    """Take up a photo: a new one, or one that another worker left."""
    photos = store.photos
    started = {"started_at": datetime.now(UTC), "attempt": 1}
    if not photos.set_state(photo_id, ("received",), "inspecting", epoch=epoch, **started):
        state = _row(store, photo_id).state
        attempt = PhotoRow.attempt + 1
        if state not in PHOTO_RUNNING or not photos.set_state(
            photo_id, (state,), state, epoch=epoch, attempt=attempt
        ):
            raise NotWantedError
    return _row(store, photo_id)


def _checked(listed: Any, folder: Path, places: Mapping[int, FieldPosition]) -> list[NewSample]:  # noqa: ANN401 - a child's JSON
    """Validate the samples of a child as untrusted input; they lie where their patches do."""
    try:
        samples = returned_samples(folder, count=len(listed))
        return [
            NewSample(number, replace(sample, position=places[number]))
            for number, sample in zip(listed, samples, strict=True)
        ]
    except DAMAGED as error:
        raise JobFailedError("internal_error", f"the estimator gave no kernel: {error}") from error


def _missing(photo: PhotoRow, *, lens_known: bool) -> str:
    """Return what the owner must supply before the photo can count; empty if nothing."""
    if not lens_known:
        model = photo.lens_model or "unknown model"
        return (
            f"the photo does not say which copy of a lens took it ({model}): choose a lens, give its "
            "serial with the model, or name a new one"
        )
    if photo.aperture is None:
        return "the photo does not say its aperture: give the f-number"
    return ""


def _patch_of(row: PatchRow) -> Patch:
    """Return a patch as a value of the library."""
    return Patch(row.row, row.col, row.size, FieldPosition(row.r, row.phi), row.score or 0.0, row.cell or 0)


def _why_not(tried: list[PatchRow], good: int) -> tuple[str, str]:
    """Return why a photo with `good` useful patches does not count: a code and a sentence."""
    failures = Counter(row.reason for row in tried if row.state == "failed")
    if failures and good == 0:
        reason, count = failures.most_common(1)[0]
        text = f"{count} of {len(tried)} patches ended with {reason}; retry, or report the file"
        return reason or "internal_error", text
    return (
        "no_usable_patches",
        f"{good} of {len(tried)} patches gave a PSF: use a photo with more fine detail in focus",
    )


def _measured(listed: Any, folder: Path) -> tuple[list[NewPatch], list[NewSample]]:  # noqa: ANN401 - a child's JSON
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


def _read_profile(context: JobContext, file: PhotoRow) -> None:
    """Let the samples of a profile join the lens that `file` names."""
    store, settings = context.store, context.settings

    def wanted() -> bool:
        return store.photos.is_live(file.public_id, file.epoch)

    limits = TaskLimits(
        memory_mb=SPARE_MB + COPIES * (MAX_UNPACKED >> 20), wall_s=settings.develop_seconds, scratch_mb=1024
    )
    with context.original(file) as path, context.sandbox.folder() as folder:
        arguments = {"path": str(path), "max_unpacked": MAX_UNPACKED}
        try:
            answer = context.attempt(
                "profile",
                arguments,
                folder=folder,
                limits=limits,
                wanted=wanted,
                reads=[path],
            )
        except JobFailedError as error:
            if error.code != "invalid_parameter":
                raise
            raise JobFailedError("malformed_upload", error.detail) from error
        read = checked(ReadProfile, answer)
        try:
            samples = returned_samples(folder, count=read["samples"])
        except DAMAGED as error:
            raise JobFailedError("internal_error", f"the profile gave no kernels: {error}") from error
    lens = store.lenses.get(file.given["lens_id"], ANY_OWNER)
    if lens is None:
        raise JobFailedError("unknown_lens", "the lens was deleted meanwhile: send the profile to another")
    mode = configured_preset(settings).mode
    if read["mode"] != mode:
        text = f"the profile was learned with the model {read['mode']}, and the service uses {mode}"
        raise JobFailedError("conflict", f"{text}: use it on the command line")
    if not file.given.get("any_lens"):
        focals = store.lenses.coverage_of([lens])[lens.id][1]
        named = {name: read["lens"].get(name) for name in ("maker", "model", "serial")}
        other = Described(**named, focals_mm={s.settings.focal_mm for s in samples if s.settings.focal_mm})
        why = difference(Described(lens.maker, lens.model, lens.serial, focals_mm=focals), other)
        if why is not None:
            raise JobFailedError("other_lens", f"the profile seems to be of another lens: {why}; {REMEDY}")
    names = {key: name for key, name in read["photos"].items() if name.isprintable()}
    if store.photos.take_in(file, samples, names) is None:
        raise NotWantedError
