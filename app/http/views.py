"""Rows as the schemas of responses: columns of the same name are taken over, the others said here."""

from __future__ import annotations

from datetime import datetime
from typing import Final, TypeVar, get_args

from app import distances
from app import schemas as s
from app.http.errors import problem_of
from app.schemas import V1
from app.store.owners import now
from app.store.tables import Base, CorrectionRow, EventRow, LensRow, PatchRow, PhotoRow

M = TypeVar("M", bound=s.Model)

# State of the job, by the state of the photo
JOB_STATES: Final[dict[str, s.JobState]] = {
    **dict.fromkeys(get_args(s.Working), "running"),
    **dict.fromkeys(("counted", "stored", "excluded"), "succeeded"),
    "received": "queued",
    "needs_lens": "waiting",
    "failed": "failed",
    "cancelled": "cancelled",
}


def _of(model: type[M], row: Base, **more: object) -> M:
    """Return a row as a model: its columns, and `more` in place of some of them."""
    shared = {name: getattr(row, name) for name in model.model_fields if hasattr(row, name)}
    return model.model_validate({**shared, **more})


def photo_out(row: PhotoRow) -> s.PhotoOut:
    """Describe a photo."""
    camera = " ".join(part for part in (row.camera_maker, row.camera_model) if part)
    return _of(
        s.PhotoOut,
        row,
        id=row.public_id,
        lens_id=None if row.lens is None else row.lens.public_id,
        focal_length_mm=row.focal_mm,
        focus_distance_m=None if row.focus_m == distances.INFINITY else row.focus_m,
        camera=camera or None,
        kind=row.given.get("kind"),
        reference_id=row.given.get("reference_id"),
        patches={"total": row.patches_total, "done": row.patches_done, "rejected": row.patches_rejected},
        error=_problem(row),
        created_at=row.received_at,
    )


def _problem(row: PhotoRow | CorrectionRow) -> s.Problem | None:
    if isinstance(row, PhotoRow) and row.state == "needs_lens":
        return problem_of(
            "metadata_missing",
            row.error_detail
            or f"the photo does not say which copy of a lens took it ({row.lens_model or 'model unknown'}): "
            "choose a lens, give its serial with the model, or name a new one",
        )
    if row.state == "cancelled":
        what = "send the photo again" if isinstance(row, PhotoRow) else "ask for the correction again"
        return problem_of("cancelled", f"cancelled by its owner; {what} to start anew")
    return None if row.error_code is None else problem_of(row.error_code, row.error_detail)


def patch_out(row: PatchRow) -> s.PatchOut:
    """Describe one window of a photo."""
    return _of(s.PatchOut, row, index=row.idx)


def photo_job(row: PhotoRow) -> s.JobOut:
    """Describe the work on a photo."""
    since = row.stage_at if row.state == "estimating" else None
    how_far = (row.patches_done, row.patches_total, "patches")
    return _job(row, "photo", JOB_STATES[row.state], row.state, since, how_far, row, {}, row.received_at)


def correction_job(row: CorrectionRow) -> s.JobOut:
    """Describe the work on a correction."""
    own = f"{V1}/corrections/{row.public_id}"
    links = {"correction": own, "result": f"{own}/result" if row.state == "succeeded" else None}
    since = row.started_at if row.state == "running" else None
    how_far = (row.progress_done, row.progress_total, "tiles")
    return _job(row, "correction", row.state, row.stage, since, how_far, row.photo, links, row.created_at)


def _job(
    row: PhotoRow | CorrectionRow,
    kind: str,
    state: str,
    stage: str | None,
    since: datetime | None,
    how_far: tuple[int, int, str],
    photo: PhotoRow,
    links: dict[str, str | None],
    created_at: datetime,
) -> s.JobOut:
    done, total, unit = how_far
    return _of(
        s.JobOut,
        row,
        id=row.public_id,
        kind=kind,
        state=state,
        stage=stage if state == "running" else None,
        progress={"done": done, "total": total, "unit": unit},
        eta_seconds=None if since is None else _eta(since, done, total),
        attempt=max(row.attempt, 1),
        error=_problem(row),
        created_at=created_at,
        links={
            "self": f"{V1}/jobs/{row.public_id}",
            "photo": f"{V1}/photos/{photo.public_id}",
            "lens": None if row.lens is None else f"{V1}/lenses/{row.lens.public_id}",
            "correction": None,
            "result": None,
            **links,
        },
    )


def correction_out(row: CorrectionRow) -> s.CorrectionOut:
    """Describe a correction."""
    asked = {name: row.params[name] for name in ("method", "strength", "output", "roi")}
    return _of(
        s.CorrectionOut,
        row,
        id=row.public_id,
        photo_id=row.photo.public_id,
        lens_id=row.lens.public_id,
        error=_problem(row),
        **asked,
    )


def lens_out(row: LensRow, apertures: list[float], focals: list[float]) -> s.LensOut:
    """Describe a lens."""
    return _of(
        s.LensOut,
        row,
        id=row.public_id,
        photos=row.photo_count,
        samples=row.sample_count,
        apertures=apertures,
        focal_lengths_mm=focals,
    )


def calibration_out(row: EventRow) -> s.CalibrationOut:
    """Describe one version of a lens."""
    metrics = row.metrics or {}
    measured = {name: metrics.get(name) for name in ("error", "coverage")}
    return _of(s.CalibrationOut, row, photo_id=row.photo_public_id, **measured)


def _eta(since: datetime, done: int, total: int) -> float | None:
    """Return the seconds left at the average pace so far; None before the first is done."""
    if done <= 0 or total <= done:
        return None if done <= 0 else 0.0
    return round((now() - since).total_seconds() / done * (total - done), 1)
