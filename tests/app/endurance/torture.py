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

import argparse
import contextlib
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TypeAlias

from obstore.exceptions import BaseError
from sqlalchemy import exc, func, select

HERE = Path(__file__).parents[1]
sys.path.insert(0, str(HERE))

from crew import CELLS, CHANNELS, Crew, databases, pause, states  # noqa: E402 - of the tests of the service
from deadline import stretched  # noqa: E402
from servers import Postgres, moto, postgres  # noqa: E402
from small_disk import kept_full, small_disk  # noqa: E402
from uploads import receive  # noqa: E402

from app.blobs.storage import Storage  # noqa: E402
from app.errors import BusyError  # noqa: E402
from app.runtime.doctor import examine  # noqa: E402
from app.runtime.settings import Settings  # noqa: E402
from app.store import Store  # noqa: E402
from app.store.database import new_id, upgrade  # noqa: E402
from app.store.tables import LensRow, OwnerRow, PhotoRow, SampleRow  # noqa: E402

OWNERS = ("one", "two")
PHOTO = b"a photo"


@dataclass(frozen=True)
class Plan:
    """How hard it gets."""

    photos: int = 8
    workers: int = 3
    kills: int = 20
    outages: int = 3
    full_disks: int = 3
    pauses: int = 2
    late: int = 4
    patience_s: float = 300.0


class Victims(Crew):
    """Workers that die, sleep, and are replaced."""

    def lose_one(self, chance: random.Random) -> None:
        """Kill one of them, alone or with its children, and hire another."""
        self.kill(chance.choice(self.processes), group=chance.random() < 0.5)
        self.hire()

    @contextlib.contextmanager
    def paused(self, chance: random.Random, files: list[Path]) -> Iterator[None]:
        """Pause one of them, outside of transactions: with the lock of a file it would stop all of them."""
        pid = chance.choice(self.processes).pid
        pause(pid, files)
        try:
            yield
        finally:
            os.kill(pid, signal.SIGCONT)

    def replace_the_dead(self) -> None:
        """Hire for those that ended themselves: fenced, or without their database for a lease."""
        for process in [p for p in self.processes if p.poll() is not None]:
            self.processes.remove(process)
            self.hire()


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


Spell: TypeAlias = Callable[[], contextlib.AbstractContextManager[None]]


@dataclass(frozen=True)
class Installation:
    """Settings, what the environment of workers holds besides, and what outages and full disks can be."""

    settings: Settings
    extra: dict[str, str]
    outages: list[Spell]
    full_disks: list[Spell]


@contextlib.contextmanager
def installation(folder: Path, *, servers: bool) -> Iterator[Installation]:
    with contextlib.ExitStack() as stack:
        disk = folder / "disk"
        disk.mkdir()
        small = stack.enter_context(small_disk(disk, 128))
        common = {"data_dir": disk / "data", "lease_seconds": 4.0, "worker_slots": 2}
        full: list[Spell] = [lambda: kept_full(disk)] if small else []
        if not servers:
            settings = Settings(**common, min_free_mb=0)  # type: ignore[arg-type]  # checked by pydantic
            yield Installation(settings, {}, [lambda: folder_away(settings)], full)
            return
        cluster = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lensmodel-pg-")))
        small = stack.enter_context(small_disk(cluster, 512))
        server = stack.enter_context(postgres(folder=cluster))
        if small:
            full.append(lambda: cramped(server, cluster))
        store = stack.enter_context(moto("torture"))
        stack.enter_context(in_environment(store.environment))
        settings = Settings(
            **common,  # type: ignore[arg-type]  # checked by pydantic
            min_free_mb=0,
            database_url=server.url("app"),
            storage_url="s3://torture",
            storage_seconds=3.0,
        )
        yield Installation(settings, store.environment, [lambda: crashed(server), store.hanging], full)


