"""The job of a photo: inspect, identify the lens, develop, choose patches, estimate PSFs, count.

Each step reads the tables first and does only what is not done yet. So the job may be started again at any
time, by any worker, and still every effect happens once.
"""

from __future__ import annotations

import logging
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import wait
from contextlib import contextmanager
from contextvars import copy_context
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from app.errors import OTHER_LENS_REMEDY
from app.jobs import inspection
from app.jobs.answers import JobFailedError, NotWantedError
from app.jobs.context import MAX_UNPACKED, JobContext
from app.jobs.sample_files import DAMAGED, returned_samples
from app.presets import configured_preset
from app.store.owners import ANY_OWNER, now
from app.store.photos import stored_settings
from app.store.tables import PHOTO_RUNNING, PROFILE_FILE, PatchRow, PhotoRow
from lensmodel.core import codec
from lensmodel.core.errors import InvalidInputError, NoUsablePatchesError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import CHANNELS, FieldPosition
from lensmodel.patches import Patch
from lensmodel.workflow import sampling
from lensmodel.workflow.identity import Identity, difference

log = logging.getLogger(__name__)

# Who chooses the patches of a photo that names nobody, of `lensmodel.patches.selectors`
SELECTOR: Final = "r-map"
# Seconds between two looks whether a photo is inspected (chosen): a look is one query
WAIT_S: Final = 0.2
# Most places of a measurement (chosen): no method has so many cells, a child that returns more is broken
MAX_PLACES: Final = 1000
# How long the open photo of a pair waits until the closed one is inspected (chosen): that takes seconds,
# unless many photos are before it
WAIT_FOR_REFERENCE_S: Final = 60.0
POOR: Final = "not-enough-evidence"  # reason of patches that gave no PSF
# What the library refuses because of the patches of a cell
_OF_PATCHES: Final = frozenset({"no_samples", "no_usable_patches", "invalid_parameter"})


def work_on(context: JobContext, photo_id: str, epoch: int) -> None:
    """Take a photo through all steps, as far as it can get."""
    photo = context.store.photos.start(photo_id, epoch)
    if photo is None:
        return
    if photo.kind == PROFILE_FILE:
        _read_profile(context, photo)
    else:
        _Steps(context, photo).run()


