"""A process that is told to stop stops, whatever its main thread is doing at that instant."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

# Waits so often that a handler which took the event's lock would soon meet its own thread inside it.
WAITS = """
import threading
from app.runtime.signals import on_signals
told = threading.Event()
on_signals(lambda number: (print(number.name, flush=True), told.set()))
print("ready", flush=True)
while not told.is_set():
    told.wait(1e-7)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_event_that_the_main_thread_waits_for_can_be_set(number: signal.Signals) -> None:
    for _ in range(5):
        with subprocess.Popen([sys.executable, "-c", WAITS], stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            process.send_signal(number)
            try:
                assert process.wait(30) == 0
            finally:
                process.kill()
            assert process.stdout.read() == f"{number.name}\n"
