"""Jobs of corrections, and of measuring lens models."""

from __future__ import annotations

import hashlib
import time
from functools import partial
from pathlib import Path, PurePath
from typing import Any, Final

from app.jobs.answers import JobFailedError
from app.jobs.context import JobContext
from app.jobs.task_files import LAYER_FILES, REPORT, SIDES, SUFFIX
from app.runtime.outage import missable
from app.sandbox.child import ProgressHook
from app.store.lenses import report_key
from app.store.owners import ANY_OWNER
from app.store.photos import stored_settings
from app.store.samples import LensState
from app.store.tables import CorrectionRow, LensRow
from lensmodel.core.errors import NoSamplesError
from lensmodel.core.names import full_name
from lensmodel.core.psf import PsfSample
from lensmodel.correction import Bounds

MEDIA_TYPE: Final = {
    ".tif": "image/tiff",
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".dng": "image/x-adobe-dng",
}
PROGRESS_S: Final = 0.5  # seconds between two writes of the progress (chosen): each is a transaction


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
    _, samples = _samples(context, row.lens_public_id, row.lens_version)
    bounds = {name: params[name] for name in ("halo", "texture", "denoise") if name in params}
    with context.task(
        "correct",
        photo,
        wanted,
        reads=[developed],
        samples=samples,
        on_progress=_progress_of(context, row),
        developed=str(developed),
        photo=photo.public_id,
        # as they were when the correction was requested
        settings=params.get("settings") or stored_settings(photo),
        lateral=photo.lateral,
        method=params["method"],
        strength=params["strength"],
        bounds=bounds,
        output=params["output"],
        roi=params.get("roi"),
        layers=params.get("layers", False),
        workers=context.settings.worker_slots,
        description=(
            f"lens blur corrected by lensmodel: {_name(row.lens, 'unknown lens')}, version "
            f"{row.lens_version}, method {params['method']}, strength {params['strength']:g}"
            f"{Bounds(**bounds).described}"
        ),
        lens=(row.lens and row.lens.label) or "",
    ) as (done, folder):
        _store_result(context, row, folder / Path(done["file"]).name, done["report"])


def _samples(context: JobContext, lens_id: str, version: int) -> tuple[LensState, list[PsfSample]]:
    try:
        state, samples = context.store.lenses.samples_of(lens_id, up_to_version=version)
    except NoSamplesError as error:
        raise JobFailedError(error.code, str(error)) from error
    if not samples:
        text = f"version {version} of lens {lens_id} has no samples any more; ask for the newest version"
        raise JobFailedError("no_samples", text)
    return state, samples


def _progress_of(context: JobContext, row: CorrectionRow) -> ProgressHook:
    last = 0.0

    def tell(done: int, total: int) -> None:
        nonlocal last
        if time.monotonic() - last > PROGRESS_S or done == total:
            last = time.monotonic()
            with missable():
                context.store.jobs.progress(row, done, total)

    return tell


def _store_result(context: JobContext, row: CorrectionRow, path: Path, report: dict[str, Any]) -> None:
    if path.suffix != SUFFIX[row.params["output"]["format"]] or not path.is_file():
        raise JobFailedError("internal_error", "the correction wrote no file; retry, or report the photo")
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    base, storage = row.run_folder, context.storage
    key = f"{base}result{path.suffix}"
    storage.put(key, path)
    for shown in (*SIDES.values(), *LAYER_FILES.values()):
        if (path.parent / shown).is_file():
            storage.put(f"{base}{shown}", path.parent / shown)
    name = f"{PurePath(row.photo.filename).stem or 'photo'}-corrected{path.suffix}"
    about = {"key": key, "etag": digest, "media_type": MEDIA_TYPE[path.suffix], "name": name}
    if not context.store.jobs.finish(row, report, bytes=path.stat().st_size, **about):
        storage.delete(base)  # cancelled, deleted or begun again: nobody else writes there


def measure(context: JobContext, lens_id: str, version: int) -> None:
    """Note the errors that one version of a lens expects, and write its report."""
    lenses = context.store.lenses
    lens = lenses.get(lens_id, ANY_OWNER)
    if lens is None:
        return

    def newest() -> bool:  # reports of earlier versions have been deleted
        row = lenses.get(lens_id, ANY_OWNER)
        return row is not None and row.version == version

    state, samples = _samples(context, lens_id, version)
    height, width = lenses.shape_of(lens) or (2, 3)
    about = {
        "name": _name(lens, "Unknown lens"),
        "aspect": width / height,
        "height_px": height if height > 2 else None,
        "lateral": lenses.lateral_of(lens),
    }
    with context.task("measure", None, newest, samples=samples, about=about) as (metrics, folder):
        context.keep(report_key(lens_id, version, state.rebuild_epoch), folder / REPORT)
    lenses.record_metrics(lens_id, version, metrics)


def _name(lens: LensRow | None, otherwise: str) -> str:
    return otherwise if lens is None else lens.label or full_name(lens.maker, lens.model) or otherwise
