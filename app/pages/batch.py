"""Several corrections on one page, and their files in one archive."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import PurePath
from typing import Annotated, Any, Final

from fastapi import APIRouter, Query
from fastapi.responses import HTMLResponse, StreamingResponse

from app.blobs.zipped import zipped
from app.errors import NotReadyError
from app.http import views
from app.http.dependencies import Call, CallDep, OneSession
from app.pages.rendering import page
from app.routes.corrections import find_correction
from app.store.tables import CorrectionRow

# Letters of a list of corrections (chosen): those of the photos of one page, and what addresses may have
MAX_LENGTH: Final = 4000
Ids = Annotated[str, Query(max_length=MAX_LENGTH)]
router = APIRouter(include_in_schema=False, route_class=OneSession)


def state(call: Call, ids: str) -> dict[str, Any]:
    """Return what the page shows of corrections whose ids have commas between them."""
    plans = _plans(call, ids)
    jobs = [views.job_out(plan) for plan in plans]
    return {
        "rows": list(zip(plans, map(views.correction_out, plans), jobs, strict=True)),
        "left": sum(job.state in {"queued", "running"} for job in jobs),
        "share": sum(
            1.0
            if job.state not in {"queued", "running"}
            else job.progress.done / max(job.progress.total or 1, 1)
            for job in jobs
        ),
        "done": sum(job.state == "succeeded" for job in jobs),
        "ids": ids,
    }


@router.get("/batch")
def batch_page(ids: Ids, call: CallDep) -> HTMLResponse:
    """Show how far several corrections are."""
    return page("batch.html", **state(call, ids))


@router.get("/batch.zip")
def batch_archive(ids: Ids, call: CallDep) -> StreamingResponse:
    """Return the files of the corrections that are done."""
    plans = [plan for plan in _plans(call, ids) if plan.state == "succeeded"]
    if not plans:
        raise NotReadyError("none of these corrections is done yet: wait for them")
    headers = {
        "Content-Disposition": 'attachment; filename="corrected.zip"',
        "X-Content-Type-Options": "nosniff",
    }
    return StreamingResponse(zipped(_files(call, plans)), media_type="application/zip", headers=headers)


def _plans(call: Call, ids: str) -> list[CorrectionRow]:
    return [find_correction(call, key) for key in dict.fromkeys(filter(None, ids.split(",")))]


def _files(call: Call, plans: Sequence[CorrectionRow]) -> Iterator[tuple[zipfile.ZipInfo, Iterable[bytes]]]:
    """Yield the files of corrections, which are compressed already."""
    used = set[str]()
    for row in plans:
        assert row.result_key is not None
        assert row.result_bytes is not None
        name = unused_name(row.result_name or row.public_id, used)
        entry = zipfile.ZipInfo(name, row.photo.received_at.timetuple()[:6])
        yield entry, call.storage.stream(row.result_key, 0, row.result_bytes)


def unused_name(name: str, used: set[str]) -> str:
    """Return a name that no file of the archive has yet."""
    path, count, free = PurePath(name), 1, name
    while free.casefold() in used:
        count += 1
        free = f"{path.stem} ({count}){path.suffix}"
    used.add(free.casefold())
    return free
