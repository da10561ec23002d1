"""Where loops over patches, cells and photos run: any executor will do, here or on other machines.

Python's spawned processes import the main module again: of a script without `if __name__ == "__main__"`
each worker would begin the script anew. The workers here only run functions of this library and what was
sent to them, so they leave the main module out: a script, a notebook and a command can start them alike.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import parent_process
from multiprocessing.context import SpawnContext, SpawnProcess
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any, Final, ParamSpec, TypeVar

A = TypeVar("A")
T = TypeVar("T")
P = ParamSpec("P")

_ONE_THREAD: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""The work is parallel over processes; threads of linear algebra in each only get in one another's way."""

_starting = threading.Lock()


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
        ProcessPoolExecutor(count, mp_context=_Context(), initializer=_begin)
        if portable(part)
        else ThreadPoolExecutor(count)
    )
    with own:
        yield own


def _begin() -> None:
    """Prepare a worker, before it imports NumPy: one thread, and Ctrl-C is left to who started it.

    A worker ends with its parent, however that ends: left alone it would wait for work for ever.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    for name in _ONE_THREAD:
        os.environ.setdefault(name, "1")


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


class _Process(SpawnProcess):
    """A spawned process that is told of an empty main module."""

    @staticmethod
    def _Popen(process_obj: BaseProcess) -> Any:  # noqa: ANN401, N802 - as multiprocessing calls it
        with _starting:
            main = sys.modules["__main__"]
            sys.modules["__main__"] = ModuleType("__main__")
            try:
                return SpawnProcess._Popen(process_obj)  # noqa: SLF001 - the only place to step in
            finally:
                sys.modules["__main__"] = main


class _Context(SpawnContext):
    """`multiprocessing.get_context("spawn")` with such processes."""

    Process = _Process


class Here(Executor):
    """Runs each call at once in the thread that submits it: where no further processes are wanted."""

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Call, and return a future that is done."""
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # noqa: BLE001 - a future hands on whatever it was
            future.set_exception(error)
        return future


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
