"""Identify a process by its id and start time."""

from __future__ import annotations

import os
from pathlib import Path


def started_at(pid: int) -> float:
    """Return when a process began, in clock ticks since the machine started; 0 where unknown.

    Process ids are reused; id and start time together are not.
    """
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
