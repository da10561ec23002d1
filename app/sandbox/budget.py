"""Limits on the number of children at once and on their memory together."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import Final

POLL_S: Final = 0.25
"""Seconds between two questions whether a task is still wanted (chosen): each reads a row."""


class Budget:
    """Slots and memory that children share, first come, first served."""

    def __init__(self, slots: int, memory_mb: int) -> None:
        self._changed = threading.Condition()
        self._queue: deque[object] = deque()
        self._slots, self._memory = slots, memory_mb
        self.memory_mb = memory_mb

    @contextlib.contextmanager
    def share(self, memory_mb: int, wanted: Callable[[], bool]) -> Iterator[bool]:
        """Wait for a slot and memory; yield False if the task is no longer wanted.

        A task that needs more memory than the whole budget runs alone.
        """
        memory = min(memory_mb, self.memory_mb)
        ticket = object()
        entered = self._enter(ticket, memory, wanted)
        try:
            yield entered
        finally:
            if entered:
                with self._changed:
                    self._slots += 1
                    self._memory += memory
                    self._changed.notify_all()

    def _enter(self, ticket: object, memory: int, wanted: Callable[[], bool]) -> bool:
        with self._changed:
            self._queue.append(ticket)
        entered = False
        try:
            while not entered and wanted():
                with self._changed:
                    if self._queue[0] is ticket and self._slots > 0 and self._memory >= memory:
                        self._slots -= 1
                        self._memory -= memory
                        entered = True
                    else:
                        self._changed.wait(POLL_S)
        finally:
            with self._changed:
                self._queue.remove(ticket)
                self._changed.notify_all()
        return entered
