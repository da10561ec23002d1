"""Which engine runs the inner loops: compiled where available, else NumPy and SciPy."""

from __future__ import annotations

import importlib
import logging
from functools import cache
from types import ModuleType
from typing import Final, Literal

import numpy as np

from lensmodel.core import loops

Engine = Literal["auto", "numpy"]

COMPILE_S: Final = 30
"""Seconds that compiling takes on a usual machine (chosen: it is only said, lest the silence look like a
fault; slow machines take longer)."""

_KEPT: Final = 31 << 20
"""Bytes of the block to free: just below the 32 MiB up to which glibc adapts (see `keep_freed_memory`)."""

first_use = logging.getLogger(f"{__name__}.first_use")
"""Says when loops are compiled, during which nothing else happens that a user could see."""


def compiled(engine: Engine) -> ModuleType | None:
    """Return the loops of the correction, or None where NumPy is wanted or Numba is not installed."""
    return _loops(engine, "lensmodel.correction.compiled")


def compiled_checks(engine: Engine) -> ModuleType | None:
    """Return the loops of the audit, or None as `compiled` does."""
    return _loops(engine, "lensmodel.correction.audit.compiled")


def _loops(engine: Engine, name: str) -> ModuleType | None:
    if engine == "numpy":
        return None
    module = loops.compiled(name, "rocket_fft")
    if module is not None:
        tell_of_compiling()
    return module


@cache
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
