"""Jobs as they cross HTTP."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from app.schemas.fields import Model, Problem

JobState = Literal["queued", "running", "waiting", "succeeded", "failed", "cancelled"]


class JobProgress(Model):
    """How far a job is."""

    done: int
    total: int
    unit: str


class JobLinks(Model):
    """Where to go from a job."""

    self: str
    photo: str | None
    lens: str | None
    correction: str | None
    result: str | None


class JobOut(Model):
    """Background work: of a photo or of a correction; its id is that of what it makes."""

    id: str
    kind: Literal["photo", "correction", "rebuild"]
    state: JobState
    stage: str | None
    progress: JobProgress
    eta_seconds: float | None
    attempt: int
    error: Problem | None
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    links: JobLinks


class RetriedOut(Model):
    """How many jobs were started anew."""

    retried: int


class JobPage(Model):
    """Some jobs, newest first."""

    items: list[JobOut]
    next: str | None
