"""Whether the service lives, is ready, and what it can do."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Final, get_args

from fastapi import APIRouter, Response

from app.http.dependencies import Call, CallDep, OneSession, ProbeDep
from app.routes.jobs import LONG_POLL_S
from app.routes.photos import GIB, MAX_UNFINISHED
from app.routes.psf import MEDIA_TYPES
from app.runtime import metrics
from app.sandbox import confine
from app.schemas import MAX_PSF_SIZE, ColorSpace, OutputFormat, Readiness
from app.store.database import current, head
from lensmodel.blind import estimators
from lensmodel.correction import deconvolvers
from lensmodel.patches import selectors

# Seconds for which `/readyz` repeats its answer (chosen): strangers who ask often cost nothing
FRESH_S: Final = 2.0
READY_S: Final = 3.0  # seconds for all checks (chosen): less than the 5 s that container engines usually wait
probes = APIRouter(tags=["service"], route_class=OneSession)
router = APIRouter(tags=["service"], route_class=OneSession)


@probes.get("/healthz")
def get_health() -> dict[str, str]:
    """Say that the process lives."""
    return {"status": "ok"}


@probes.get("/readyz", responses={503: {"model": Readiness, "description": "Something is missing"}})
def get_readiness(call: ProbeDep) -> Readiness:
    """Say whether work can be taken: schema, storage and a worker are there."""
    readiness = call.readiness.get(lambda: _readiness(call))
    if readiness.status != "ready":
        call.response.status_code = 503
    return readiness


def _readiness(call: Call) -> Readiness:
    """Try all at once, in daemon threads: one that hangs must delay neither the response nor the exit."""
    confined: dict[str, bool] = {}
    tried: dict[str, Callable[[], None]] = {
        "schema": lambda: _schema(call),
        "storage": call.storage.check_usable,
        "worker": lambda: confined.update(_worker(call)),
    }
    outcomes = dict.fromkeys(tried, f"TimeoutError: no answer within {READY_S:g} s")

    def run(name: str, probe: Callable[[], None]) -> None:
        try:
            probe()
        except Exception as error:  # noqa: BLE001 - every error is a result of the probe
            outcomes[name] = f"{type(error).__name__}: {error}"[:300]
        else:
            outcomes[name] = "ok"

    threads = [threading.Thread(target=run, args=each, daemon=True) for each in tried.items()]
    end = time.monotonic() + READY_S
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(max(end - time.monotonic(), 0.0))
    checks = dict(outcomes)  # as it is now
    if call.settings.needs_keys:  # strangers learn what is wrong, but no addresses
        checks = {name: outcome.partition(":")[0] for name, outcome in checks.items()}
    ready = all(outcome == "ok" for outcome in checks.values())
    return Readiness(status="ready" if ready else "not ready", checks=checks, sandbox=confined)


def _schema(call: Call) -> None:
    database, program = current(call.store.database), head()
    if database != program:
        raise RuntimeError(
            f"the database is at {database}, this program needs {program}: run `lensmodel serve`"
        )


def _worker(call: Call) -> dict[str, bool]:
    """Return which measures confine the children of all workers."""
    live = call.store.jobs.live(call.settings.lease_seconds)
    if not live:
        raise RuntimeError(
            f"no worker was heard of for {call.settings.lease_seconds:g} s: run `lensmodel worker`"
        )
    return {name: all(name in worker.confined.split() for worker in live) for name in confine.MEASURES}


@probes.get("/metrics", include_in_schema=False)
def get_metrics(call: CallDep) -> Response:
    """Return the numbers of this service for Prometheus."""
    text = metrics.of_service(call.store, call.settings.lease_seconds)
    return Response(text, media_type=metrics.CONTENT_TYPE)


@router.get("/version")
def get_version(call: CallDep) -> dict[str, str | None]:
    """Return what runs here, and which revision of the schema the database has."""
    revision = current(call.store.database)
    return {"name": "lensmodel", "version": version("lensmodel"), "api": "v1", "schema_revision": revision}


@router.get("/formats")
def get_formats() -> dict[str, list[str]]:
    """Return what can be read and written, and the methods by name."""
    return {
        "read": ["raw", "dng", "tiff", "png", "jpeg"],
        "write": list(get_args(OutputFormat)),
        "color_spaces": list(get_args(ColorSpace)),
        "psf": list(MEDIA_TYPES),
        "methods": list(deconvolvers),
        "estimators": list(estimators),
        "selectors": list(selectors),
    }


@router.get("/limits")
def get_limits(call: CallDep) -> dict[str, int | float]:
    """Return how much of everything."""
    settings = call.settings
    return {
        "max_upload_bytes": settings.max_upload_mb << 20,
        "max_megapixels": settings.max_megapixels,
        "max_queued_photos": MAX_UNFINISHED,
        "max_stored_bytes": int(settings.max_stored_gb * GIB),
        "max_psf_size": MAX_PSF_SIZE,
        "long_poll_seconds": LONG_POLL_S,
        "keep_results_days": settings.keep_results_days,
    }
