"""Jobs of corrections, and of measuring lens models."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import time
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any, Final

from app.jobs.context import (
    SPARE_MB,
    JobContext,
    JobFailedError,
    NotWantedError,
)
from app.jobs.sample_files import write_samples
from app.jobs.task_files import EARLIER, FAMILY, LAYER_FILES, LEARNED, REPORT, SIDES, SUFFIX
from app.runtime.outage import missable
from app.sandbox.child import ProgressHook
from app.sandbox.outcome import TaskLimits
from app.store.corrections import CorrectionPlan, Result, Run, run_folder
from app.store.photo_steps import stored_settings
from app.store.samples import LensState, Relative
from app.store.versions import learned_key, report_key
from app.ways import of_models
from lensmodel.correction import Bounds

log = logging.getLogger(__name__)

MEDIA_TYPE: Final = {
    ".tif": "image/tiff",
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".dng": "image/x-adobe-dng",
}
PROGRESS_S: Final = 0.5
"""Seconds between two writes of the progress (chosen): each is a transaction."""

THREAD_MB: Final = 136
"""Address space in MiB that a thread reserves: 8 of stack and 128 that glibc maps for the heap of an arena,
most of it never touched."""

EARLIER_VERSIONS: Final = 8
"""Versions back in which a fit is looked for that a new one may begin with (chosen): photos that come
together are fitted together, and few lenses get more at a time."""

FAMILIES: Final = 8
"""Fitted families in memory (chosen): those of the lenses whose previews are being looked at."""


class CorrectionWork:
    """Jobs of corrections and of lens versions."""

    def __init__(self, context: JobContext) -> None:
        self._context = context
        self._corrections = context.store.corrections
        self._families: OrderedDict[str, bytes] = OrderedDict()

    def correction(self, correction_id: str, epoch: int = 1) -> None:
        """Make the corrected file."""

        def wanted() -> bool:
            return self._corrections.is_live(correction_id, epoch)

        run = self._corrections.start(correction_id, epoch)
        plan = None if run is None else self._corrections.plan(correction_id)
        if run is None or plan is None:
            return
        try:
            self._correct(run, plan, wanted)
        except NotWantedError:
            log.info("correction %s is not wanted any more", correction_id)
        except JobFailedError as error:
            self._corrections.fail(correction_id, error.code, error.detail, epoch=epoch)

    def _correct(self, run: Run, plan: CorrectionPlan, wanted: Callable[[], bool]) -> None:
        photo, params = plan.photo, plan.correction.params
        self._corrections.progress(run, 0, 0, "developing")
        developed = self._context.developed(photo, wanted)
        self._corrections.progress(run, 0, 0, "correcting")
        settings = self._context.settings
        limits = self._context.limits(photo, settings.correct_seconds, 120)
        limits = replace(
            limits,
            memory_mb=limits.memory_mb + THREAD_MB * settings.worker_slots,
            cpu_s=math.ceil(settings.correct_seconds) * settings.worker_slots,
        )
        arguments: dict[str, Any] = {
            "developed": str(developed),
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
            "description": _description(plan),
            "lens": plan.lens.label or "",
        }
        with self._context.sandbox.folder() as folder:
            lens_id, version = plan.lens.public_id, plan.correction.lens_version
            state = self._samples(lens_id, version, folder)
            arguments["model"] = of_models(settings, state.way)
            known = (folder / LEARNED).is_file()
            leaning, fitted = self._family(params.get("family", []), arguments["model"], folder)
            done = self._context.attempt(
                "correct",
                arguments,
                folder=folder,
                limits=limits,
                wanted=wanted,
                reads=[developed],
                compiles=True,
                on_progress=self._progress_of(run),
            )
            if not known and self._is_newest(lens_id, version):
                self._keep_learned(lens_id, version, state, folder / LEARNED)
            self._keep_family(fitted, folder / FAMILY / LEARNED)
            report = done["report"] | ({"family": {"lenses": leaning}} if leaning else {})
            self._store_result(run, plan, folder / Path(done["file"]).name, report)

    def _family(
        self, relatives: list[dict[str, Any]], model: dict[str, str], folder: Path
    ) -> tuple[int, str]:
        """Pass the samples of other copies of the lens to the task, and their fit if it is in memory."""
        family = [Relative(entry["lens_id"], LensState(**entry["state"])) for entry in relatives]
        stored = self._context.store.samples.of_family(family)
        if not stored:
            return 0, ""
        (folder / FAMILY).mkdir()
        write_samples(folder / FAMILY, [entry.sample for entry in stored])
        key = json.dumps([relatives, model], sort_keys=True)
        fitted = self._families.get(key)
        if fitted is not None:
            (folder / FAMILY / LEARNED).write_bytes(fitted)
        return len(family), key

    def _keep_family(self, key: str, path: Path) -> None:
        """Keep the fit of a family for the next correction: previews come in rows."""
        if not path.is_file():
            return
        self._families.pop(key, None)
        self._families[key] = path.read_bytes()
        while len(self._families) > FAMILIES:
            self._families.popitem(last=False)

    def _samples(self, lens_id: str, version: int, folder: Path) -> LensState:
        state, stored = self._context.store.samples.of_lens(lens_id, up_to_version=version)
        if not stored:
            text = f"version {version} of lens {lens_id} has no samples any more; ask for the newest version"
            raise JobFailedError("no_samples", text)
        write_samples(folder, [entry.sample for entry in stored])
        for number in range(version, max(version - EARLIER_VERSIONS, 1) - 1, -1):
            # not fitted yet: the task does it, beginning with what an earlier version came to
            with suppress(FileNotFoundError):
                learned = self._context.storage.get(learned_key(lens_id, number, state.rebuild_epoch))
                (folder / (LEARNED if number == version else EARLIER)).write_bytes(learned)
                break
        return state

    def _progress_of(self, run: Run) -> ProgressHook:
        last = 0.0

        def tell(done: int, total: int) -> None:
            nonlocal last
            if time.monotonic() - last > PROGRESS_S or done == total:
                last = time.monotonic()
                with missable():
                    self._corrections.progress(run, done, total)

        return tell

    def _store_result(self, run: Run, plan: CorrectionPlan, path: Path, report: dict[str, Any]) -> None:
        if path.suffix != SUFFIX[plan.correction.params["output"]["format"]] or not path.is_file():
            raise JobFailedError("internal_error", "the correction wrote no file; retry, or report the photo")
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        base = run_folder(plan.correction)
        key = f"{base}result{path.suffix}"
        self._context.storage.put_file(key, path)
        for shown in (*SIDES.values(), *LAYER_FILES.values()):
            if (path.parent / shown).is_file():
                self._context.storage.put_file(f"{base}{shown}", path.parent / shown)
        stem = PurePath(plan.photo.filename).stem or "photo"
        result = Result(
            key=key,
            etag=digest,
            media_type=MEDIA_TYPE[path.suffix],
            size=path.stat().st_size,
            name=f"{stem}-corrected{path.suffix}",
        )
        if not self._corrections.finish(run, result, report):
            self._context.storage.delete(base)  # cancelled, deleted or begun again: nobody else writes there

    def measure(self, lens_id: str, version: int, _again: int = 0) -> None:
        """Measure how well one version of a lens predicts held-out photos, and write its report.

        When repeated for a missing report it keeps the figures that were measured first.
        """
        lenses = self._context.store.lenses

        def wanted() -> bool:
            return self._is_newest(lens_id, version)

        limits = TaskLimits(memory_mb=2 * SPARE_MB, wall_s=self._context.settings.patch_seconds)
        try:
            with self._context.sandbox.folder() as folder:
                state = self._samples(lens_id, version, folder)
                model = of_models(self._context.settings, state.way)
                metrics = self._context.attempt(
                    "measure", {"model": model}, folder=folder, limits=limits, wanted=wanted, compiles=True
                )
                self._keep_learned(lens_id, version, state, folder / LEARNED)
                key = report_key(lens_id, version, state.rebuild_epoch)
                self._report(lens_id, key, model, folder, wanted)
        except NotWantedError:
            return
        except JobFailedError as error:
            log.warning("lens %s version %d could not be measured: %s", lens_id, version, error.detail)
            metrics = {"error": None, "coverage": None, "problem": error.code}
        lenses.record_metrics(lens_id, version, metrics)

    def _report(
        self, lens_id: str, key: str, model: dict[str, str], folder: Path, wanted: Callable[[], bool]
    ) -> None:
        """Write the report of the lens whose samples lie in a folder; a failure is only logged."""
        settings = self._context.settings
        limits = TaskLimits(memory_mb=2 * SPARE_MB, wall_s=settings.correct_seconds)
        arguments = {"model": model, "about": self._about(lens_id)}
        try:
            self._context.attempt(
                "report", arguments, folder=folder, limits=limits, wanted=wanted, compiles=True
            )
            self._context.storage.put_file(key, folder / REPORT)
        except (JobFailedError, FileNotFoundError) as error:
            log.warning("lens %s has no report: %s", lens_id, error)

    def _about(self, lens_id: str) -> dict[str, Any]:
        """Return what the report needs besides the samples: name, shape of the photos, lateral colour."""
        lenses = self._context.store.lenses
        lens = lenses.get(lens_id)
        if lens is None:
            raise NotWantedError
        full_name = " ".join(word for word in (lens.maker, lens.model) if word)
        height, width = lenses.shape_of(lens) or (2, 3)
        return {
            "name": lens.label or full_name or "Unnamed lens",
            "aspect": width / height,
            "height_px": height if height > 2 else None,
            "lateral": lenses.lateral_of(lens),
        }

    def _is_newest(self, lens_id: str, version: int) -> bool:
        """Whether a version is the current one; fitted models of earlier ones have been deleted."""
        lens = self._context.store.lenses.get(lens_id)
        return lens is not None and lens.version == version

    def _keep_learned(self, lens_id: str, version: int, state: LensState, path: Path) -> None:
        """Store the fitted model of the newest version for all processes that answer requests."""
        if path.is_file():
            key = learned_key(lens_id, version, state.rebuild_epoch)
            self._context.storage.put_file(key, path)


def _bounds(params: dict[str, Any]) -> dict[str, float]:
    return {name: params[name] for name in ("halo", "texture", "denoise") if name in params}


def _description(plan: CorrectionPlan) -> str:
    params = plan.correction.params
    full_name = " ".join(word for word in (plan.lens.maker, plan.lens.model) if word)
    lens = plan.lens.label or full_name or "unknown lens"
    return (
        f"lens blur corrected by lensmodel: {lens}, version {plan.correction.lens_version}, "
        f"method {params['method']}, strength {params['strength']:g}"
        f"{Bounds(**_bounds(params)).described}"
    )
