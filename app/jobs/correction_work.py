"""Jobs of corrections, and of measuring lens models."""

from __future__ import annotations

import hashlib
import logging
import time
from functools import partial
from pathlib import Path, PurePath
from typing import Any, Final

from app.jobs.answers import JobFailedError
from app.jobs.context import JobContext, NotWantedError
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

log = logging.getLogger(__name__)

MEDIA_TYPE: Final = {
    ".tif": "image/tiff",
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".dng": "image/x-adobe-dng",
}
PROGRESS_S: Final = 0.5  # seconds between two writes of the progress (chosen): each is a transaction


class CorrectionWork:
    """Jobs of corrections and of lens versions."""

    def __init__(self, context: JobContext) -> None:
        self._context = context
        self._jobs, self._lenses = context.store.jobs, context.store.lenses

    def correction(self, correction_id: str, epoch: int = 1) -> None:
        """Make the corrected file."""
        row = self._jobs.start(correction_id, epoch)
        if row is None:
            return
        try:
            self._correct(row)
        except NotWantedError:
            log.info("correction %s is not wanted any more", correction_id)
        except JobFailedError as error:
            self._jobs.fail(correction_id, epoch, error.code, error.detail)

    def _correct(self, row: CorrectionRow) -> None:
        photo, params, settings = row.photo, row.params, self._context.settings
        wanted = partial(self._jobs.is_live, row.public_id, row.epoch)
        self._jobs.progress(row, 0, 0, "developing")
        developed = self._context.developed(photo, wanted)
        self._jobs.progress(row, 0, 0)
        _, samples = self._samples(row.lens_public_id, row.lens_version)
        bounds = {name: params[name] for name in ("halo", "texture", "denoise") if name in params}
        with self._context.task(
            "correct",
            photo,
            wanted,
            reads=[developed],
            samples=samples,
            on_progress=self._progress_of(row),
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
            workers=settings.worker_slots,
            description=(
                f"lens blur corrected by lensmodel: {_name(row.lens, 'unknown lens')}, version "
                f"{row.lens_version}, method {params['method']}, strength {params['strength']:g}"
                f"{Bounds(**bounds).described}"
            ),
            lens=row.lens.label or "" if row.lens is not None else "",
        ) as (done, folder):
            self._store_result(row, folder / Path(done["file"]).name, done["report"])

    def _samples(self, lens_id: str, version: int) -> tuple[LensState, list[PsfSample]]:
        try:
            state, samples = self._lenses.samples_of(lens_id, up_to_version=version)
        except NoSamplesError as error:
            raise JobFailedError(error.code, str(error)) from error
        if not samples:
            text = f"version {version} of lens {lens_id} has no samples any more; ask for the newest version"
            raise JobFailedError("no_samples", text)
        return state, samples

    def _progress_of(self, row: CorrectionRow) -> ProgressHook:
        last = 0.0

        def tell(done: int, total: int) -> None:
            nonlocal last
            if time.monotonic() - last > PROGRESS_S or done == total:
                last = time.monotonic()
                with missable():
                    self._jobs.progress(row, done, total)

        return tell

    def _store_result(self, row: CorrectionRow, path: Path, report: dict[str, Any]) -> None:
        if path.suffix != SUFFIX[row.params["output"]["format"]] or not path.is_file():
            raise JobFailedError("internal_error", "the correction wrote no file; retry, or report the photo")
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        base, storage = row.run_folder, self._context.storage
        key = f"{base}result{path.suffix}"
        storage.put(key, path)
        for shown in (*SIDES.values(), *LAYER_FILES.values()):
            if (path.parent / shown).is_file():
                storage.put(f"{base}{shown}", path.parent / shown)
        name = f"{PurePath(row.photo.filename).stem or 'photo'}-corrected{path.suffix}"
        media_type, size = MEDIA_TYPE[path.suffix], path.stat().st_size
        about = {"key": key, "etag": digest, "media_type": media_type, "name": name}
        if not self._jobs.finish(row, report, bytes=size, **about):
            storage.delete(base)  # cancelled, deleted or begun again: nobody else writes there

    def measure(self, lens_id: str, version: int) -> None:
        """Note the errors that one version of a lens expects, and write its report."""
        lens = self._lenses.get(lens_id, ANY_OWNER)
        if lens is None:
            return

        def newest() -> bool:  # reports of earlier versions have been deleted
            row = self._lenses.get(lens_id, ANY_OWNER)
            return row is not None and row.version == version

        try:
            state, samples = self._samples(lens_id, version)
            task = self._context.task("measure", None, newest, samples=samples, about=self._about(lens))
            with task as (metrics, folder):
                if (folder / REPORT).is_file():
                    key = report_key(lens_id, version, state.rebuild_epoch)
                    self._context.storage.put(key, folder / REPORT)
        except NotWantedError:
            return
        except JobFailedError as error:
            log.warning("lens %s version %d could not be measured: %s", lens_id, version, error.detail)
            metrics = {"error": None, "coverage": None, "problem": error.code}
        self._lenses.record_metrics(lens_id, version, metrics)

    def _about(self, lens: LensRow) -> dict[str, Any]:
        """Return what the report needs besides the samples: name, shape of the photos, lateral colour."""
        height, width = self._lenses.shape_of(lens) or (2, 3)
        return {
            "name": _name(lens, "Unnamed lens"),
            "aspect": width / height,
            "height_px": height if height > 2 else None,
            "lateral": self._lenses.lateral_of(lens),
        }


def _name(lens: LensRow | None, otherwise: str) -> str:
    return otherwise if lens is None else lens.label or full_name(lens.maker, lens.model) or otherwise
