"""Random deaths and outages under work, and then: everything counted exactly once, nothing lost.

    python tests/app/endurance/torture.py --seeds 20              # SQLite and a folder
    python tests/app/endurance/torture.py --seeds 20 --servers    # PostgreSQL and S3 (moto)

Three workers estimate the photos of two owners while, as the seed says, workers are killed (alone, or with
their children) or paused for longer than their lease, uploads end while they are due for deletion, the
database server crashes, the storage goes away, and disks are full: that of the data
folder, and that of the database server. What must hold afterwards is what `lensmodel doctor` checks, and the
exact numbers of photos, samples and versions. Disks are filled where this may mount small ones, as root.
"""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path
from typing import Any, TypeAlias
from unittest import mock

import programs
from crew import CELLS, CHANNELS, Crew, check_counts, databases, pause, states
from deadline import stretched
from obstore.exceptions import BaseError
from servers import Postgres, moto, postgres
from small_disk import kept_full, small_disk
from sqlalchemy import exc
from uploads import send

from app.blobs.storage import Storage
from app.errors import BusyError
from app.runtime.doctor import examine
from app.runtime.settings import Settings
from app.store import Store
from app.store.database import upgrade

OWNERS = ("one", "two")
Spell: TypeAlias = Callable[[], contextlib.AbstractContextManager[None]]

WORKERS, PAUSES, FULL_DISKS = 3, 2, 3
LATE = 4  # photos whose uploads take too long at first
PATIENCE_S = 300.0


@contextlib.contextmanager
def folder_away(settings: Settings) -> Iterator[None]:
    folder = Storage(settings.storage).folder
    assert folder is not None
    aside = folder.with_name("aside")
    folder.rename(aside)
    try:
        yield
    finally:
        shutil.rmtree(folder, ignore_errors=True)  # a write that began before has made another one
        aside.rename(folder)


@contextlib.contextmanager
def crashed(server: Postgres) -> Iterator[None]:
    server.stop()
    try:
        yield
    finally:
        server.start()


@contextlib.contextmanager
def cramped(server: Postgres, disk: Path) -> Iterator[None]:
    """Fill the disk of a database server; who frees it starts the server again, where it gave up."""
    with kept_full(disk):
        yield
    server.start_if_down()


def installation(
    stack: contextlib.ExitStack, folder: Path, *, servers: bool
) -> tuple[Settings, list[Spell], list[Spell]]:
    """Begin what an installation needs; return its settings, and what outages and full disks can be."""
    disk, full = folder / "disk", list[Spell]()
    disk.mkdir()
    common: Any = {"data_dir": disk / "data", "lease_seconds": 4.0, "worker_slots": 2, "min_free_mb": 0}
    if stack.enter_context(small_disk(disk, 128)):
        full.append(lambda: kept_full(disk))
    if not servers:
        settings = Settings(**common)
        return settings, [lambda: folder_away(settings)], full
    cluster = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lensmodel-pg-")))
    small = stack.enter_context(small_disk(cluster, 512))
    server = stack.enter_context(postgres(folder=cluster))
    if small:
        full.append(lambda: cramped(server, cluster))
    s3 = stack.enter_context(moto("torture"))
    stack.enter_context(mock.patch.dict(os.environ, s3.environment()))  # of the workers too
    addresses = {"database_url": server.url("app"), "storage_url": "s3://torture"}
    settings = Settings(**common, **addresses, storage_seconds=3.0)
    return settings, [lambda: crashed(server), s3.hanging], full


