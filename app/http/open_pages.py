"""Fragments of open pages, rendered once for all viewers of the same page of the same owner."""

from __future__ import annotations

import asyncio
import contextlib
from collections import defaultdict
from collections.abc import Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final, TypeAlias

from starlette.concurrency import run_in_threadpool

from app.http.job_watch import Watch

FRESH_S: Final = 5.0
"""Seconds for which fragments are reused while nothing happens (chosen): estimates of time left change."""

LOOK_S: Final = 0.5
"""Seconds between two polls of the tables for open pages (chosen): some milliseconds for each owner."""

Fragments: TypeAlias = Mapping[str, str]
"""HTML by the id of the element that it replaces."""


@dataclass(slots=True)
class _Drawing:
    change: int = -1
    at: float = 0.0
    task: asyncio.Task[Fragments] | None = None


@dataclass(slots=True)
class _Page:
    viewers: int = 0
    drawing: _Drawing = field(default_factory=_Drawing)


@dataclass(frozen=True, slots=True)
class OpenPage:
    """One open page."""

    changed: Callable[[float], Awaitable[None]]
    """`await changed(seconds)` returns when something of the owner changes, or after that time."""

    parts: Callable[[], Awaitable[Fragments]]
    """Returns the present fragments of the page."""


class OpenPages:
    """The pages that are open in one process; to be used in its event loop.

    Parameters
    ----------
    watch : Watch
        Watch of the owners.
    """

    def __init__(self, watch: Watch) -> None:
        self._watch = watch
        self._pages: defaultdict[tuple[str, ...], _Page] = defaultdict(_Page)

    @contextlib.contextmanager
    def view(self, owner: str, name: str, key: str, draw: Callable[[], Fragments]) -> Iterator[OpenPage]:
        """Open a page of an owner; `draw` is called in a thread, once for all its viewers after a change."""
        at = (owner, name, key)
        page = self._pages[at]
        page.viewers += 1
        try:
            with self._watch.of(owner) as waiting:
                yield OpenPage(waiting.changed, lambda: _parts(page, waiting.count(), draw))
        finally:
            page.viewers -= 1
            if not page.viewers:
                del self._pages[at]


async def _parts(page: _Page, change: int, draw: Callable[[], Fragments]) -> Fragments:
    now = asyncio.get_running_loop().time()
    last = page.drawing
    if last.task is None or last.change != change or now - last.at > FRESH_S or _failed(last.task):
        task = asyncio.ensure_future(run_in_threadpool(draw))
        task.add_done_callback(_failed)  # retrieves its error: all viewers may be gone by then
        page.drawing = last = _Drawing(change, now, task)
    assert last.task is not None
    return await asyncio.shield(last.task)  # a viewer who leaves does not cancel it for the others


def _failed(task: asyncio.Task[Fragments]) -> bool:
    return task.done() and (task.cancelled() or task.exception() is not None)
