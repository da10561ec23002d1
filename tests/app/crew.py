"""Worker processes of one installation, which tests kill, pause and replace; and what they must have done."""

from __future__ import annotations

import contextlib
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from deadline import Deadline, until
from quick_tasks import CELLS
from sqlalchemy import func, select

from app.runtime.settings import Settings
from app.runtime.supervisor import environment
from app.store import Store
from app.store.tables import PatchRow, PhotoRow

STAND_INS = Path(__file__).parent / "stand_ins"
CHANNELS = 3
WORKER = [sys.executable, str(STAND_INS / "stand_in_worker.py")]


def quick(environment: Mapping[str, str]) -> dict[str, str]:
    """Return what the environment of a worker needs besides, so that its tasks are quick."""
    path = os.pathsep.join([str(STAND_INS), environment.get("PYTHONPATH", "")])
    return {"PYTHONPATH": path, "LENSMODEL_TASKS": "quick_tasks"}


class Crew:
    """Workers with quick tasks; to be closed."""

    def __init__(self, settings: Settings, log: Path) -> None:
        self.log = log
        self._environment = os.environ | environment(settings) | quick(os.environ)
        self.processes: list[subprocess.Popen[bytes]] = []

    def hire(self) -> subprocess.Popen[bytes]:
        with self.log.open("a") as log:
            process = subprocess.Popen(WORKER, env=self._environment, stderr=log, start_new_session=True)
        self.processes.append(process)
        return process

    def until(self, condition: Callable[[], object], within_s: float = 180.0) -> None:
        until(condition, self.log, within_s)

    def kill(self, process: subprocess.Popen[bytes], *, group: bool = False) -> None:
        """Kill a worker; with `group` its children too, which else notice."""
        if group:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
        process.kill()
        process.wait()
        self.processes.remove(process)

    def close(self) -> None:
        for process in [*self.processes]:
            self.kill(process)


def pause(pid: int, files: Sequence[Path]) -> None:
    """Stop a process while it has locked none of the databases: else it would stop all the others too."""
    deadline = Deadline(120.0)
    while True:
        os.kill(pid, signal.SIGSTOP)
        if all(_unlocked(path) for path in files):
            return
        os.kill(pid, signal.SIGCONT)
        assert not deadline.passed(), "a database is always locked"
        time.sleep(0.02)


def _unlocked(path: Path) -> bool:
    try:
        with contextlib.closing(sqlite3.connect(path, timeout=0, isolation_level=None)) as opened:
            opened.execute("BEGIN IMMEDIATE")
            opened.execute("ROLLBACK")
    except sqlite3.OperationalError:
        return False
    return True


def databases(settings: Settings) -> list[Path]:
    """Return the files of the tables and of the jobs."""
    return [settings.data_dir / name for name in ("app.db", "jobs.db")]


def states(store: Store) -> list[str]:
    with store.database.reading() as session:
        return list(session.scalars(select(PhotoRow.state)))


def done_patches(store: Store) -> int:
    with store.database.reading() as session:
        return session.scalar(select(func.count()).where(PatchRow.state == "done")) or 0


def check_counts(store: Store, photos: int, owner: str = "local") -> None:
    """Each photo of an owner counted exactly once, each of its patches sampled exactly once."""
    (lens,) = store.lenses.page(owner, before=None, limit=10)
    sent = store.photos.page(owner, before=None, limit=100)
    kinds = [event.kind for event in store.lenses.history(lens)]
    samples = store.lenses.samples_of(lens.public_id)[1]
    assert [photo.state for photo in sent] == ["counted"] * photos
    assert [photo.patches_done for photo in sent] == [CELLS] * photos
    assert (lens.version, lens.photo_count, kinds) == (photos, photos, ["photo_added"] * photos)
    assert len(samples) == lens.sample_count == photos * CELLS * CHANNELS
