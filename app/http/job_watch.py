"""Wait for changes: one poll of the tables for all who wait, however many they are."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import defaultdict
from collections.abc import Awaitable, Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from starlette.concurrency import run_in_threadpool

log = logging.getLogger(__name__)

LOOK_S: Final = 0.1
"""Seconds between two polls of the tables while anybody waits (chosen): one or two reads of 0.1 ms."""

CALM_S: Final = 5.0
"""Seconds between two polls where the database announces changes (chosen): only a lost announcement waits so
long."""

Marks = Mapping[str, Hashable]
"""A value for each key that changes with its state; deleted keys are missing."""


@dataclass(frozen=True, slots=True)
class Waiting:
    """Changes of one key, for somebody who waits."""

    changed: Callable[[float], Awaitable[None]]
    """`await changed(seconds)` returns after a change, or after that time."""

    count: Callable[[], int]
    """Number of changes so far: what is read afterwards includes at least these."""


class Watch:
    """Wakes those that wait for jobs, or for owners, in one process when these change.

    Parameters
    ----------
    look : callable
        Returns the marks of these keys; called in a thread.
    every_s : float
        Least time between two calls, in seconds.
    announced : callable
        Whether `nudge` is called after each change: then the tables are polled only then, and every `CALM_S`.
    """

    def __init__(
        self,
        look: Callable[[list[str]], Marks],
        *,
        every_s: float = LOOK_S,
        announced: Callable[[], bool] = lambda: False,
    ) -> None:
        self._look, self._every_s, self._announced = look, every_s, announced
        self._waiting: defaultdict[str, set[asyncio.Event]] = defaultdict(set)
        self._marks: dict[str, Hashable] = {}
        self._counts: defaultdict[str, int] = defaultdict(int)
        self._nudged = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    @contextlib.contextmanager
    def of(self, key: str) -> Iterator[Waiting]:
        """Provide the changes of one key.

        The first poll counts as a change: nothing is missed between reading the key and waiting.
        """
        event = asyncio.Event()
        self._waiting[key].add(event)
        if key in self._marks:
            event.set()
        else:
            self.nudge()
        if self._task is None or self._task.done():
            self._task = asyncio.get_running_loop().create_task(self._run())

        async def changed(seconds: float) -> None:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(event.wait(), seconds)
            event.clear()

        try:
            yield Waiting(changed, lambda: self._counts.get(key, 0))
        finally:
            self._waiting[key].discard(event)
            if not self._waiting[key]:
                del self._waiting[key]
                self._marks.pop(key, None)
                self._counts.pop(key, None)

    def nudge(self) -> None:
        """Poll soon: something may have changed. To be called in the loop's thread."""
        self._nudged.set()

    async def _run(self) -> None:
        while self._waiting:
            await asyncio.sleep(self._every_s)
            if self._announced():
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._nudged.wait(), CALM_S)
            self._nudged.clear()  # before the poll: changes during it cause another one
            keys = list(self._waiting)
            try:
                marks = await run_in_threadpool(self._look, keys)
            except Exception as error:  # noqa: BLE001 - the next poll tries again
                log.warning("the tables could not be looked at: %s", error)
                self.nudge()
                continue
            for key in keys:
                mark = marks.get(key)
                if key in self._waiting and (key not in self._marks or self._marks[key] != mark):
                    self._marks[key] = mark
                    self._counts[key] += 1
                    for event in self._waiting[key]:
                        event.set()

    def stop(self) -> None:
        """Stop polling."""
        if self._task is not None:
            self._task.cancel()
