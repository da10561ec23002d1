"""The jobs: learning from photos, reading profiles, correcting photos, measuring models of lenses.

Each step of a photo reads the tables first and does only what is not done yet. So the job may be started
again at any time, by any worker, and still every effect happens once.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import wait
from contextlib import contextmanager
from contextvars import copy_context
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePath
from typing import Any, Final

from app.errors import OTHER_LENS_REMEDY
from app.jobs.answers import (
    CLEANED,
    LAYER_FILES,
    REPORT,
    SIDES,
    SUFFIX,
    THUMBNAIL,
    JobFailedError,
    NotWantedError,
)
from app.jobs.context import MAX_UNPACKED, JobContext, Wanted
from app.jobs.sample_files import DAMAGED, returned_samples
from app.runtime.outage import is_outage, missable
from app.runtime.settings import Settings
from app.store import LensName
from app.store.lenses import LensState, report_key
from app.store.owners import ANY_OWNER
from app.store.photos import stored_settings
from app.store.tables import PHOTO_RUNNING, PROFILE_FILE, CorrectionRow, LensRow, PatchRow, PhotoRow
from lensmodel.blind import sampling
from lensmodel.blind.sampling import KERNEL_PATCHES, PRESETS, Config
from lensmodel.core.errors import InvalidInputError, NoSamplesError, NoUsablePatchesError
from lensmodel.core.files import to_json
from lensmodel.core.names import full_name, name_key, serial_key
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import CHANNELS, FieldPosition
from lensmodel.correction import Bounds
from lensmodel.model.identity import Identity, difference
from lensmodel.patches import Patch

log = logging.getLogger(__name__)

# Who chooses the patches of a photo that names nobody, of `lensmodel.patches.selectors`
SELECTOR: Final = "r-map"
# Seconds between two looks whether a photo is inspected (chosen): a look is one query
WAIT_S: Final = 0.2
# How long the open photo of a pair waits until the closed one is inspected (chosen): that takes seconds,
# unless many photos are before it
WAIT_FOR_REFERENCE_S: Final = 60.0
# Most places of a measurement (chosen): no method has so many cells, a child that returns more is broken
MAX_PLACES: Final = 1000
POOR: Final = "not-enough-evidence"  # reason of patches that gave no PSF
# What the library refuses because of the patches of a cell
_OF_PATCHES: Final = frozenset({"no_samples", "no_usable_patches", "invalid_parameter"})

# Fields of a header that have columns of the same name
_COLUMNS: Final = (
    *("camera_maker", "camera_model", "aperture", "focal_mm", "focus_m", "pixel_pitch_um", "orientation"),
)

MEDIA_TYPE: Final = {".tif": "tiff", ".png": "png", ".jpg": "jpeg", ".dng": "x-adobe-dng"}


def configured_preset(settings: Settings) -> Config:
    """Return the default preset, as far as the settings do not change it."""
    preset = PRESETS["default"]
    own = settings.estimator != preset.estimator
    patches = settings.patches or (KERNEL_PATCHES if own else preset.patches)
    return replace(preset, estimator=settings.estimator, patches=patches)


def work_on(context: JobContext, photo_id: str, epoch: int) -> None:
    """Take a photo through all steps, as far as it can get."""
    photo = context.store.photos.start(photo_id, epoch)
    if photo is None:
        return
    if photo.kind == PROFILE_FILE:
        _read_profile(context, photo)
    else:
        _Steps(context, photo).run()


def read_ahead(context: JobContext, photo: PhotoRow) -> None:
    """Read a photo before its turn: its owner may have to say which lens it was, or to send another file."""
    try:
        _Steps(context, photo).inspect()
    except NotWantedError:
        pass
    except JobFailedError as error:  # work that has begun since finds its own errors
        why = {"error_code": error.code, "error_detail": error.detail}
        context.store.photos.set_state(photo.public_id, (photo.state,), "failed", epoch=photo.epoch, **why)


class _Steps:
    """The work on a photo by rows and tasks: each step does only what the tables do not have yet."""

    def __init__(self, context: JobContext, photo: PhotoRow) -> None:
        self._context, self._photo = context, photo
        self._photos, self._wanted = context.store.photos, context.wants(photo)
        self._preset = configured_preset(context.settings)
        self._which = photo.public_id, photo.epoch

    def run(self) -> None:
        """Take the photo through all steps."""
        if self._photo.state == "inspecting" and not self.inspect():
            return
        self._enter("developing")
        developed = self._context.developed(self._photo)
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

    def inspect(self) -> bool:
        """Read the header and assign the lens; return whether to go on and calibrate it."""
        photo, states = self._photo, (self._photo.state,)
        if photo.epoch > 1 or not photo.width:  # else it was read before its turn, or by a worker that died
            self._photo = photo = inspect(self._context, photo)
        if not photo.calibrate:
            self._move(states, "stored")
            return False
        missing = _missing(photo)
        if missing:
            why = {"error_code": "metadata_missing", "error_detail": missing}
            self._move(states, "needs_lens", **why)
        return not missing

    def _select(self, developed: Path) -> None:
        """Choose the patches, and measure the lateral colour."""
        photo = self._photo
        try:
            with self._context.task(
                "select",
                photo,
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
        left, reason = {row.idx for row in rows}, POOR
        try:
            samples = self._samples(rows)
            self._photos.add_samples(*self._which, samples)
            left -= {number for number, _ in samples}
        except Exception as error:
            if is_outage(error) or isinstance(error, NotWantedError):
                raise
            code = error.code if isinstance(error, JobFailedError) else "internal_error"
            reason = POOR if code in _OF_PATCHES else code
            known = isinstance(error, JobFailedError)
            text = f"cell {rows[0].cell} of photo {self._which[0]}: {code}: {error}"
            log.info(text, exc_info=None if known else error)
        if left:
            self._photos.reject_patches(*self._which, reason, sorted(left))

    def _samples(self, rows: Sequence[PatchRow]) -> list[tuple[int, PsfSample]]:
        """Return the samples of some patches; they lie where their patches do, whatever a child says."""
        places = {row.idx: FieldPosition(row.r, row.phi) for row in rows}
        developed = self._context.developed(self._photo)
        with (
            self._context.task(
                "estimate",
                self._photo,
                reads=[developed],
                developed=str(developed),
                photo=self._photo.public_id,
                patches=[to_json(_patch_of(row)) for row in rows],
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
            code, text = "no_usable_patches", "gave a PSF: use a photo with more fine detail in focus"
            text = f"0 of {len(tried)} patches {text}"
            failures = Counter(row.reason or "internal_error" for row in tried if row.reason != POOR)
            for code, count in failures.most_common(1):
                text = f"{count} of {len(tried)} patches ended with {code}; retry, or report the file"
            raise JobFailedError(code, text)
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
        while row and row.owner_id == self._photo.owner_id and not row.width and self._wanted():
            if row.state not in {"received", "inspecting"} or time.monotonic() > end:
                break
            time.sleep(WAIT_S)
            row = self._photos.get(name, ANY_OWNER)
        if row is None or row.owner_id != self._photo.owner_id:
            text = f"the reference photo {name} is not there any more; send both photos again"
            raise JobFailedError("unknown_photo", text)
        if row.width is None:
            text = f"the reference photo {name} was not read yet; send the open photo again"
            raise JobFailedError("not_ready", text)
        return [self._context.developed(row, self._wanted)]


def _missing(photo: PhotoRow) -> str:
    """Return what the owner must supply before the photo can count; empty if nothing."""
    if photo.lens is None:
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
        task = context.task("profile", file, reads=[path], path=str(path), max_unpacked=most)
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
    mode = configured_preset(context.settings).model
    if read["mode"] != mode:
        text = f"the profile was learned with the model {read['mode']}, and the service uses {mode}"
        raise JobFailedError("conflict", f"{text}: use it on the command line")
    own = {s.settings.focal_mm for s in samples if s.settings.focal_mm}
    if not file.given.get("any_lens"):
        focals = store.lenses.coverage_of([lens])[lens.id][1]
        why = difference(Identity(lens.names, focals_mm=focals), Identity(read["lens"], focals_mm=own))
        if why is not None:
            text = f"the profile seems to be of another lens: {why}; {OTHER_LENS_REMEDY}"
            raise JobFailedError("other_lens", text)
    names = {key: name for key, name in read["photos"].items() if name.isprintable()}
    called = _called(read["lens"], read["cameras"], own) if file.given.get("rename") else ""
    if not store.photos.take_in(file, samples, names, called if called.isprintable() else ""):
        raise NotWantedError


def _called(lens: Mapping[str, str], cameras: Sequence[str], focals_mm: Collection[float]) -> str:
    """Return what a profile calls its lens, else its camera and focal length; empty if it says neither."""
    name = lens.get("label") or full_name(lens.get("maker"), lens.get("model"))
    taken_with = [*cameras, *(f"{focal:g} mm" for focal in focals_mm if len(focals_mm) == 1)]
    return (name or ", ".join(taken_with if len(cameras) == 1 else []))[:200].strip()


def inspect(context: JobContext, photo: PhotoRow) -> PhotoRow:
    """Remove the place from the file of a photo, record its header, and store a small picture of it."""
    settings = context.settings
    most = settings.max_megapixels
    with context.original(photo) as path:
        _remove_place(context, photo, path)
        task = context.task("inspect", photo, reads=[path], path=str(path), max_megapixels=most)
        with task as (info, folder):
            context.keep(f"{photo.folder}{THUMBNAIL}", folder / THUMBNAIL)
    metadata = info["metadata"]
    camera = (metadata["camera_maker"], metadata["camera_model"])
    recorded = context.store.photos.record_inspection(
        photo.public_id,
        LensName(**metadata["lens"]),
        single_copy=settings.assume_single_copy,
        width=info["width"],
        height=info["height"],
        body_key=body_key(*camera, metadata.get("body_serial")),
        **{name: metadata[name] for name in _COLUMNS},
    )
    if recorded is None:
        raise NotWantedError
    return recorded


def remove_location(context: JobContext, photo: PhotoRow) -> None:
    """Remove the place from the file of a photo on which nobody works, once."""
    try:
        with context.original(photo) as path:
            _remove_place(context, photo, path, lambda: True)
    except JobFailedError:  # its file is lost, which the doctor reports
        context.store.photos.record_location(photo, "unknown")


def _remove_place(context: JobContext, photo: PhotoRow, path: Path, wanted: Wanted | None = None) -> None:
    """Have a child search a hostile file; its copy without the place becomes that of the photo."""
    # The copy, of the same length, gets a key of its own: blobs never change, so that a backup need not look
    # into them
    if photo.location is not None:
        return
    said, new = "unknown", {}
    try:
        with context.task("locate", photo, wanted, reads=[path], path=str(path)) as (answer, folder):
            said, cleaned = answer["location"], folder / CLEANED
            if cleaned.is_file() and cleaned.stat().st_size == photo.byte_size:
                with cleaned.open("rb") as file:
                    digest = hashlib.file_digest(file, "sha256").hexdigest()
                new = {"key": f"{photo.folder}cleaned-{digest[:16]}", "digest": digest}
                context.storage.put(new["key"], cleaned)
            elif said == "removed":  # without a copy that is without it
                said = "unknown"
    except JobFailedError as error:
        log.warning("photo %s was not searched for its place: %s", photo.public_id, error.detail)
    context.store.photos.record_location(photo, said, **new)


def body_key(maker: str | None, model: str | None, serial: str | None) -> str | None:
    """Return a digest of a camera's name and serial; None without a serial."""
    if not serial:
        return None
    identity = "|".join((name_key(maker), name_key(model), serial_key(serial)))
    return hashlib.sha256(identity.encode()).hexdigest()[:16]