class _Steps:
    """The work on a photo by rows and tasks: each step does only what the tables do not have yet."""

    def __init__(self, context: JobContext, photo: PhotoRow) -> None:
        self._context, self._photo = context, photo
        self._photos, self._wanted = context.store.photos, context.wants(photo)
        self._preset = configured_preset(context.settings)
        self._which = photo.public_id, photo.epoch

    def run(self) -> None:
        """Take the photo through all steps."""
        if self._photo.state == "inspecting" and not self._inspect():
            return
        self._enter("developing")
        developed = self._context.developed(self._photo, self._wanted)
        self._enter("selecting")
        if self._photo.given.get("kind"):
            self._measure(developed)  # made for it: one place is enough
        else:
            if not self._photos.patches(*self._which):
                self._select(developed)
            self._enter("estimating")
            self._estimate()
            self._check()
        version = self._photos.finish(*self._which)
        if version is not None:
            log.info("photo %s counted, lens version %d", self._photo.public_id, version)

    def _move(self, states: Sequence[str], state: str, **fields: object) -> bool:
        photo_id, epoch = self._which
        return self._photos.set_state(photo_id, states, state, epoch=epoch, **fields)

    def _enter(self, stage: str) -> None:
        """Move to the next state; a photo that is already further stays there."""
        if not self._move(PHOTO_RUNNING[: PHOTO_RUNNING.index(stage) + 1], stage) and not self._wanted():
            raise NotWantedError

    def _inspect(self) -> bool:
        """Read the header and assign the lens; return whether to go on and calibrate it."""
        inspection.inspect(self._context, self._photo, self._wanted)
        single = self._context.settings.assume_single_copy
        lens = self._photos.assign_lens(self._photo.public_id, single_copy=single)
        photo = self._photos.get(self._photo.public_id, ANY_OWNER)
        if photo is None:
            raise NotWantedError
        self._photo = photo
        if not photo.calibrate:
            self._move(("inspecting",), "stored", finished_at=now())
            return False
        missing = _missing(photo, lens_known=lens is not None)
        if missing:
            why = {"error_code": "metadata_missing", "error_detail": missing}
            self._move(("inspecting",), "needs_lens", **why)
        return not missing

    def _select(self, developed: Path) -> None:
        """Choose the patches, and measure the lateral colour."""
        photo = self._photo
        try:
            with self._context.task(
                "select",
                photo,
                self._wanted,
                reads=[developed],
                developed=str(developed),
                count=self._preset.patches,
                estimator=self._preset.estimator,
                selector=photo.given.get("selector") or SELECTOR,
            ) as (selection, _):
                pass
        except JobFailedError as error:
            if error.code != "invalid_parameter":
                raise
            size = f"{photo.width}x{photo.height}"
            text = f"the photo of {size} pixels is too small to tell about its lens; send it in full size"
            raise JobFailedError("no_usable_patches", text) from error
        if selection["lateral"] is not None:
            self._photos.record_lateral(*self._which, selection["lateral"])
        self._photos.plan_patches(*self._which, selection["patches"], selection["rejected"])

    def _estimate(self) -> None:
        """Estimate in each cell with open patches; the cells of all photos of a worker share its slots."""
        cells: defaultdict[int | None, list[PatchRow]] = defaultdict(list)
        for row in self._photos.patches(*self._which):
            if row.state == "pending":
                cells[row.cell].append(row)
        run = self._context.cells.submit  # each in a copy of what the log tells of this job
        jobs = [run(copy_context().run, self._estimate_cell, rows) for rows in cells.values()]
        try:
            for job in jobs:
                job.result()
        finally:  # should one have failed, none may still run when all are tried again
            for job in jobs:
                job.cancel()
            wait(jobs)

    def _estimate_cell(self, rows: Sequence[PatchRow]) -> None:
        poor = {row.idx for row in rows}
        try:
            samples = self._samples(rows)
        except JobFailedError as error:
            log.info("cell %s of photo %s: %s: %s", rows[0].cell, self._which[0], error.code, error.detail)
            if error.code not in _OF_PATCHES:
                self._photos.fail_patches(*self._which, error.code, sorted(poor))
                return
        else:
            self._photos.add_samples(*self._which, samples)
            poor -= {number for number, _ in samples}
        if poor:
            self._photos.fail_patches(*self._which, POOR, sorted(poor), rejected=True)

    def _samples(self, rows: Sequence[PatchRow]) -> list[tuple[int, PsfSample]]:
        """Return the samples of some patches; they lie where their patches do, whatever a child says."""
        places = {row.idx: FieldPosition(row.r, row.phi) for row in rows}
        developed = self._context.developed(self._photo, self._wanted)
        with (
            self._context.task(
                "estimate",
                self._photo,
                self._wanted,
                reads=[developed],
                developed=str(developed),
                photo=self._photo.public_id,
                patches=[codec.to_json(_patch_of(row)) for row in rows],
                numbers=[row.idx for row in rows],
                settings=stored_settings(self._photo),
                estimator=self._preset.estimator,
                size=self._preset.kernel_size,
            ) as (listed, folder),
            _validated("estimator"),
        ):
            samples = returned_samples(folder, count=len(listed))
            return [
                (number, replace(sample, position=places[number]))
                for number, sample in zip(listed, samples, strict=True)
            ]

    def _check(self) -> None:
        """Make sure that enough of the patches gave a PSF, and not all in one place."""
        tried = self._photos.patches(*self._which)
        done = [_patch_of(row) for row in tried if row.state == "done"]
        if not done:
            raise JobFailedError(*_why_none(tried))
        try:
            sampling.require_spread(done, count=self._preset.patches)
        except NoUsablePatchesError as error:
            raise JobFailedError(error.code, str(error)) from error

    def _measure(self, developed: Path) -> None:
        """Measure all over the photo by one task; the places are the patches, and their samples are there."""
        # A repeated call adds nothing twice
        photo, folders = self._photo, [developed, *self._reference()]
        with self._context.task(
            "measure-lens",
            photo,
            self._wanted,
            reads=folders,
            kind=photo.given["kind"],
            developed=[str(folder) for folder in folders],
            photo=photo.public_id,
            settings=stored_settings(photo),
            size=self._preset.kernel_size,
        ) as (listed, folder):
            patches, samples = _measured(listed, folder)
        self._photos.plan_patches(*self._which, patches, [])
        self._enter("estimating")
        self._photos.add_samples(*self._which, samples)

    def _reference(self) -> list[Path]:
        """Return the folder of the developed closed photo of a pair."""
        name = self._photo.given.get("reference_id")
        if name is None:
            return []
        row, end = self._photos.get(name, ANY_OWNER), time.monotonic() + WAIT_FOR_REFERENCE_S
        unread = ("received", "inspecting")
        while row is not None and row.state in unread and time.monotonic() < end and self._wanted():
            time.sleep(WAIT_S)
            row = self._photos.get(name, ANY_OWNER)
        if row is None or row.owner_id != self._photo.owner_id:
            text = f"the reference photo {name} is not there any more; send both photos again"
            raise JobFailedError("unknown_photo", text)
        if row.width is None:
            text = f"the reference photo {name} was not read yet; send the open photo again"
            raise JobFailedError("not_ready", text)
        return [self._context.developed(row, self._wanted)]


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


