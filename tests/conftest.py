from __future__ import annotations

import fcntl
import gc
import logging
import os
import threading

# Before NumPy is imported: tests run in parallel processes, threads inside each only slow them down.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

# Most of what tests make is never garbage: modules, and what libraries keep of statements and types. To look
# through all of it as often as usual takes a tenth of the time of tests that compute nothing.
gc.set_threshold(20_000, 20, 10)

# Services of tests keep their data for a moment only: what is compiled is kept longer, once for all tests.
os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "numba"))

import pytest
from hypothesis import settings

settings.register_profile("tests", deadline=None)  # that others use the machine too is no fault of ours
settings.load_profile("tests")


def pytest_sessionstart() -> None:
    """Let the test processes take turns at compiling: what one of them has compiled the others only load."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        _take_turns_at_compiling(Path(os.environ["NUMBA_CACHE_DIR"]))


def _take_turns_at_compiling(folder: Path) -> None:
    try:
        from numba.core.dispatcher import Dispatcher  # noqa: PLC0415 - an extra
    except ImportError:
        return
    folder.mkdir(parents=True, exist_ok=True)
    here, compile_one = threading.RLock(), Dispatcher.compile
    depth = 0

    def alone(self: Any, signature: Any) -> Any:
        nonlocal depth
        with here, (folder / "turn").open("w") as turn:
            if depth == 0:  # a loop that calls others has them compiled during its own turn
                fcntl.flock(turn, fcntl.LOCK_EX)
            depth += 1
            try:
                return compile_one(self, signature)
            finally:
                depth -= 1

    Dispatcher.compile = alone


@pytest.fixture(autouse=True)
def _handlers_end_with_their_test() -> Iterator[None]:
    """A command that runs in a test logs to standard error, which is another one afterwards."""
    root = logging.getLogger()
    before, level = list(root.handlers), root.level
    yield
    for handler in root.handlers[:]:
        if type(handler).__name__ in {"StreamHandler", "_Lines"} and handler not in before:
            root.removeHandler(handler)
    root.setLevel(level)


@pytest.fixture
def estimated_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Estimate in this process: a worker process first takes a second to import the library."""
    from lensmodel.core import processes  # noqa: PLC0415 - most tests need neither

    @contextmanager
    def here(executor: Executor | None, *_: object) -> Iterator[Executor]:
        yield executor or ThreadPoolExecutor(1)

    monkeypatch.setattr(processes, "pool", here)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the external photos; a test that needs them is marked `tools`."""
    folder = os.environ.get("LENSMODEL_TEST_DATA")
    if not folder:
        pytest.skip("LENSMODEL_TEST_DATA does not name the folder of the external photos")
    path = Path(folder)
    if not path.is_dir():
        pytest.fail(f"LENSMODEL_TEST_DATA names {folder}, which is no folder")
    return path