def correct(context: JobContext, correction_id: str, epoch: int) -> None:
    """Make the corrected file."""
    jobs = context.store.jobs
    row = jobs.start(correction_id, epoch)
    if row is None:
        return
    photo, params, wanted = row.photo, row.params, partial(jobs.is_live, correction_id, epoch)
    jobs.progress(row, 0, 0, "developing")
    developed = context.developed(photo, wanted)
    jobs.progress(row, 0, 0)
    _, samples = _samples_of(context, row.lens_public_id, row.lens_version)

    bounds = {name: params[name] for name in ("halo", "texture", "denoise") if name in params}

    def tell(done: int, total: int) -> None:
        with missable():
            jobs.progress(row, done, total)

    with context.task(
        "correct",
        photo,
        wanted,
        reads=[developed],
        samples=samples,
        on_progress=tell,
        developed=str(developed),
        photo=photo.public_id,
        # as they were when the correction was requested
        settings=params.get("settings") or stored_settings(photo),
        lateral=photo.lateral,
        params=params,
        workers=context.settings.worker_slots,
        bounds=bounds,
        description=(
            f"lens blur corrected by lensmodel: {_name(row.lens, 'unknown lens')}, version "
            f"{row.lens_version}, method {params['method']}, strength {params['strength']:g}"
            f"{Bounds(**bounds).described}"
        ),
        lens=(row.lens and row.lens.label) or "",
    ) as (done, folder):
        _store_result(context, row, folder / Path(done["file"]).name, done["report"])


