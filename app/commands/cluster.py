"""Photos estimated by the machines of a Dask cluster; see `lensmodel calibrate --scheduler`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import Future
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from app.commands.console.failure import UsageError
from lensmodel.core import parallel
from lensmodel.core.psf import PsfSample
from lensmodel.workflow import pipeline

CONNECT_S = 10.0
"""Seconds to reach the scheduler of a cluster (chosen, not measured)."""


class Orders(Protocol):
    """Knows what is to be estimated of a photo."""

    def order(self, path: Path) -> tuple[Any, ...] | None:
        """Return the arguments of `pipeline.samples_of_bytes`, or None."""


def estimated(
    scheduler: str | None, paths: Iterable[Path], orders: Orders
) -> Iterator[tuple[Path, Future[list[PsfSample]] | None]]:
    """Give photos in their order, each with its samples to come; None where they are to be made here.

    Only the bytes of photos and the samples travel: the machines need lensmodel, and none of the files.

    Raises
    ------
    UsageError
        If there is no cluster at that address, or nothing to reach it with.
    """
    if scheduler is None:
        yield from ((path, None) for path in paths)
        return
    try:
        dask: Any = import_module("distributed")  # an extra, loaded only where it is asked for
    except ImportError as error:
        raise UsageError("--scheduler needs Dask: pip install 'lensmodel[cluster]'") from error
    try:
        client = dask.Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UsageError(f"--scheduler {scheduler}: no cluster answers there ({error})") from error
    with client, client.get_executor(pure=False) as executor:
        threads = sum(client.nthreads().values())
        if not threads:
            raise UsageError(f"--scheduler {scheduler}: it has no workers; start some by `dask worker`")
        yield from parallel.in_order(
            executor, pipeline.samples_of_bytes, paths, orders.order, ahead=2 * threads
        )
