"""Who waits for changes of jobs: one look at the tables for all of them, however many they are."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import defaultdict
from collections.abc import Awaitable, Callable, Hashable, Iterator, Mapping

from starlette.concurrency import run_in_threadpool

log = logging.getLogger(__name__)

LOOK_S = 0.1
"""How often the tables are looked at while anybody waits: one or two reads of some 0.1 ms."""

Marks = Mapping[str, Hashable]
"""What tells two states of each job apart; a job that is gone is not there."""


class Watch:
    """Tells those that wait for jobs of one process when theirs has changed.

    Parameters
    ----------
    look : callable
        Returns the marks of the jobs of these ids; called in a thread.
    """

    def __init__(self, look: Callable[[list[str]], Marks]) -> None:
        self._look = look
        self._waiting: defaultdict[str, set[asyncio.Event]] = defaultdict(set)
        self._marks: dict[str, Hashable] = {}
        self._task: asyncio.Task[None] | None = None

    @contextlib.contextmanager
    def of(self, job_id: str) -> Iterator[Callable[[float], Awaitable[None]]]:
        """Give a function to await: `await changed(seconds)` ends with a change, or with that time.

        The first look at a job counts as a change: nothing is missed between reading it and waiting.
        """
        event = asyncio.Event()
        self._waiting[job_id].add(event)
        if job_id in self._marks:
            event.set()
        if self._task is None or self._task.done():
            self._task = asyncio.get_running_loop().create_task(self._run())

        async def changed(seconds: float) -> None:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(event.wait(), seconds)
            event.clear()

        try:
            yield changed
        finally:
            self._waiting[job_id].discard(event)
            if not self._waiting[job_id]:
                del self._waiting[job_id]
                self._marks.pop(job_id, None)

    async def _run(self) -> None:
        while self._waiting:
            await asyncio.sleep(LOOK_S)
            ids = list(self._waiting)
            try:
                marks = await run_in_threadpool(self._look, ids)
            except Exception as error:  # noqa: BLE001 - those who wait ask again, and hear of it then
                log.warning("the jobs could not be looked at: %s", error)
                continue
            for job_id in ids:
                mark = marks.get(job_id)
                if job_id not in self._marks or self._marks[job_id] != mark:
                    self._marks[job_id] = mark
                    for event in self._waiting.get(job_id, ()):
                        event.set()

    def stop(self) -> None:
        """Look no more."""
        if self._task is not None:
            self._task.cancel()
