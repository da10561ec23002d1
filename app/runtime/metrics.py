"""Metrics of the service, in the text format of Prometheus.

Queues and workers are read from the tables at each request, so that any API reports them for all machines. No
label holds an id or the name of a person.
"""

from __future__ import annotations

from typing import Final

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest, start_http_server
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_1_0_0

from app.store import Store

CONTENT_TYPE: Final = CONTENT_TYPE_PLAIN_1_0_0

_QUICK: Final = (0.001, 0.0025, 0.005, 0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0)
# Upper bounds of the buckets in seconds, of requests and of jobs: the goals of 5, 20 and 100 ms are among
# them, the others are chosen, about evenly on a logarithmic scale
_LONG: Final = (0.1, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 180.0, 600.0, 1800.0, 3600.0)
API: Final = CollectorRegistry()
WORKER: Final = CollectorRegistry()

REQUEST_SECONDS: Final = Histogram(
    "lensmodel_http_request_seconds",
    "Time from the head of a request to the end of its answer.",
    ("method", "route", "status"),
    registry=API,
    buckets=_QUICK,
)
MODELS: Final = Counter(
    "lensmodel_model_cache", "Requests for a model, by outcome.", ("outcome",), registry=API
)
MODEL_BYTES: Final = Gauge(
    "lensmodel_model_cache_bytes", "Memory of the fitted models of this process.", registry=API
)
QUEUE_JOBS: Final = Gauge("lensmodel_queue_jobs", "Unfinished jobs.", ("kind", "state"), registry=API)
QUEUE_OLDEST: Final = Gauge(
    "lensmodel_queue_oldest_seconds", "Age of the oldest job that nobody began.", ("kind",), registry=API
)
WORKERS: Final = Gauge("lensmodel_workers", "Workers heard of within their lease.", registry=API)
JOB_SECONDS: Final = Histogram(
    "lensmodel_job_seconds",
    "Time of a job from its start in a worker to its end, waiting for its parts included.",
    ("kind", "ending"),
    registry=WORKER,
    buckets=_LONG,
)
RETRIES: Final = Counter(
    "lensmodel_job_retries", "Tries after a failed one, by its cause.", ("kind", "cause"), registry=WORKER
)
TASKS: Final = Counter(
    "lensmodel_tasks", "Child processes by how they ended.", ("task", "ending"), registry=WORKER
)
FENCED: Final = Counter(
    "lensmodel_workers_fenced", "Workers of this folder that stopped themselves.", registry=WORKER
)
TAKEN_OVER: Final = Counter(
    "lensmodel_workers_taken_over", "Dead workers whose work others took over.", registry=WORKER
)


def of_service(store: Store, lease_s: float) -> bytes:
    """Return the metrics of an API: its own, and those of the tables."""
    jobs, oldest_s = store.jobs.load()
    for (kind, state), count in jobs.items():
        QUEUE_JOBS.labels(kind, state).set(count)
    for kind, seconds in oldest_s.items():
        QUEUE_OLDEST.labels(kind).set(seconds)
    WORKERS.set(len(store.jobs.live(lease_s)))
    return generate_latest(API)


def publish(address: str) -> None:
    """Serve the metrics of this worker on an address of its own, host:port."""
    host, _, port = address.rpartition(":")
    start_http_server(int(port), addr=host, registry=WORKER)
