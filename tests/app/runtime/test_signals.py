"""A process of the API that is told to stop ends well, after the application has."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

# In place of the application, which takes seconds to load, one that only says when it can be used.
SERVES = """
import contextlib, sys, types
from pathlib import Path
from lensmodel.cli import ending
from app.runtime import supervisor
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
with contextlib.suppress(ending.InterruptedByUser):
    supervisor.run(Settings(data_dir=Path(sys.argv[1])), supervisor.listen("127.0.0.1", 0))
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