def _samples_of(context: JobContext, lens_id: str, version: int) -> tuple[LensState, list[PsfSample]]:
    try:
        state, samples = context.store.lenses.samples_of(lens_id, up_to_version=version)
    except NoSamplesError as error:
        raise JobFailedError(error.code, str(error)) from error
    if not samples:
        text = f"version {version} of lens {lens_id} has no samples any more; ask for the newest version"
        raise JobFailedError("no_samples", text)
    return state, samples


def _store_result(context: JobContext, row: CorrectionRow, path: Path, report: dict[str, Any]) -> None:
    if path.suffix != SUFFIX[row.params["output"]["format"]] or not path.is_file():
        raise JobFailedError("internal_error", "the correction wrote no file; retry, or report the photo")
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    base, storage = row.run_folder, context.storage
    key = f"{base}result{path.suffix}"
    storage.put(key, path)
    shown = [path.parent / picture for picture in (*SIDES.values(), *LAYER_FILES.values())]
    shown = [picture for picture in shown if picture.is_file()]
    for picture in shown:
        storage.put(f"{base}{picture.name}", picture)
    name = f"{PurePath(row.photo.filename).stem or 'photo'}-corrected{path.suffix}"
    about = {"key": key, "etag": digest, "media_type": f"image/{MEDIA_TYPE[path.suffix]}", "name": name}
    size, beside = path.stat().st_size, sum(picture.stat().st_size for picture in shown)
    if not context.store.jobs.finish(row, report, bytes=size, shown_bytes=beside, **about):
        storage.delete(base)  # cancelled, deleted or begun again: nobody else writes there


def measure(context: JobContext, lens_id: str, version: int) -> None:
    """Note the errors that one version of a lens expects, and write its report."""
    lenses = context.store.lenses
    lens = lenses.get(lens_id, ANY_OWNER)
    if lens is None:
        return

    def newest() -> bool:  # reports of earlier versions have been deleted
        now = lenses.state_of(lens_id, ANY_OWNER)
        return now is not None and now.version == version

    state, samples = _samples_of(context, lens_id, version)
    height, width = lenses.shape_of(lens) or (2, 3)
    about = {
        "name": _name(lens, "Unknown lens"),
        "aspect": width / height,
        "height_px": height if height > 2 else None,
    }
    with context.task("measure", None, newest, samples=samples, about=about) as (metrics, folder):
        context.keep(report_key(lens_id, version, state.rebuild_epoch), folder / REPORT)
    lenses.record_metrics(lens_id, version, metrics)


def _name(lens: LensRow | None, otherwise: str) -> str:
    return otherwise if lens is None else lens.label or full_name(lens.maker, lens.model) or otherwise
