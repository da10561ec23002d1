"""Disk space in reserve for deletions, which write to the database and must work on a full disk."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeVar

from app.runtime.outage import is_no_room

log = logging.getLogger(__name__)

SIZE: Final = 16 << 20
"""Chosen: some thousand deleting transactions of SQLite, whose log then starts again from its beginning."""

T = TypeVar("T")


class Reserve:
    """A placeholder file, deleted when the disk is full and created again once there is space.

    Parameters
    ----------
    path : Path or None
        Where it lies: beside the database. None with a database server, which has its own disk.
    size : int
        In bytes.
    """

    def __init__(self, path: Path | None, size: int = SIZE) -> None:
        self._path, self._size = path, size
        self._guard = threading.Lock()
        self.fill()

    def fill(self) -> None:
        """Create the file if it is missing and leaves at least as much space free."""
        if self._path is None or self._path.exists():
            return
        with self._guard, contextlib.suppress(OSError):  # on a full disk: later
            if shutil.disk_usage(self._path.parent).free < 2 * self._size:
                return
            with self._path.open("wb") as file:
                os.posix_fallocate(file.fileno(), 0, self._size)

    def spend(self, work: Callable[[], T]) -> T:
        """Do something that frees space; on a full disk, give up the reserve for it."""
        try:
            result = work()
        except Exception as error:
            if self._path is None or not is_no_room(error):
                raise
            log.warning("the disk is full: deleting in the reserve")
            with self._guard:
                self._path.unlink(missing_ok=True)
            return work()
        self.fill()
        return result
