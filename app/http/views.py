"""Convert rows to the schemas of responses."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Final, cast

from app import schemas as s
from app.http.errors import problem_of
from app.schemas import distances
from app.store.access.owners import now
from app.store.corrections import CorrectionPlan
from app.store.tables import EventRow, LensRow, PatchRow, PhotoRow

V1: Final = "/v1"
JOB_STATES: Final[dict[str, s.JobState]] = {
    "received": "queued",
    "inspecting": "running",
    "developing": "running",
    "selecting": "running",
    "estimating": "running",
    "needs_lens": "waiting",
    "counted": "succeeded",
    "stored": "succeeded",
    "excluded": "succeeded",
    "failed": "failed",
    "cancelled": "cancelled",
}
"""State of the job, by the state of the photo."""


def photo_out(row: PhotoRow, lens_id: str | None, candidates: Sequence[str] = ()) -> s.PhotoOut:
    """Describe a photo."""
    camera = " ".join(part for part in (row.camera_maker, row.camera_model) if part)
    return s.PhotoOut(
        id=row.public_id,
        filename=row.filename,
        sha256=row.sha256,
        state=cast("s.PhotoState", row.state),
        calibrate=row.calibrate,
        lens_id=lens_id,
        aperture=row.aperture,
        focal_length_mm=row.focal_mm,
        focus_distance_m=None if row.focus_m == distances.INFINITY else row.focus_m,
        pixel_pitch_um=row.pixel_pitch_um,
        camera=camera or None,
        lens_model=row.lens_model,
        width=row.width,
        height=row.height,
        kind=row.given.get("kind"),
        reference_id=row.given.get("reference_id"),
        patches=s.PatchCounts(total=row.patches_total, done=row.patches_done, rejected=row.patches_rejected),
        error=_photo_problem(row, candidates),
        created_at=row.received_at,
        links=s.PhotoLinks(
            self=f"{V1}/photos/{row.public_id}",
            job=f"{V1}/jobs/{row.public_id}",
            lens=None if lens_id is None else f"{V1}/lenses/{lens_id}",
        ),
    )


def _photo_problem(row: PhotoRow, candidates: Sequence[str]) -> s.Problem | None:
    if row.state == "needs_lens":
        return problem_of(
            "metadata_missing",
            row.error_detail
            or f"the photo does not say which copy of a lens took it ({row.lens_model or 'model unknown'}): "
            "choose a lens, give its serial with the model, or name a new one",
            candidates=candidates,
        )
    if row.state == "cancelled":
        return problem_of("cancelled", "cancelled by its owner; send the photo again to start anew")
    return None if row.error_code is None else problem_of(row.error_code, row.error_detail)


def patch_out(row: PatchRow) -> s.PatchOut:
    """Describe one window of a photo."""
    return s.PatchOut(
        index=row.idx,
        row=row.row,
        col=row.col,
        size=row.size,
        r=row.r,
        phi=row.phi,
        score=row.score,
        state=row.state,
        reason=row.reason,
    )


def photo_job(row: PhotoRow, lens_id: str | None, candidates: Sequence[str] = ()) -> s.JobOut:
    """Describe the work on a photo."""
    state = JOB_STATES[row.state]
    eta = None
    if row.state == "estimating":
        eta = _eta(row.stage_at, row.patches_done, row.patches_total)
    return s.JobOut(
        id=row.public_id,
        kind="photo",
        state=state,
        stage=row.state if state == "running" else None,
        progress=s.JobProgress(done=row.patches_done, total=row.patches_total, unit="patches"),
        eta_seconds=eta,
        attempt=max(row.attempt, 1),
        error=_photo_problem(row, candidates),
        created_at=row.received_at,
        started_at=row.started_at,
        finished_at=row.finished_at,
        links=s.JobLinks(
            self=f"{V1}/jobs/{row.public_id}",
            photo=f"{V1}/photos/{row.public_id}",
            lens=None if lens_id is None else f"{V1}/lenses/{lens_id}",
            correction=None,
            result=None,
        ),
    )


def correction_job(plan: CorrectionPlan) -> s.JobOut:
    """Describe the work on a correction."""
    row = plan.correction
    running = row.state == "running"
    eta = None
    if running and row.started_at is not None:
        eta = _eta(row.started_at, row.progress_done, row.progress_total)
    self_link = f"{V1}/corrections/{row.public_id}"
    return s.JobOut(
        id=row.public_id,
        kind="correction",
        state=cast("s.JobState", row.state),
        stage=row.stage if running else None,
        progress=s.JobProgress(done=row.progress_done, total=row.progress_total, unit="tiles"),
        eta_seconds=eta,
        attempt=max(row.attempt, 1),
        error=_correction_problem(plan),
        created_at=row.created_at,
        started_at=row.started_at,
        finished_at=row.finished_at,
        links=s.JobLinks(
            self=f"{V1}/jobs/{row.public_id}",
            photo=f"{V1}/photos/{plan.photo.public_id}",
            lens=f"{V1}/lenses/{plan.lens.public_id}",
            correction=self_link,
            result=f"{self_link}/result" if row.state == "succeeded" else None,
        ),
    )


def correction_out(plan: CorrectionPlan) -> s.CorrectionOut:
    """Describe a correction."""
    row = plan.correction
    self_link = f"{V1}/corrections/{row.public_id}"
    return s.CorrectionOut(
        id=row.public_id,
        photo_id=plan.photo.public_id,
        lens_id=plan.lens.public_id,
        lens_version=row.lens_version,
        state=cast("s.CorrectionState", row.state),
        method=row.params["method"],
        strength=row.params["strength"],
        output=row.params["output"],
        roi=row.params["roi"],
        report=row.report,
        error=_correction_problem(plan),
        created_at=row.created_at,
        finished_at=row.finished_at,
        links=s.CorrectionLinks(
            self=self_link,
            job=f"{V1}/jobs/{row.public_id}",
            result=f"{self_link}/result" if row.state == "succeeded" else None,
        ),
    )


def _correction_problem(plan: CorrectionPlan) -> s.Problem | None:
    row = plan.correction
    if row.state == "cancelled":
        return problem_of("cancelled", "cancelled by its owner; ask for the correction again to start anew")
    return None if row.error_code is None else problem_of(row.error_code, row.error_detail)


def lens_out(row: LensRow, apertures: list[float], focals: list[float]) -> s.LensOut:
    """Describe a lens."""
    self_link = f"{V1}/lenses/{row.public_id}"
    return s.LensOut(
        id=row.public_id,
        maker=row.maker,
        model=row.model,
        serial=row.serial,
        serial_source=cast("s.SerialSource", row.serial_source),
        label=row.label,
        psf_model=cast("s.PsfModel", row.way),
        answering_model=cast("s.PsfModel", row.answering_way),
        version=row.version,
        photos=row.photo_count,
        samples=row.sample_count,
        apertures=apertures,
        focal_lengths_mm=focals,
        created_at=row.created_at,
        links=s.LensLinks(
            self=self_link,
            psf=f"{self_link}/psf",
            field=f"{self_link}/field.png",
            calibrations=f"{self_link}/calibrations",
            lateral_colour=f"{self_link}/lateral-colour",
            photos=f"{V1}/photos?lens_id={row.public_id}",
        ),
    )


def calibration_out(row: EventRow) -> s.CalibrationOut:
    """Describe one version of a lens."""
    metrics = row.metrics or {}
    return s.CalibrationOut(
        version=row.version,
        kind=row.kind,
        photo_id=row.photo_public_id,
        samples_added=row.samples_added,
        samples=row.samples,
        photos=row.photos,
        model=cast("s.PsfModel", row.way),
        error=metrics.get("error"),
        coverage=metrics.get("coverage"),
        created_at=row.created_at,
    )


def _eta(since: datetime, done: int, total: int) -> float | None:
    """Return the seconds left at the average pace so far; None before the first is done."""
    if done <= 0 or total <= done:
        return None if done <= 0 else 0.0
    return round((now() - since).total_seconds() / done * (total - done), 1)
