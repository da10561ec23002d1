"""Commands in the process of the tests, where another process is not what is tested."""

from __future__ import annotations

import contextlib
import io
import logging
import signal
import subprocess
import sys
from pathlib import Path
from typing import TextIO

import pytest

from lensmodel.cli.main import main


def lensmodel(
    *words: str | Path, cwd: Path, terminal: TextIO | None = None
) -> subprocess.CompletedProcess[str]:
    """Run the command in this process, which saves seconds of imports a run; a terminal gets its errors."""
    root, out, err, status = logging.getLogger(), io.StringIO(), io.StringIO(), 0
    handlers, level = list(root.handlers), root.level
    signals = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with (
            pytest.MonkeyPatch.context() as patched,
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(terminal or err),
        ):
            patched.chdir(cwd)
            patched.setattr(sys, "argv", ["lensmodel", *map(str, words)])
            main()
    except SystemExit as end:
        status = int(end.code or 0)
    finally:
        root.handlers[:], root.level = handlers, level
        for number, handler in signals.items():
            signal.signal(number, handler)
    return subprocess.CompletedProcess(words, status, out.getvalue(), err.getvalue())
