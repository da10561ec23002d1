"""Photos estimated by the machines of a Dask cluster; see `lensmodel calibrate --scheduler`."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from lensmodel.cli.console.failure import UsageError
from lensmodel.workflow.pipeline import AHEAD

CONNECT_S = 10.0
"""Seconds to reach the scheduler of a cluster (chosen): one in the same network answers at once."""


@contextmanager
def executor_of(scheduler: str | None) -> Iterator[tuple[Executor | None, int]]:
    """Give the executor of a cluster, and how many photos to send ahead; None without a cluster.

    Only the bytes of photos and the samples travel: the machines need lensmodel, and none of the files.
    """
    if scheduler is None:
        yield None, AHEAD
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
        yield executor, 2 * threads
