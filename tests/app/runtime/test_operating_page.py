"""The pages for operators, typed word for word in an empty folder, one after the other."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from servers import free_port

PAGES = [Path(__file__).parents[3] / "docs" / name for name in ("service.md", "topics/operating.md")]
ELSEWHERE = "/var/lib/postgresql"
"""Commands about another machine's disk."""


def commands() -> list[str]:
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    blocks = re.findall(r"^```sh\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    return [line for block in blocks for line in block.splitlines() if ELSEWHERE not in line]


@pytest.mark.slow
def test_each_command_of_the_pages_does_what_it_says(tmp_path: Path) -> None:
    if shutil.which("curl") is None or shutil.which("bash") is None:
        pytest.skip("needs bash and curl, as the page does")
    port, lines = str(free_port()), ["set -e"]
    for line in commands():
        lines.append(line.replace("8000", port))
        if line.endswith("&"):  # a person waits for the address
            lines.append(f"until curl -sf http://127.0.0.1:{port}/readyz > ready; do sleep 0.2; done")
    home = {name: value for name, value in os.environ.items() if not name.startswith("LENS_")}
    home["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{home['PATH']}"

    shell = subprocess.Popen(
        ["bash", "-c", "\n".join(lines)],
        cwd=tmp_path,
        env=home,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        said, _ = shell.communicate(timeout=600)
    finally:
        with contextlib.suppress(ProcessLookupError):  # a service that a failed command left behind
            os.killpg(shell.pid, signal.SIGKILL)

    assert shell.returncode == 0, said
    assert "lensmodel_queue_jobs" in said
    assert (tmp_path / "my-backup").is_dir()
