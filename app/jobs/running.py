"""A job from its beginning to its end: tried again where that helps, else ended with a reason."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from functools import partial
from time import monotonic, sleep
from typing import Final

from structlog.contextvars import bound_contextvars

from app.jobs.answers import JobFailedError, NotWantedError
from app.jobs.queue import Handler
from app.runtime import metrics
from app.runtime.outage import CODE, Patience, is_outage
from app.store import Store
from app.store.jobs import Job, Kind

log = logging.getLogger(__name__)

# How long a job waits for a database, a storage or a disk before it fails (chosen): a night
OUTAGE_S: Final = 12 * 3600.0
OURS: Final = "an error of ours; the log of the worker has it; retry later, or report the file"
# What the first argument of a job is, for the log
_SUBJECT: Final[Mapping[Kind, str]] = {
    "photo": "photo_id",
    "correction": "correction_id",
    "measure": "lens_id",
}


def durable(kind: Kind, handler: Handler, give_up: Callable[[Job, JobFailedError], object]) -> Handler:
    """Wrap a job: failures are retried, and one that cannot be done is given up with a reason."""

    def run(*arguments: str | int) -> None:
        job, began, how = Job(kind, arguments), monotonic(), "done"
        with bound_contextvars(job_id=job.id, **{_SUBJECT[kind]: str(arguments[0])}):
            try:
                insist(partial(handler, *arguments), OUTAGE_S, kind)
            except NotWantedError:
                log.info("not wanted any more")
            except JobFailedError as reason:
                insist(partial(give_up, job, reason))
            except Exception as error:  # noqa: BLE001 - whatever it is, it has been logged
                how = CODE if is_outage(error) else "internal_error"
                insist(partial(give_up, job, JobFailedError(how, _why(error))))
        metrics.JOB_SECONDS.labels(kind, how).observe(monotonic() - began)

    return run


def _why(error: Exception) -> str:
    if not is_outage(error):
        return OURS
    name = type(error).__name__
    return f"the service waited in vain for what it needs ({name}): retry once its operator has mended that"


def insist(call: Callable[[], object], outage_s: float = math.inf, kind: Kind | None = None) -> None:
    """Do something again until it succeeds; raise its error after a few bugs, or an outage of that time."""
    patience = Patience(outage_s)
    while True:
        try:
            call()
        except (JobFailedError, NotWantedError):
            raise
        except Exception as error:
            outage = is_outage(error)
            log.warning("%s: %s", type(error).__name__, error, exc_info=None if outage else error)
            pause = patience.pause_after(error)
            if pause is None:
                raise
            if kind is not None:
                metrics.RETRIES.labels(kind, "outage" if outage else "unforeseen").inc()
            sleep(pause)
        else:
            return


def end_job(store: Store, job: Job, reason: JobFailedError) -> None:
    """End the work of a job with a reason; changes nothing where that has ended meanwhile."""
    log.info("job %s: %s: %s", job.id, reason.code, reason.detail)
    subject, number = str(job.arguments[0]), int(job.arguments[1])
    fail: Mapping[Kind, Callable[[str, int, str, str], object]] = {
        "photo": store.photos.fail,
        "correction": store.jobs.fail,
        "measure": store.lenses.fail,
    }
    fail[job.kind](subject, number, reason.code, reason.detail)
