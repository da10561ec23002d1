"""Handle the signals that stop a process."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Final

STOPPING: Final = (signal.SIGTERM, signal.SIGINT)


def on_signals(stop: Callable[[signal.Signals], None], numbers: Sequence[int] = STOPPING) -> None:
    """Call `stop` in a thread of its own each time that one of the signals comes.

    A handler runs between two instructions of the main thread. If it set the very event that this thread is
    waiting for, or wrote to the log that this thread is writing to, it could wait for a lock that its own
    thread holds, for ever. So it writes one byte, which takes no lock.
    """
    reading, writing = os.pipe()
    os.set_blocking(writing, False)

    def handle(number: int, frame: FrameType | None) -> None:
        del frame
        with contextlib.suppress(BlockingIOError):  # the pipe is full of signals already
            os.write(writing, bytes([number]))

    def listen() -> None:
        while number := os.read(reading, 1):
            stop(signal.Signals(number[0]))

    threading.Thread(target=listen, name="signals", daemon=True).start()
    for number in numbers:
        signal.signal(number, handle)
