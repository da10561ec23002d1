"""Jobs of corrections, and of measuring lens models."""

from __future__ import annotations

import hashlib
import logging
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any, Final

from app.jobs.answers import Corrected, Measured, checked
from app.jobs.context import SPARE_MB, JobContext, JobFailedError, NotWantedError
from app.jobs.sample_files import write_samples
from app.jobs.task_files import LAYER_FILES, REPORT, SIDES, SUFFIX
from app.runtime.outage import missable
from app.sandbox.child import ProgressHook
from app.sandbox.outcome import TaskLimits
from app.store.jobs import Result, Run
from app.store.lenses import report_key
from app.store.owners import ANY_OWNER
from app.store.photos import stored_settings
from app.store.samples import LensState
from app.store.tables import CorrectionRow, LensRow
from lensmodel.core.errors import NoSamplesError
from lensmodel.core.names import full_name
from lensmodel.correction import Bounds

log = logging.getLogger(__name__)

MEDIA_TYPE: Final = {
    ".tif": "image/tiff",
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".dng": "image/x-adobe-dng",
}
PROGRESS_S: Final = 0.5  # seconds between two writes of the progress (chosen): each is a transaction
# Address space in MiB that a thread reserves: 8 of stack and 128 that glibc maps for the heap of an arena,
# most of it never touched
THREAD_MB: Final = 136


