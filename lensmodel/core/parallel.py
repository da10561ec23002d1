"""Where loops over patches, cells and photos run: any executor will do, here or on other machines."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future
from typing import Any, ParamSpec, TypeVar

A = TypeVar("A")
T = TypeVar("T")
P = ParamSpec("P")


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
