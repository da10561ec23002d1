"""What 10,000 lenses and 1,000,000 photos need: tables of that size timed, and their queue simulated.

    python -m app.lab.scaling rows [--rows 1000000] [--photos 4] [--url ADDRESS]
    python -m app.lab.scaling queue --seconds 59 [--photos 1000000] [--days 365] [--slots 4 8]

`rows` fills an empty database (a SQLite file, or ADDRESS) with samples of made-up kernels, so many photos a
lens, then times what the service asks: the version of a lens, its samples, a page of lenses, the numbers of
`/metrics`, the checks of `lensmodel doctor`, a photo that leaves and joins, and the steps of the schema.

`queue` lets photos arrive at random with the hours of a day, each with its cells, and tells how long they
wait for a given number of slots; `--seconds` are the CPU seconds of a photo, which
`python -m lensmodel.lab.chain.calibration_cost` measures.
"""

from __future__ import annotations

import argparse
import functools
import heapq
import json
import math
import statistics
import sys
import tempfile
import time
import zlib
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import func, insert, select

from app.runtime.settings import Settings
from app.store import Store
from app.store.kinds import kind_key
from app.store.tables import EventRow, LensRow, OwnerRow, PatchRow, PhotoRow, SampleRow
from app.store.upkeep import migrate
from app.store.upkeep.invariants import INVARIANTS
from lensmodel.core.psf import gaussian

PATCHES, CHANNELS = 8, "rgb"  # of a made-up photo (chosen): fewer patches make more photos of the same rows
SIDE = 31  # pixels of a kernel: that of an estimate
PEAK = 2.5
"""The busiest hour of a day over its mean hour (chosen: people send photos in the evening)."""

CELLS = 8
FIRST_SHARE = 0.2
"""Cells of a photo with 24 patches, and the share of its cost before them (chosen: it hardly matters)."""


