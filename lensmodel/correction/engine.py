"""What the compiled loops need of the process: a word when they are compiled, and memory that is kept."""

from __future__ import annotations

import logging
from functools import cache
from typing import Final

import numpy as np
from numba.core import event

COMPILE_S: Final = 30
"""Seconds that compiling takes on a usual machine (chosen: it is only said, lest the silence look like a
fault; slow machines take longer)."""

_KEPT: Final = 31 << 20
"""Bytes of the block to free: just below the 32 MiB up to which glibc adapts (see `keep_freed_memory`)."""

first_use = logging.getLogger(f"{__name__}.first_use")
"""Says when loops are compiled, during which nothing else happens that a user could see."""


@cache
def tell_of_compiling() -> None:
    """Log once when Numba compiles; loading from its cache does not count."""

    class CompilationLog(event.Listener):
        logged = False

        def on_start(self, started: object) -> None:
            del started
            if not self.logged:
                self.logged = True
                first_use.info("compiling the inner loops, once on this machine: about %d s", COMPILE_S)

        def on_end(self, ended: object) -> None:
            """The progress display shows the end."""

    event.register("numba:compile", CompilationLog())  # type: ignore[no-untyped-call] # Numba has no types


def keep_freed_memory() -> None:
    """Let the C library keep what a cell frees for the next one.

    The arrays of a cell take some megabytes each. glibc returns such memory to the system as soon as it is
    freed, and the system clears every page again for the next cell, which took a quarter of the time of
    "fast". It stops doing so for blocks smaller than the largest block, up to 32 MiB, that it has seen freed;
    the pages of this one are never touched. Other C libraries are not affected.
    """
    np.empty(_KEPT, dtype=np.uint8)
