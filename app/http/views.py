"""Rows as answers where one column alone does not say it: what went wrong, and how far the work is."""

from __future__ import annotations

from datetime import datetime
from typing import Final, TypeAlias, get_args

from app import schemas as s
from app.http.errors import problem_of
from app.schemas import V1
from app.store.owners import now
from app.store.tables import CorrectionRow, PhotoRow

Worked: TypeAlias = PhotoRow | CorrectionRow
# State of the job, by the state of the photo
JOB_STATES: Final[dict[str, s.JobState]] = {
    **dict.fromkeys(get_args(s.Working), "running"),
    **dict.fromkeys(("counted", "stored", "excluded"), "succeeded"),
    "received": "queued",
    "needs_lens": "waiting",
    "failed": "failed",
    "cancelled": "cancelled",
}


def photo_out(row: PhotoRow) -> s.PhotoOut:
    """Describe a photo."""
    patches = s.PatchCounts(total=row.patches_total, done=row.patches_done, rejected=row.patches_rejected)
    return s.PhotoOut.of(row, patches=patches, error=_problem(row))


def correction_out(row: CorrectionRow) -> s.CorrectionOut:
    """Describe a correction."""
    return s.CorrectionOut.of(row, error=_problem(row))


def _problem(row: Worked) -> s.Problem | None:
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


def job_out(row: Worked) -> s.JobOut:
    """Describe the work on a photo or on a correction."""
    links = dict.fromkeys(("correction", "result"))
    state: str = row.state
    stage: str | None
    if isinstance(row, PhotoRow):
        photo, state, stage, created_at = row, JOB_STATES[row.state], row.state, row.received_at
        done, total, unit = row.patches_done, row.patches_total, "patches"
        since = row.stage_at if row.state == "estimating" else None
    else:
        photo, stage, created_at = row.photo, row.stage, row.created_at
        done, total, unit = row.progress_done, row.progress_total, "tiles"
        since = row.started_at if row.state == "running" else None
        own = f"{V1}/corrections/{row.public_id}"
        links = {"correction": own, "result": f"{own}/result" if row.state == "succeeded" else None}
    return s.JobOut.model_validate(
        {
            "id": row.public_id,
            "kind": "photo" if photo is row else "correction",
            "state": state,
            "stage": stage if state == "running" else None,
            "progress": {"done": done, "total": total, "unit": unit},
            "eta_seconds": None if since is None else _eta(since, done, total),
            "attempt": max(row.attempt, 1),
            "error": _problem(row),
            "created_at": created_at,
            "started_at": row.started_at,
            "finished_at": row.finished_at,
            "links": {
                "self": f"{V1}/jobs/{row.public_id}",
                "photo": f"{V1}/photos/{photo.public_id}",
                "lens": None if row.lens is None else f"{V1}/lenses/{row.lens.public_id}",
                **links,
            },
        }
    )


def _eta(since: datetime, done: int, total: int) -> float | None:
    """Return the seconds left at the average pace so far; None before the first is done."""
    if done <= 0 or total <= done:
        return None if done <= 0 else 0.0
    return round((now() - since).total_seconds() / done * (total - done), 1)