def fill(store: Store, rows: int, photos_of_a_lens: int) -> int:
    """Put counted photos with their samples into empty tables; return the number of lenses."""
    now = datetime.now(UTC)
    each = PATCHES * len(CHANNELS)
    photos = max(rows // each, 1)
    lenses = max(photos // photos_of_a_lens, 1)
    kernel = gaussian(SIDE, np.eye(2)).astype("<f4").tobytes()
    crc = zlib.crc32(kernel)
    with store.database.writing() as session:
        session.execute(insert(OwnerRow), [{"id": 1, "name": "local", "created_at": now}])
    for lens in range(1, lenses + 1):
        mine = range((lens - 1) * photos_of_a_lens + 1, min(lens * photos_of_a_lens, photos) + 1)
        with store.database.writing() as session:
            session.execute(insert(LensRow), [_lens(lens, len(mine), each, now)])
            session.execute(insert(PhotoRow), [_photo(key, lens, now) for key in mine])
            session.execute(insert(PatchRow), [_patch(key, k, now) for key in mine for k in range(PATCHES)])
            session.execute(
                insert(SampleRow),
                [
                    _sample(key, k, channel, lens, number, kernel, crc, now)
                    for number, key in enumerate(mine, start=1)
                    for k in range(PATCHES)
                    for channel in CHANNELS
                ],
            )
            session.execute(
                insert(EventRow),
                [_event(lens, number, key, each, now) for number, key in enumerate(mine, start=1)],
            )
    return lenses


def _lens(key: int, photos: int, each: int, now: datetime) -> dict[str, Any]:
    return {
        "id": key,
        "public_id": f"L{key:08d}",
        "owner_id": 1,
        "maker": "M",
        "model": f"Model {key % 50}",
        "serial": str(key),
        "serial_source": "exif",
        "identity_key": f"k{key}",
        "kind_key": kind_key("M", f"Model {key % 50}"),
        "version": photos,
        "rebuild_epoch": 0,
        "photo_count": photos,
        "sample_count": photos * each,
        "created_at": now,
    }


def _photo(key: int, lens: int, now: datetime) -> dict[str, Any]:
    return {
        "id": key,
        "public_id": f"P{key:09d}",
        "owner_id": 1,
        "lens_id": lens,
        "sha256": f"{key:064x}",
        "filename": "p.dng",
        "kind": "dng",
        "byte_size": 25_000_000,
        "blob_key": f"photos/P{key:09d}/original",
        "calibrate": True,
        "given": {},
        "width": 6000,
        "height": 4000,
        "aperture": 2.8,
        "focal_mm": 35.0,
        "pixel_pitch_um": 6.0,
        "epoch": 1,
        "attempt": 1,
        "state": "counted",
        "patches_total": PATCHES,
        "patches_done": PATCHES,
        "patches_rejected": 0,
        "windows_rejected": 0,
        "received_at": now,
        "stage_at": now,
        "finished_at": now,
        "counted_at": now,
    }


def _patch(photo: int, k: int, now: datetime) -> dict[str, Any]:
    return {
        "id": photo * PATCHES + k,
        "photo_id": photo,
        "epoch": 1,
        "idx": k,
        "cell": k,
        "row": 0,
        "col": 0,
        "size": 192,
        "r": k / PATCHES,
        "phi": 0.1 * k,
        "score": 1.0,
        "state": "done",
        "attempts": 1,
        "finished_at": now,
    }


def _sample(
    photo: int, k: int, channel: str, lens: int, version: int, kernel: bytes, crc: int, now: datetime
) -> dict[str, Any]:
    return {
        "photo_id": photo,
        "patch_id": photo * PATCHES + k,
        "lens_id": lens,
        "version_added": version,
        "channel": channel,
        "r": k / PATCHES,
        "phi": 0.1 * k,
        "weight": 1.0,
        "size": SIDE,
        "dtype": "<f4",
        "format_version": 1,
        "crc32": crc,
        "psf": kernel,
        "estimator": "made up",
        "diagnostics": {},
        "created_at": now,
    }


def _event(lens: int, version: int, photo: int, each: int, now: datetime) -> dict[str, Any]:
    return {
        "lens_id": lens,
        "version": version,
        "kind": "photo_added",
        "photo_public_id": f"P{photo:09d}",
        "epoch": 1,
        "samples_added": each,
        "samples": version * each,
        "photos": version,
        "created_at": now,
    }


def timed(what: Callable[[], object], times: int) -> float:
    """Return the median time of a call in milliseconds."""
    spent = []
    for _ in range(times):
        began = time.perf_counter()
        what()
        spent.append(1000 * (time.perf_counter() - began))
    return statistics.median(spent)


def rows(wishes: argparse.Namespace) -> dict[str, Any]:
    """Fill tables and time what is asked of them."""
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(
            data_dir=Path(folder), database_url=wishes.url, jobs_url=wishes.url, shared_filesystem=True
        )
        with closing(Store(settings)) as store:
            migrate.upgrade(store.database)
            began = time.perf_counter()
            lenses = fill(store, wishes.rows, wishes.photos)
            filled = time.perf_counter() - began
            middle = f"L{max(lenses // 2, 1):08d}"
            with store.database.reading() as session:
                photo = session.scalars(select(PhotoRow).order_by(PhotoRow.id.desc()).limit(1)).one()
            asked: dict[str, tuple[Callable[[], object], int]] = {
                "version of a lens": (lambda: store.samples.known_of(middle, "local"), 200),
                f"samples of a lens of {wishes.photos} photos": (lambda: store.samples.of_lens(middle), 5),
                "page of 50 lenses": (lambda: store.lenses.page("local", before=None, limit=50), 20),
                "numbers of /metrics": (store.operation.load, 5),
                "what the worker's sweep looks for": (store.photos.to_do, 20),
                "a photo is excluded": (
                    lambda: store.photos.change(photo.public_id, "local", {}, excluded=True),
                    1,
                ),
                "and counted again": (
                    lambda: store.photos.change(photo.public_id, "local", {}, excluded=False),
                    1,
                ),
            }
            figures: dict[str, Any] = {"lenses": lenses, "fill_s": round(filled, 1)}
            figures |= {f"{name}, ms": round(timed(*call), 2) for name, call in asked.items()}
            for invariant in INVARIANTS:
                with store.database.reading() as session:
                    began = time.perf_counter()
                    broken = invariant.find(session)
                    figures[f"check {invariant.name}, s"] = round(time.perf_counter() - began, 2)
                    assert not broken, (invariant.name, broken[:3])
            if store.database.is_sqlite:
                figures["file_mb"] = store.database.path.stat().st_size >> 20
            return figures | migrations(store)


def migrations(store: Store) -> dict[str, float]:
    """Undo all schema steps but the first on the filled tables, then do them at once, as an update does."""

    def spent(what: Callable[[], object]) -> float:
        began = time.perf_counter()
        what()
        return round(time.perf_counter() - began, 2)

    count = select(func.count()).select_from(SampleRow)
    with store.database.reading() as session:
        before = session.scalar(count)
    figures = {
        f"schema {step.revision} undone, s": spent(
            functools.partial(migrate.downgrade, store.database, str(step.down_revision))
        )
        for step in migrate.steps()
        if step.down_revision
    }
    figures["all of them done, s"] = spent(lambda: migrate.upgrade(store.database))
    with store.database.reading() as session:
        assert session.scalar(count) == before
    return figures


def simulate(photos_a_day: float, slots: int, seconds: float, *, days: float, seed: int) -> dict[str, float]:
    """Let photos arrive for some days and be worked on by slots, first come, first served.

    Arrivals are a Poisson process whose rate follows the hours of the day, ``1 + (PEAK - 1) sin``, cut at 0
    and scaled to the mean; a photo is inspected, developed and searched in one slot, then its cells are taken
    up one by one. Returns hours and shares.
    """
    rng = np.random.default_rng(seed)
    rate = photos_a_day / 86400.0
    clock, arrivals = 0.0, []
    while clock < days * 86400.0:  # thinning: candidates at the peak's rate, kept by the hour's share
        clock += rng.exponential(1.0 / (PEAK * rate))
        hour = 1.0 + (PEAK - 1.0) * math.sin(2 * math.pi * clock / 86400.0)
        if rng.random() < max(hour, 0.0) / PEAK:
            arrivals.append(clock)
    free = [0.0] * slots
    heapq.heapify(free)
    first, cell = FIRST_SHARE * seconds, (1.0 - FIRST_SHARE) * seconds / CELLS
    waits, ends, busy = [], [], 0.0
    queue: list[tuple[float, int, int]] = [(at, number, 0) for number, at in enumerate(arrivals)]
    heapq.heapify(queue)
    left = [CELLS] * len(arrivals)
    while queue:
        ready, number, stage = heapq.heappop(queue)
        slot = heapq.heappop(free)
        start = max(ready, slot)
        cost = (first if stage == 0 else cell) * rng.lognormal(-0.125, 0.5)  # mean 1, as varied as photos
        heapq.heappush(free, start + cost)
        busy += cost
        if stage == 0:
            waits.append(start - ready)
            for _ in range(left[number]):
                heapq.heappush(queue, (start + cost, number, 1))
        else:
            left[number] -= 1
            if left[number] == 0:
                ends.append(start + cost - arrivals[number])
    span = max(*free, days * 86400.0)
    return {
        "photos": len(arrivals),
        "busy_share": busy / (slots * span),
        "begun_after_p50_s": float(np.median(waits)),
        "begun_after_p99_s": float(np.quantile(waits, 0.99)),
        "counted_after_p50_min": float(np.median(ends)) / 60,
        "counted_after_p99_min": float(np.quantile(ends, 0.99)) / 60,
    }


def queue(wishes: argparse.Namespace) -> list[dict[str, float]]:
    """Simulate two days at the daily rate for several numbers of slots."""
    a_day = wishes.photos / wishes.days
    return [
        {"slots": slots}
        | {k: round(v, 3) for k, v in simulate(a_day, slots, wishes.seconds, days=2.0, seed=1).items()}
        for slots in wishes.slots
    ]


def main() -> int:
    """Print one JSON object a line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parts = parser.add_subparsers(required=True)
    tables = parts.add_parser("rows")
    tables.add_argument("--rows", type=int, default=1_000_000)
    tables.add_argument("--photos", type=int, default=4, help="of each lens")
    tables.add_argument("--url", default="")
    tables.set_defaults(run=rows)
    waiting = parts.add_parser("queue")
    waiting.add_argument("--photos", type=int, default=1_000_000)
    waiting.add_argument("--days", type=float, default=365.0)
    waiting.add_argument("--slots", type=int, nargs="+", default=[4, 6, 8, 12])
    waiting.add_argument("--seconds", type=float, required=True, help="CPU seconds of one photo")
    waiting.set_defaults(run=queue)
    wishes = parser.parse_args()
    figures = wishes.run(wishes)
    for line in figures if isinstance(figures, list) else [figures]:
        print(json.dumps(line))
    return 0


if __name__ == "__main__":
    sys.exit(main())