class Torture:
    """One installation, and what is done to it."""

    def __init__(self, settings: Settings, log: Path, chance: random.Random) -> None:
        self.settings, self.chance = settings, chance
        settings.data_dir.mkdir(parents=True)
        self.store, self.storage = Store(settings), Storage(settings.storage)
        upgrade(self.store.database)
        self.crew, self.ended = Crew(settings, log), threading.Event()

    def close(self) -> None:
        self.ended.set()
        self.crew.close()
        self.store.close()

    def send(self, number: int, **how: Any) -> None:
        send(self.store, self.storage, number, owner=OWNERS[number % len(OWNERS)], **how)

    def send_late(self, numbers: range, chance: random.Random) -> None:
        """Send photos whose uploads take so long that they are due for deletion, until each is accepted."""
        for number in numbers:
            while not self.ended.is_set():
                try:
                    self.send(number, within=timedelta(hours=-2), pause_s=chance.uniform(0.0, 1.0))
                except (BusyError, exc.DBAPIError, BaseError, OSError):
                    time.sleep(0.2)
                else:
                    break

    def lose_one(self) -> None:
        """Kill a worker, alone or with its children, and hire another."""
        self.crew.kill(self.chance.choice(self.crew.processes), group=self.chance.random() < 0.5)
        self.crew.hire()

    def pause_one(self) -> None:
        """Pause a worker for longer than its lease, outside of transactions: a lock would stop the others."""
        pid, is_file = (
            self.chance.choice(self.crew.processes).pid,
            self.settings.database.startswith("sqlite"),
        )
        pause(pid, databases(self.settings) if is_file else [])
        time.sleep(self.settings.lease_seconds + 2.0)
        os.kill(pid, signal.SIGCONT)

    def replace_the_dead(self) -> None:
        """Hire for those that ended themselves: fenced, or without their database for a lease."""
        for process in [p for p in self.crew.processes if p.poll() is not None]:
            self.crew.processes.remove(process)
            self.crew.hire()

    def do(self, deed: str, outages: list[Spell], full_disks: list[Spell]) -> None:
        """Let one thing happen."""
        chance = self.chance
        time.sleep(chance.uniform(0.2, 1.5))
        if deed == "kill":
            self.lose_one()
        elif deed == "pause":
            self.pause_one()
        elif deed == "outage":
            with chance.choice(outages)():
                time.sleep(chance.uniform(1.0, 5.0))
        else:
            with chance.choice(full_disks)():
                time.sleep(chance.uniform(0.5, 2.5))
                self.lose_one()  # the next one starts without room
                time.sleep(chance.uniform(0.5, 2.5))
        self.replace_the_dead()

    def settle(self, is_all_sent: Callable[[], bool]) -> None:
        """Wait until all photos are counted."""
        end = time.monotonic() + stretched(PATIENCE_S)
        while not is_all_sent() or set(states(self.store)) != {"counted"}:
            self.replace_the_dead()
            now = set(states(self.store))
            shown = f"{now}\n{self.crew.log.read_text()[-6000:]}"
            assert not now & {"failed", "cancelled", "needs_lens"}, shown
            assert time.monotonic() < end, shown
            time.sleep(0.2)

    def check(self, expected: int) -> None:
        findings = examine(self.settings, self.store, self.storage, deep=False)
        assert not [finding for finding in findings if finding.check != "work"], findings
        for owner in OWNERS:
            check_counts(self.store, expected // len(OWNERS), owner)


def torture(
    folder: Path, seed: int, *, servers: bool, photos: int = 8, kills: int = 20, outages: int = 3
) -> str:
    """Do it once; return what happened in one line.

    Raises
    ------
    AssertionError
        If anything was lost, counted twice, or seen by another owner.
    """
    chance, began = random.Random(seed), time.monotonic()
    with contextlib.ExitStack() as stack:
        settings, ways, full = installation(stack, folder, servers=servers)
        late_thread = stack.enter_context(ThreadPoolExecutor(1))
        work = stack.enter_context(contextlib.closing(Torture(settings, folder / "workers.log", chance)))
        for number in range(photos - LATE):
            work.send(number)
        late_ones = range(photos - LATE, photos)
        late = late_thread.submit(work.send_late, late_ones, random.Random(chance.random()))
        for _ in range(WORKERS):
            work.crew.hire()
        full_disks = FULL_DISKS if full else 0
        deeds = ["kill"] * kills + ["outage"] * outages + ["full disk"] * full_disks + ["pause"] * PAUSES
        chance.shuffle(deeds)
        for deed in deeds:
            work.do(deed, ways, full)
        work.settle(late.done)
        late.result()  # what it did not foresee
        work.check(photos)
    return (
        f"seed {seed}: {photos} of {photos} photos counted once, {photos * CELLS * CHANNELS} samples, "
        f"{kills} kills, {outages} outages, {PAUSES} pauses, {full_disks} full disks, "
        f"{time.monotonic() - began:.0f} s"
    )


def main() -> int:
    wanted = programs.wishes(__doc__, seeds=20, first=0, servers=False)
    failed = 0
    for seed in range(wanted.first, wanted.first + wanted.seeds):
        with tempfile.TemporaryDirectory(prefix="lensmodel-torture-") as folder:
            try:
                print(torture(Path(folder), seed, servers=wanted.servers), flush=True)
            except AssertionError as error:
                failed += 1
                print(f"seed {seed}: FAILED: {error}", flush=True)
    print(f"{wanted.seeds - failed} of {wanted.seeds} seeds passed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
