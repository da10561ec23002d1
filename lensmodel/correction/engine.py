"""Which engine runs the inner loops: compiled where available, else NumPy and SciPy."""

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
"""Seconds that compiling takes on a usual machine (chosen, not measured)."""

_KEPT: Final = 31 << 20
"""Bytes of the block to free: just below the 32 MiB up to which glibc adapts (see `keep_freed_memory`)."""

logger = logging.getLogger(__name__)
first_use = logging.getLogger(f"{__name__}.first_use")
"""Says when loops are compiled, during which nothing else happens that a user could see."""

_loading = threading.Lock()


def compiled(engine: Engine) -> ModuleType | None:
    """Return the compiled loops, or None where NumPy is wanted or Numba is not installed."""
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
    """Log once when Numba compiles; loading from its cache does not count."""
    event = importlib.import_module("numba.core.event")

    class CompilationLog(event.Listener):  # type: ignore[misc, name-defined] # Numba has no types
        logged = False

        def on_start(self, event: object) -> None:
            del event
            if not self.logged:
                self.logged = True
                first_use.info("compiling the inner loops, once on this machine: about %d s", COMPILE_S)

        def on_end(self, event: object) -> None:
            """The progress display shows the end."""

    event.register("numba:compile", CompilationLog())


def keep_freed_memory() -> None:
    """Let the C library keep what a cell frees for the next one.

    The arrays of a cell take some megabytes each. glibc returns such memory to the system as soon as it is
    freed, and the system clears every page again for the next cell, which took a quarter of the time of
    "fast". It stops doing so for blocks smaller than the largest block, up to 32 MiB, that it has seen freed;
    the pages of this one are never touched. Other C libraries are not affected.
    """
    np.empty(_KEPT, dtype=np.uint8)
