"""A pipe that ends with the supervisor: what it started stops when it is gone, however it went."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable
from typing import Final

VARIABLE: Final = "LENSMODEL_LIFELINE"
"""Name in the environment of the number of the pipe's reading end."""


def on_parents_end(call: Callable[[], None]) -> None:
    """Call something once the supervisor is gone; nothing happens without a supervisor."""
    number = os.environ.pop(VARIABLE, None)
    if number is None:
        return

    def wait() -> None:
        with contextlib.suppress(OSError):
            os.read(int(number), 1)
        call()

    threading.Thread(target=wait, name="lifeline", daemon=True).start()
