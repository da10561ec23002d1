"""Logging and metrics of each job: its ids in the log lines, its duration, how it ended."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

from structlog.contextvars import bound_contextvars

from app.runtime import metrics
from app.runtime.outage import is_outage

_SUBJECT: Final = {
    "photo": "photo_id",
    "cell": "photo_id",
    "correction": "correction_id",
    "measure": "lens_id",
}


@dataclass
class JobRecord:
    """Kind and ending of one job."""

    kind: str
    ending: str = "done"

    def retries(self, error: BaseException) -> None:
        """Count a retry of the job after an error."""
        metrics.RETRIES.labels(self.kind, "outage" if is_outage(error) else "unforeseen").inc()


@contextmanager
def accounted(kind: str, arguments: Sequence[str | int]) -> Iterator[JobRecord]:
    """Provide the record of a job; inside, each log line carries the ids of the job and its subject."""
    record = JobRecord(kind)
    ids = {"job_id": "/".join([kind, *map(str, arguments)])}
    if kind in _SUBJECT:
        ids[_SUBJECT[kind]] = str(arguments[0])
    began = time.monotonic()
    with bound_contextvars(**ids):
        try:
            yield record
        except BaseException:
            record.ending = "raised"
            raise
        finally:
            metrics.JOB_SECONDS.labels(kind, record.ending).observe(time.monotonic() - began)
