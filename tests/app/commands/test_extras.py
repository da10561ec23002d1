"""Without the service's packages the commands on files work, and the others say what to install."""

from __future__ import annotations

import subprocess
import sys

import pytest

from app.commands.console import extras

WITHOUT = """
import sys
sys.modules.update(dict.fromkeys({missing!r}))
sys.argv = ["lensmodel", *{words!r}]
from app.cli import main
main()
"""


def without_service(*words: str) -> subprocess.CompletedProcess[str]:
    # typer may bring pydantic
    missing = [name for name in extras.EXTRAS["service"] if name != "pydantic"]
    code = WITHOUT.format(missing=missing, words=list(words))
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("words", [["serve"], ["doctor"], ["keys", "list"]], ids=" ".join)
def test_a_command_of_the_service_says_which_extra_it_needs(words: list[str]) -> None:
    done = without_service(*words)

    assert done.returncode == 1
    assert "pip install 'lensmodel[service]'" in done.stderr
    assert [line for line in done.stderr.splitlines() if "Traceback" in line] == []


def test_commands_on_files_do_without_the_service() -> None:
    done = without_service("calibrate", "gone.dng", "--profile", "new.lensprofile")

    assert (done.returncode, "no photo called gone.dng" in done.stderr) == (2, True)


def test_a_module_that_no_extra_brings_is_no_extra() -> None:
    assert extras.remedy(ModuleNotFoundError("no", name="nonsense")) is None
