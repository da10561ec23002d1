"""Which engine runs the inner loops: compiled where it can, NumPy and SciPy elsewhere."""

from __future__ import annotations

import importlib
import importlib.util
import logging
import threading
from functools import cache
from types import ModuleType
from typing import Final, Literal

import numpy as np

Engine = Literal["auto", "numpy"]

COMPILE_S: Final = 30
"""Seconds that compiling takes on a usual machine."""

_KEPT: Final = 31 << 20
"""Bytes of the largest block worth keeping."""

logger = logging.getLogger(__name__)
first_use = logging.getLogger(f"{__name__}.first_use")
"""Says when loops are compiled: a time in which nothing else is to be seen."""

_loading = threading.Lock()


def compiled(engine: Engine) -> ModuleType | None:
    """Return the compiled loops, or None where NumPy shall do or Numba is not installed."""
    if engine == "numpy":
        return None
    with _loading:  # threads that all start at once must not compile the same loop twice
        return _load()


@cache
def _load() -> ModuleType | None:
    if importlib.util.find_spec("numba") is None or importlib.util.find_spec("rocket_fft") is None:
        logger.info("numba or rocket-fft is missing: correcting with SciPy, about half as fast")
        return None
    tell_of_compiling()
    return importlib.import_module("lensmodel.correction.compiled")


def tell_of_compiling() -> None:
    """Log once when Numba compiles; loading what was compiled before is no such event."""
    event = importlib.import_module("numba.core.event")

    class CompilationLog(event.Listener):  # type: ignore[misc, name-defined] # Numba has no types
        logged = False

        def on_start(self, event: object) -> None:
            del event
            if not self.logged:
                self.logged = True
                first_use.info("compiling the inner loops, once on this machine: about %d s", COMPILE_S)

        def on_end(self, event: object) -> None:
            """Nothing is said of the end: the progress shows it."""

    event.register("numba:compile", CompilationLog())


def keep_freed_memory() -> None:
    """Let the C library keep what a cell frees for the next one.

    The arrays of a cell are of some megabytes each. glibc gives such memory back as soon as it is freed, and
    the system clears every page of it anew for the next cell, which took a quarter of the time of "fast". It
    stops doing so for blocks smaller than the largest one of up to 32 MiB that it has seen freed; the
    pages of this one are never touched. Elsewhere nothing happens.
    """
    np.empty(_KEPT, dtype=np.uint8)