def _why_none(tried: Sequence[PatchRow]) -> tuple[str, str]:
    """Return why a photo without a useful patch does not count: a code and a sentence."""
    failures = Counter(row.reason or "internal_error" for row in tried if row.state == "failed")
    if failures:
        reason, count = failures.most_common(1)[0]
        return reason, f"{count} of {len(tried)} patches ended with {reason}; retry, or report the file"
    text = f"0 of {len(tried)} patches gave a PSF: use a photo with more fine detail in focus"
    return "no_usable_patches", text


@contextmanager
def _validated(source: str) -> Iterator[None]:
    """Treat what a child wrote as untrusted: what is not as it should be ends the job."""
    try:
        yield
    except DAMAGED as error:
        raise JobFailedError("internal_error", f"the {source} gave no kernels: {error}") from error


def _measured(listed: Any, folder: Path) -> tuple[list[dict[str, Any]], list[tuple[int, PsfSample]]]:  # noqa: ANN401 - a child's JSON
    """Return the places and the samples of a measurement."""
    patches: list[dict[str, Any]] = []
    samples = []
    with _validated("measurement"):
        if not 0 < len(listed) <= MAX_PLACES * len(CHANNELS):
            raise InvalidInputError(f"{len(listed)} samples")
        for sample, entry in zip(returned_samples(folder, count=len(listed)), listed, strict=True):
            number, error, place = int(entry["idx"]), sample.error, sample.position
            if error is None or not error <= 1.0 or not 0 <= number <= len(patches) < MAX_PLACES:
                raise InvalidInputError(f"a sample of place {number} with error {error}")
            if number == len(patches):
                row, col, side = (int(entry[name]) for name in ("row", "col", "side"))
                window = {"row": row, "col": col, "size": side, "r": place.r, "phi": place.phi}
                patches.append({**window, "cell": number, "score": 1.0 - error})
            samples.append((number, sample))
    return patches, samples


def _read_profile(context: JobContext, file: PhotoRow) -> None:
    """Let the samples of a profile join the lens that `file` names."""
    store, most = context.store, MAX_UNPACKED
    with context.original(file) as path:
        task = context.task(
            "profile", file, context.wants(file), reads=[path], path=str(path), max_unpacked=most
        )
        try:
            with task as (read, folder), _validated("profile"):
                samples = returned_samples(folder, count=read["samples"])
        except JobFailedError as error:
            if error.code != "invalid_parameter":
                raise
            raise JobFailedError("malformed_upload", error.detail) from error
    lens = store.lenses.get(file.given["lens_id"], ANY_OWNER)
    if lens is None:
        raise JobFailedError("unknown_lens", "the lens was deleted meanwhile: send the profile to another")
    mode = configured_preset(context.settings).mode
    if read["mode"] != mode:
        text = f"the profile was learned with the model {read['mode']}, and the service uses {mode}"
        raise JobFailedError("conflict", f"{text}: use it on the command line")
    if not file.given.get("any_lens"):
        focals = store.lenses.coverage_of([lens])[lens.id][1]
        own = {s.settings.focal_mm for s in samples if s.settings.focal_mm}
        why = difference(Identity(lens.names, focals_mm=focals), Identity(read["lens"], focals_mm=own))
        if why is not None:
            text = f"the profile seems to be of another lens: {why}; {OTHER_LENS_REMEDY}"
            raise JobFailedError("other_lens", text)
    names = {key: name for key, name in read["photos"].items() if name.isprintable()}
    if not store.photos.take_in(file, samples, names):
        raise NotWantedError
