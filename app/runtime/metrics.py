"""Metrics of the service, in the text format of Prometheus.

The API measures requests and models, a worker its jobs. A worker has no address of its own unless
`LENS_METRICS_PORT` gives it one, so it also writes its metrics to a file, and `/metrics` of an API with the
same data folder serves them with its own. Queues and workers are read from the tables at each request, so
that any API reports them for all machines. No label holds an id or the name of a person.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    generate_latest,
    start_http_server,
    write_to_textfile,
)
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_1_0_0
from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.registry import Collector

from app.store import Store

CONTENT_TYPE: Final = CONTENT_TYPE_PLAIN_1_0_0
FOLDER: Final = "metrics"
KEEP_S: Final = 86400.0
"""How long the metrics of a worker that has ended still count (chosen: a day of restarts; shorter, sums fall
with each, longer, files pile up)."""

_QUICK: Final = (0.001, 0.0025, 0.005, 0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0)
_LONG: Final = (0.1, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 180.0, 600.0, 1800.0, 3600.0)
"""Upper bounds of the buckets in seconds, of requests and of jobs: the goals of 5, 20 and 100 ms are among
them, the others are chosen, about evenly on a logarithmic scale."""

API: Final = CollectorRegistry()
WORKER: Final = CollectorRegistry()

REQUEST_SECONDS: Final = Histogram(
    "lensmodel_http_request_seconds",
    "Time from the head of a request to the end of its answer.",
    ("method", "route", "status"),
    registry=API,
    buckets=_QUICK,
)
QUERY_SECONDS: Final = Histogram(
    "lensmodel_psf_query_seconds", "Time to answer for one PSF.", registry=API, buckets=_QUICK
)
MODELS: Final = Counter(
    "lensmodel_model_cache", "Models asked for, by what became of that.", ("outcome",), registry=API
)
MODEL_BYTES: Final = Gauge(
    "lensmodel_model_cache_bytes", "Memory of the fitted models of this process.", registry=API
)
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


class Tables(Collector):
    """Queues, their age and the live workers, read from the tables at each request."""

    def __init__(self, store: Store, lease_s: float) -> None:
        self._store, self._lease_s = store, lease_s

    def collect(self) -> Iterator[Metric]:
        """Yield the present values."""
        load = self._store.operation.load()
        depth = GaugeMetricFamily("lensmodel_queue_jobs", "Unfinished jobs.", labels=("kind", "state"))
        for (kind, state), count in load.jobs.items():
            depth.add_metric((kind, state), count)
        age = GaugeMetricFamily(
            "lensmodel_queue_oldest_seconds", "Age of the oldest job that nobody began.", labels=("kind",)
        )
        for kind, seconds in load.oldest_s.items():
            age.add_metric((kind,), seconds)
        workers = GaugeMetricFamily("lensmodel_workers", "Workers heard of within their lease.")
        workers.add_metric((), len(self._store.workers.live(self._lease_s)))
        garbage = GaugeMetricFamily("lensmodel_garbage", "Groups of blobs that wait to be deleted.")
        garbage.add_metric((), load.garbage)
        rows = GaugeMetricFamily("lensmodel_rows", "Rows that are not deleted.", labels=("table",))
        for table, count in load.rows.items():
            rows.add_metric((table,), count)
        yield from (depth, age, workers, garbage, rows)


class Written(Collector):
    """Sums of the metrics that workers have written to files of a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def collect(self) -> Iterator[Metric]:
        """Yield each family once, with the sums over all files."""
        families: dict[str, Metric] = {}
        sums: dict[str, dict[tuple[str, tuple[tuple[str, str], ...]], float]] = {}
        for family in self._families():
            families.setdefault(family.name, Metric(family.name, family.documentation, family.type))
            added = sums.setdefault(family.name, {})
            for sample in family.samples:
                if not sample.name.endswith("_created"):  # times of creation cannot be added
                    key = (sample.name, tuple(sorted(sample.labels.items())))
                    added[key] = added.get(key, 0.0) + sample.value
        for name, family in families.items():
            for (sample_name, labels), value in sums[name].items():
                family.add_sample(sample_name, dict(labels), value)
            yield family

    def _families(self) -> Iterable[Metric]:
        for path in sorted(self._folder.glob("*.prom")):
            with contextlib.suppress(OSError, ValueError):  # deleted, or half written
                yield from text_string_to_metric_families(path.read_text(encoding="utf-8"))


def of_service(store: Store, lease_s: float, data_dir: Path) -> bytes:
    """Return the metrics of an API: its own, those of the tables and those of its folder's workers."""
    collected = CollectorRegistry()
    collected.register(Tables(store, lease_s))
    collected.register(Written(data_dir / FOLDER))
    return generate_latest(API) + generate_latest(collected)


def leave(data_dir: Path, worker_id: str) -> None:
    """Write the metrics of this worker where an API finds them; remove those of workers long ended."""
    folder = data_dir / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for path in folder.glob("*.prom*"):
        with contextlib.suppress(FileNotFoundError):
            if time.time() - path.stat().st_mtime > KEEP_S:
                path.unlink()
    write_to_textfile(os.fspath(folder / f"{worker_id}.prom"), WORKER)


def publish(port: int, host: str, data_dir: Path) -> None:
    """Serve the metrics of the workers of this folder on a port of their own."""
    collected = CollectorRegistry()
    collected.register(Written(data_dir / FOLDER))
    start_http_server(port, addr=host, registry=collected)