class CorrectionWork:
    """Jobs of corrections and of lens versions."""

    def __init__(self, context: JobContext) -> None:
        self._context = context
        self._jobs = context.store.jobs

    def correction(self, correction_id: str, epoch: int = 1) -> None:
        """Make the corrected file."""

        def wanted() -> bool:
            return self._jobs.is_live(correction_id, epoch)

        run = self._jobs.start(correction_id, epoch)
        row = None if run is None else self._jobs.correction(correction_id, ANY_OWNER)
        if run is None or row is None:
            return
        try:
            self._correct(run, row, wanted)
        except NotWantedError:
            log.info("correction %s is not wanted any more", correction_id)
        except JobFailedError as error:
            self._jobs.fail(correction_id, error.code, error.detail, epoch=epoch)

    def _correct(self, run: Run, row: CorrectionRow, wanted: Callable[[], bool]) -> None:
        photo, params = row.photo, row.params
        self._jobs.progress(run, 0, 0, "developing")
        developed = self._context.developed(photo, wanted)
        self._jobs.progress(run, 0, 0, "correcting")
        settings = self._context.settings
        limits = self._context.limits(photo, settings.task_seconds, 120)
        limits = replace(
            limits,
            memory_mb=limits.memory_mb + THREAD_MB * settings.worker_slots,
            cpu_s=math.ceil(settings.task_seconds) * settings.worker_slots,
        )
        arguments: dict[str, Any] = {
            "developed": str(developed),
            "photo": photo.public_id,
            "settings": params.get("settings")
            or stored_settings(photo),  # as they were when the correction was requested
            "lateral": photo.lateral,
            "method": params["method"],
            "strength": params["strength"],
            "bounds": _bounds(params),
            "output": params["output"],
            "roi": params.get("roi"),
            "layers": params.get("layers", False),
            "workers": settings.worker_slots,
            "description": _description(row),
            "lens": row.lens.label or "",
        }
        with self._context.sandbox.folder() as folder:
            lens_id, version = row.lens.public_id, row.lens_version
            self._samples(lens_id, version, folder)
            done = self._context.attempt(
                "correct",
                arguments,
                folder=folder,
                limits=limits,
                wanted=wanted,
                reads=[developed],
                on_progress=self._progress_of(run),
            )
            done = checked(Corrected, done)
            self._store_result(run, row, folder / Path(done["file"]).name, done["report"])

    def _samples(self, lens_id: str, version: int, folder: Path) -> LensState:
        try:
            state, samples = self._context.store.lenses.samples_of(lens_id, up_to_version=version)
        except NoSamplesError as error:
            raise JobFailedError(error.code, str(error)) from error
        if not samples:
            text = f"version {version} of lens {lens_id} has no samples any more; ask for the newest version"
            raise JobFailedError("no_samples", text)
        write_samples(folder, samples)
        return state

    def _progress_of(self, run: Run) -> ProgressHook:
        last = 0.0

        def tell(done: int, total: int) -> None:
            nonlocal last
            if time.monotonic() - last > PROGRESS_S or done == total:
                last = time.monotonic()
                with missable():
                    self._jobs.progress(run, done, total)

        return tell

    def _store_result(self, run: Run, row: CorrectionRow, path: Path, report: dict[str, Any]) -> None:
        if path.suffix != SUFFIX[row.params["output"]["format"]] or not path.is_file():
            raise JobFailedError("internal_error", "the correction wrote no file; retry, or report the photo")
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        base = row.run_folder
        key = f"{base}result{path.suffix}"
        self._context.storage.put(key, path)
        for shown in (*SIDES.values(), *LAYER_FILES.values()):
            if (path.parent / shown).is_file():
                self._context.storage.put(f"{base}{shown}", path.parent / shown)
        stem = PurePath(row.photo.filename).stem or "photo"
        result = Result(
            key=key,
            etag=digest,
            media_type=MEDIA_TYPE[path.suffix],
            size=path.stat().st_size,
            name=f"{stem}-corrected{path.suffix}",
        )
        if not self._jobs.finish(run, result, report):
            self._context.storage.delete(base)  # cancelled, deleted or begun again: nobody else writes there

    def measure(self, lens_id: str, version: int) -> None:
        """Note the errors that one version of a lens expects, and write its report."""
        lenses = self._context.store.lenses

        def wanted() -> bool:
            return self._is_newest(lens_id, version)

        limits = TaskLimits(memory_mb=2 * SPARE_MB, wall_s=self._context.settings.task_seconds)
        lens = lenses.get(lens_id, ANY_OWNER)
        if lens is None:
            return
        try:
            with self._context.sandbox.folder() as folder:
                state = self._samples(lens_id, version, folder)
                metrics = self._context.attempt(
                    "measure",
                    {"about": self._about(lens)},
                    folder=folder,
                    limits=limits,
                    wanted=wanted,
                )
                metrics = checked(Measured, metrics)
                if (folder / REPORT).is_file():
                    key = report_key(lens_id, version, state.rebuild_epoch)
                    self._context.storage.put(key, folder / REPORT)
        except NotWantedError:
            return
        except JobFailedError as error:
            log.warning("lens %s version %d could not be measured: %s", lens_id, version, error.detail)
            metrics = {"error": None, "coverage": None, "problem": error.code}
        lenses.record_metrics(lens_id, version, metrics)

    def _about(self, lens: LensRow) -> dict[str, Any]:
        """Return what the report needs besides the samples: name, shape of the photos, lateral colour."""
        lenses = self._context.store.lenses
        height, width = lenses.shape_of(lens) or (2, 3)
        return {
            "name": lens.label or full_name(lens.maker, lens.model) or "Unnamed lens",
            "aspect": width / height,
            "height_px": height if height > 2 else None,
            "lateral": lenses.lateral_of(lens),
        }

    def _is_newest(self, lens_id: str, version: int) -> bool:
        """Whether a version is the current one; reports of earlier ones have been deleted."""
        lens = self._context.store.lenses.get(lens_id, ANY_OWNER)
        return lens is not None and lens.version == version


def _bounds(params: dict[str, Any]) -> dict[str, float]:
    return {name: params[name] for name in ("halo", "texture", "denoise") if name in params}


def _description(row: CorrectionRow) -> str:
    params = row.params
    lens = row.lens.label or full_name(row.lens.maker, row.lens.model) or "unknown lens"
    return (
        f"lens blur corrected by lensmodel: {lens}, version {row.lens_version}, "
        f"method {params['method']}, strength {params['strength']:g}"
        f"{Bounds(**_bounds(params)).described}"
    )
