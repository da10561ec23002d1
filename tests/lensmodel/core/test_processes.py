"""Workers of the library end with whoever started them, however that ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

SCRIPT = """
import os, time
from lensmodel.core.processes import pool

with pool(None, 2) as workers:
    pids = {workers.submit(os.getpid).result()}
    waiting = [workers.submit(time.sleep, 600) for _ in range(2)]
    while len(pids) < 2:
        pids = set(workers._processes)
    print(*sorted(pids), flush=True)
    time.sleep(600)
"""
PATIENCE_S = 60.0


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.skipif(sys.platform == "win32", reason="processes are asked after by a signal")
def test_workers_of_a_killed_script_end() -> None:
    with subprocess.Popen([sys.executable, "-c", SCRIPT], stdout=subprocess.PIPE, text=True) as script:
        assert script.stdout is not None
        workers = [int(pid) for pid in script.stdout.readline().split()]
        assert len(workers) == 2
        assert all(alive(pid) for pid in workers)
        script.send_signal(signal.SIGKILL)
        script.wait()

    until = time.monotonic() + PATIENCE_S
    while any(alive(pid) for pid in workers) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(alive(pid) for pid in workers)
