"""Jobs: how far the work on a photo or a correction is. A job has the id of what it makes."""

from __future__ import annotations

import asyncio
import hashlib
import time
from collections.abc import AsyncIterator
from operator import attrgetter
from typing import Annotated, Final

from fastapi import APIRouter, Query, Response
from sse_starlette import EventSourceResponse, ServerSentEvent
from starlette.concurrency import run_in_threadpool

from app.errors import ConflictError, UnknownError
from app.http import views
from app.http.dependencies import Call, CallDep, OneSession, found
from app.routes.common import NOT_CHANGED, Cursor, Limit, file_answer
from app.routes.photos import SEND_AGAIN
from app.schemas import JobOut, Page

router = APIRouter(tags=["jobs"], route_class=OneSession)

# Longest that a question for a job waits for a change of it (chosen): proxies end requests after 30 s
LONG_POLL_S: Final = 20.0
# Seconds between two looks at a job that somebody waits for (chosen): each is one or two reads
LOOK_S: Final = 0.1
FINAL = {"succeeded", "failed", "cancelled"}


def find_job(call: Call, job_id: str) -> JobOut:
    """Return the job of a photo or of a correction."""
    photo = call.store.photos.get(job_id, call.owner)
    correction = call.store.jobs.get(job_id, call.owner) if photo is None else None
    return views.job_out(photo or found("job", job_id, correction))


def fingerprint(job: JobOut) -> str:
    """Return a digest of a job, without its estimate of the time left."""
    return hashlib.sha256(job.model_dump_json(exclude={"eta_seconds"}).encode()).hexdigest()[:16]


@router.get("/jobs")
def list_jobs(call: CallDep, limit: Limit = 50, cursor: Cursor = None) -> Page[JobOut]:
    """List jobs of photos and corrections, newest first."""
    photos = call.store.photos.page(call.owner, before=cursor, limit=limit + 1)
    corrections = call.store.jobs.page(call.owner, before=cursor, limit=limit + 1)
    newest: list[views.Worked] = sorted([*photos, *corrections], key=attrgetter("public_id"), reverse=True)
    return call.page(newest, limit, views.job_out)


@router.get("/jobs/{job_id}", response_model=JobOut, responses=NOT_CHANGED)
async def get_job(
    job_id: str,
    call: CallDep,
    wait: Annotated[float, Query(ge=0, le=20, allow_inf_nan=False, description="seconds")] = 0.0,
) -> JobOut | Response:
    """Return one job; with `wait`, as soon as it changes, at the latest after that time.

    A finished job answers at once. With `If-None-Match` only a change from that state counts, so
    that nothing is missed between two requests.
    """
    known = call.request.headers.get("if-none-match", "").strip('W/"')
    deadline = time.monotonic() + min(wait, LONG_POLL_S)
    job = await run_in_threadpool(find_job, call, job_id)
    before = known or fingerprint(job)
    while (tag := fingerprint(job)) == before and job.state not in FINAL and time.monotonic() < deadline:
        await asyncio.sleep(min(LOOK_S, max(deadline - time.monotonic(), 0.0)))
        job = await run_in_threadpool(find_job, call, job_id)
    headers = {"ETag": f'W/"{tag}"', "Cache-Control": "no-cache"}
    if job.state not in FINAL:
        headers["Retry-After"] = "1"
    if known == tag:
        return Response(status_code=304, headers=headers)
    call.response.headers.update(headers)
    return job


@router.post("/jobs/{job_id}/cancel", status_code=202)
def cancel_job(job_id: str, call: CallDep) -> JobOut:
    """Cancel a job: running parts of it stop within a second, nothing of it counts."""
    done = call.store.photos.cancel(job_id, call.owner) or call.store.jobs.cancel(job_id, call.owner)
    job = find_job(call, job_id)
    if not done:
        raise ConflictError(f"job {job_id} is finished ({job.state}): there is nothing left to cancel")
    return job


@router.post("/jobs/{job_id}/retry", status_code=202)
def retry_job(job_id: str, call: CallDep) -> JobOut:
    """Start a failed or cancelled job anew."""
    photo = call.store.photos.get(job_id, call.owner)
    if photo is not None and photo.file_gone_at is not None:
        raise ConflictError(f"the file of photo {job_id} is no longer kept: {SEND_AGAIN}")
    done = call.store.photos.retry(job_id, call.owner) or call.store.jobs.retry(job_id, call.owner)
    job = find_job(call, job_id)
    if not done:
        raise ConflictError(
            f"job {job_id} is {job.state}, or what it makes was asked for again: "
            "only what failed or was cancelled can be retried"
        )
    return job


@router.get(
    "/jobs/{job_id}/events",
    response_class=EventSourceResponse,
    responses=file_answer("text/event-stream", "Events"),
)
async def watch_job(job_id: str, call: CallDep) -> EventSourceResponse:
    """Send the job as a server-sent event now and at each change, until it is finished.

    Each event holds the whole job: whoever was cut off connects again and has missed nothing.
    """
    first = await run_in_threadpool(find_job, call, job_id)
    return EventSourceResponse(_events(call, first), ping=15)


async def _events(call: Call, job: JobOut) -> AsyncIterator[ServerSentEvent]:
    sent = ""
    while True:
        tag = fingerprint(job)
        if tag != sent:
            yield ServerSentEvent(data=job.model_dump_json(), event="job", id=tag)
            sent = tag
        if job.state in FINAL:
            return
        await asyncio.sleep(LOOK_S)
        try:
            if not await run_in_threadpool(call.gate.is_still, call.who):
                return  # the key was revoked meanwhile
            job = await run_in_threadpool(find_job, call, job.id)
        except UnknownError:  # deleted while watched
            return
