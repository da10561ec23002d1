"""A process that is told to stop stops, whatever its main thread is doing at that instant."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

# Waits so often that a handler which took the event's lock would soon meet its own thread inside it.
WAITS = """
import threading
from app.runtime.processes import on_signals
arrived = threading.Event()
on_signals(lambda number: (print(number.name, flush=True), arrived.set()))
print("ready", flush=True)
while not arrived.is_set():
    arrived.wait(1e-7)
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


# In place of the application, which takes seconds to load, one that only says when it can be used.
SERVES = """
import sys, types
from pathlib import Path
from lensmodel.cli import ending
from app.runtime import server
from app.runtime.settings import Settings

async def application(scope, receive, send):
    assert scope["type"] == "lifespan"
    await receive()
    await send({"type": "lifespan.startup.complete"})
    print("ready", flush=True)
    await receive()
    await send({"type": "lifespan.shutdown.complete"})

sys.modules["app.main"] = types.SimpleNamespace(create_app=lambda settings: application)
ending.install()
server.run(Settings(data_dir=Path(sys.argv[1])), server.listen("127.0.0.1", 0))
print("stopped", flush=True)
"""


def test_an_api_process_that_was_stopped_ended_well(tmp_path: Path) -> None:
    command = [sys.executable, "-c", SERVES, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGTERM)
        try:
            assert process.wait(120) == 0
        finally:
            process.kill()
        assert process.stdout.read() == "stopped\n"
