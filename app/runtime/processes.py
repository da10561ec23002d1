"""Processes: identified by id and start time, ended with their parent."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from pathlib import Path
from typing import Final

PARENT: Final = "LENSMODEL_PARENT"  # environment variable with the process id of the supervisor
_PR_SET_PDEATHSIG: Final = 1  # of linux/prctl.h


def started_at(pid: int) -> float:
    """Return when a process began, in clock ticks since the machine started; 0 where unknown."""
    # Process ids are reused; id and start time together are not
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return 0.0
    return float(stat.rpartition(")")[2].split()[19])


def is_running(pid: int, began: float) -> bool:
    """Say whether the process `pid` that began at `began` still runs; True if in doubt."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return began == 0.0 or started_at(pid) == began


def end_with_parent() -> None:
    """Let the kernel stop this process once the supervisor has ended, however it ended."""
    parent = os.environ.pop(PARENT, None)
    if parent is None or sys.platform != "linux":
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != int(parent):
        sys.exit("the supervisor has ended already")
