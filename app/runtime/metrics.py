"""What the service measures of itself, in the text format of Prometheus.

The API measures requests and models, a worker its jobs. A worker has no address of its own unless
`LENS_METRICS_PORT` gives it one, so it also leaves its numbers in a file, and `/metrics` of an API with the
same data folder tells them together with its own. What waits and who works is read from the tables when it is
asked for, so that any API tells it for all machines. No label holds an id or a name of anybody.
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
"""So long the numbers of a worker that is gone still count, lest sums fall with each restart."""

_QUICK: Final = (0.001, 0.0025, 0.005, 0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0)
_LONG: Final = (0.1, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 180.0, 600.0, 1800.0, 3600.0)
"""Bounds of the buckets in seconds: the goals of 5, 20 and 100 ms are among them; chosen besides."""

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
    """What waits, for how long, and who works: read from the tables when it is asked for."""

    def __init__(self, store: Store, lease_s: float) -> None:
        self._store, self._lease_s = store, lease_s

    def collect(self) -> Iterator[Metric]:
        """Give the numbers of this moment."""
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
    """What workers have left in files of a folder, added up."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def collect(self) -> Iterator[Metric]:
        """Give each family once, with the sums over all files."""
        families: dict[str, Metric] = {}
        sums: dict[str, dict[tuple[str, tuple[tuple[str, str], ...]], float]] = {}
        for family in self._families():
            families.setdefault(family.name, Metric(family.name, family.documentation, family.type))
            added = sums.setdefault(family.name, {})
            for sample in family.samples:
                if not sample.name.endswith("_created"):  # points in time add up to nothing
                    key = (sample.name, tuple(sorted(sample.labels.items())))
                    added[key] = added.get(key, 0.0) + sample.value
        for name, family in families.items():
            for (sample_name, labels), value in sums[name].items():
                family.add_sample(sample_name, dict(labels), value)
            yield family

    def _families(self) -> Iterable[Metric]:
        for path in sorted(self._folder.glob("*.prom")):
            with contextlib.suppress(OSError, ValueError):  # gone or torn since it was listed
                yield from text_string_to_metric_families(path.read_text(encoding="utf-8"))


def of_service(store: Store, lease_s: float, data_dir: Path) -> bytes:
    """Return what an API tells: its own numbers, those of the tables and those of its folder's workers."""
    asked = CollectorRegistry()
    asked.register(Tables(store, lease_s))
    asked.register(Written(data_dir / FOLDER))
    return generate_latest(API) + generate_latest(asked)


def leave(data_dir: Path, worker_id: str) -> None:
    """Write the numbers of this worker where an API finds them; remove those of workers long gone."""
    folder = data_dir / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for path in folder.glob("*.prom*"):
        with contextlib.suppress(FileNotFoundError):
            if time.time() - path.stat().st_mtime > KEEP_S:
                path.unlink()
    write_to_textfile(os.fspath(folder / f"{worker_id}.prom"), WORKER)


def publish(port: int, host: str, data_dir: Path) -> None:
    """Serve the numbers of the workers of this folder under an address of their own."""
    told = CollectorRegistry()
    told.register(Written(data_dir / FOLDER))
    start_http_server(port, addr=host, registry=told)