@contextlib.contextmanager
def in_environment(values: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def send_late(
    store: Store, storage: Storage, number: int, chance: random.Random, ended: threading.Event
) -> None:
    """Send a photo whose upload takes so long that it is due for deletion, until one is accepted."""
    while not ended.is_set():
        try:
            send(store, storage, number, within=timedelta(hours=-2), pause_s=chance.uniform(0.0, 1.0))
        except (BusyError, exc.DBAPIError, BaseError, OSError):
            time.sleep(0.2)
        else:
            return


def send(
    store: Store,
    storage: Storage,
    number: int,
    *,
    within: timedelta = timedelta(minutes=1),
    pause_s: float = 0.0,
) -> None:
    public_id = new_id()
    store.photos.expect(f"photos/{public_id}/", within=within)
    storage.put(f"photos/{public_id}/original", PHOTO)
    time.sleep(pause_s)
    receive(
        store, public_id, owner=OWNERS[number % len(OWNERS)], sha256=f"{number:064x}", byte_size=len(PHOTO)
    )


def said(store: Store) -> list[str]:
    """Return how photos are, with the reasons of those that ended."""
    with store.database.reading() as session:
        rows = session.execute(select(PhotoRow.state, PhotoRow.error_code, PhotoRow.error_detail))
        return [" ".join(filter(None, row)) for row in rows]


def faults(log: Path) -> str:
    """Return what the last two tasks printed that crashed, tracebacks and all."""
    parts = re.split(r"^.* ERROR .* app\.sandbox\.runner: ", log.read_text(), flags=re.MULTILINE)[1:]
    return "\n".join(part[:1500] for part in parts[-2:])


def torture(folder: Path, seed: int, *, servers: bool, plan: Plan | None = None) -> str:
    """Do it once; return what happened in one line.

    Raises
    ------
    AssertionError
        If anything was lost, counted twice, or seen by another owner.
    """
    plan, chance, began = plan or Plan(), random.Random(seed), time.monotonic()
    ended = threading.Event()
    with contextlib.ExitStack() as stack:
        given = stack.enter_context(installation(folder, servers=servers))
        settings = given.settings
        settings.data_dir.mkdir(parents=True)
        store, storage = Store(settings), Storage(settings.storage)
        upgrade(store.database)
        crew = Victims(settings, folder / "workers.log", given.extra)
        full_disks = plan.full_disks if given.full_disks else 0
        try:
            for number in range(plan.photos - plan.late):
                send(store, storage, number)
            numbers = range(plan.photos - plan.late, plan.photos)
            chances = [random.Random(chance.random()) for _ in numbers]
            each = zip(numbers, chances, strict=True)
            late = stack.enter_context(ThreadPoolExecutor(1)).submit(
                lambda: [send_late(store, storage, *one, ended) for one in each]
            )
            for _ in range(plan.workers):
                crew.hire()
            deeds = ["kill"] * plan.kills + ["outage"] * plan.outages + ["full disk"] * full_disks
            deeds += ["pause"] * plan.pauses
            files = [] if servers else databases(settings)
            chance.shuffle(deeds)
            for deed in deeds:
                time.sleep(chance.uniform(0.2, 1.5))
                if deed == "kill":
                    crew.lose_one(chance)
                elif deed == "pause":
                    with crew.paused(chance, files):
                        time.sleep(settings.lease_seconds + 2.0)
                elif deed == "outage":
                    with chance.choice(given.outages)():
                        time.sleep(chance.uniform(1.0, 5.0))
                else:
                    with chance.choice(given.full_disks)():
                        time.sleep(chance.uniform(0.5, 2.5))
                        crew.lose_one(chance)  # the next one starts without room
                        time.sleep(chance.uniform(0.5, 2.5))
                crew.replace_the_dead()
            end = time.monotonic() + stretched(plan.patience_s)
            while not late.done() or (now := set(states(store))) != {"counted"}:
                now = set(states(store))
                crew.replace_the_dead()
                assert not now & {"failed", "cancelled", "needs_lens"}, f"{said(store)}\n{faults(crew.log)}"
                assert time.monotonic() < end, f"{states(store)}\n{crew.log.read_text()[-4000:]}"
                time.sleep(0.2)
            late.result()  # what it did not foresee
            check(settings, store, storage, plan)
        finally:
            ended.set()
            crew.close()
            store.close()
    return (
        f"seed {seed}: {plan.photos} of {plan.photos} photos counted once, "
        f"{plan.photos * CELLS * CHANNELS} samples, {plan.kills} kills, {plan.outages} outages, "
        f"{plan.pauses} pauses, {full_disks} full disks, "
        f"{time.monotonic() - began:.0f} s"
    )


def check(settings: Settings, store: Store, storage: Storage, plan: Plan) -> None:
    findings = examine(settings, store, storage, deep=False)
    assert not [finding for finding in findings if finding.check != "work"], findings
    with store.database.reading() as session:
        samples = session.scalar(select(func.count()).select_from(SampleRow))
        photos = session.scalar(select(func.count()).select_from(PhotoRow))
        lenses = session.execute(
            select(OwnerRow.name, LensRow.version, LensRow.photo_count, LensRow.sample_count)
            .join(LensRow, LensRow.owner_id == OwnerRow.id)
            .order_by(OwnerRow.name)
        ).all()
    each = plan.photos // len(OWNERS)
    found = [tuple(lens) for lens in lenses]
    said = f"{samples} samples, {photos} photos, lenses {found}"
    assert photos == plan.photos, said
    assert samples == plan.photos * CELLS * CHANNELS, said
    assert found == [(owner, each, each, each * CELLS * CHANNELS) for owner in OWNERS], said


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--servers", action="store_true", help="PostgreSQL and S3 instead of files")
    wishes = parser.parse_args()
    failed = 0
    for seed in range(wishes.first, wishes.first + wishes.seeds):
        with tempfile.TemporaryDirectory(prefix="lensmodel-torture-") as folder:
            try:
                print(torture(Path(folder), seed, servers=wishes.servers), flush=True)
            except AssertionError as error:
                failed += 1
                print(f"seed {seed}: FAILED: {error}", flush=True)
    print(f"{wishes.seeds - failed} of {wishes.seeds} seeds passed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
