"""A pipe by which a process notices that its parent, the supervisor, has ended, however it ended."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable
from typing import Final

VARIABLE: Final = "LENSMODEL_PARENT_PIPE"
"""Environment variable with the file descriptor of the pipe's reading end."""


def on_parents_end(stop: Callable[[], None]) -> None:
    """Call a function once the supervisor has ended; do nothing without a supervisor."""
    number = os.environ.pop(VARIABLE, None)
    if number is None:
        return

    def wait() -> None:
        with contextlib.suppress(OSError):
            os.read(int(number), 1)
        stop()

    threading.Thread(target=wait, name="parent-watch", daemon=True).start()
