"""Where loops over patches, cells and photos run: any executor will do, here or on other machines."""

from __future__ import annotations

import os
import pickle
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from typing import Any, Final, TypeVar

A = TypeVar("A")
T = TypeVar("T")

_ONE_THREAD: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")  # the work is parallel over processes


def portable(part: object) -> bool:
    """Tell whether another process can load an object: pickled, and not of a class of the main module."""
    if type(part).__module__ == "__main__":
        return False
    try:
        pickle.dumps(part)
    except (pickle.PicklingError, AttributeError, TypeError):
        return False
    return True


@contextmanager
def pool(executor: Executor | None, workers: int | None, part: object = None) -> Iterator[Executor]:
    """Give the executor, or else `workers` of our own for as long as needed."""
    if executor is not None:
        yield executor
        return
    count = max(1, workers or os.cpu_count() or 1)
    own: Executor = (
        ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=_begin)
        if portable(part)
        else ThreadPoolExecutor(count)
    )
    with own:
        yield own


def _begin() -> None:
    """Prepare a worker, before it imports NumPy: one thread, no Ctrl-C, and an end with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    for name in _ONE_THREAD:
        os.environ.setdefault(name, "1")


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def in_order(
    executor: Executor,
    call: Callable[..., T],
    items: Iterable[A],
    arguments: Callable[[A], tuple[Any, ...] | None],
    *,
    ahead: int,
) -> Iterator[tuple[A, Future[T] | None]]:
    """Give items in their order with the futures of their calls, of which few are submitted ahead."""
    waiting: deque[tuple[A, Future[T] | None]] = deque()
    try:
        for item in items:
            given = arguments(item)
            waiting.append((item, None if given is None else executor.submit(call, *given)))
            if len(waiting) >= ahead:
                yield waiting.popleft()
        while waiting:
            yield waiting.popleft()
    finally:
        for _, future in waiting:
            if future is not None:
                future.cancel()
