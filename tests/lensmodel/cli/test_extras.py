"""Without the service's packages the commands on files work, and the others say what to install."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from lensmodel.cli import console

COMMANDS = ["serve", "doctor", "keys list", "calibrate gone.dng --profile new.lensprofile"]
SERVICE = ["alembic", "dbos", "fastapi", "obstore", "pydantic_settings", "sqlalchemy", "structlog", "uvicorn"]
WITHOUT = """
import contextlib, io, json, sys
sys.modules.update(dict.fromkeys({missing!r}))
from lensmodel.cli.main import main
for command in {commands!r}:
    sys.argv, status, errors = ["lensmodel", *command.split()], 0, io.StringIO()
    with contextlib.redirect_stderr(errors):
        try:
            main()
        except SystemExit as end:
            status = end.code
    print(json.dumps([status, errors.getvalue()]))
"""


@pytest.fixture(scope="module")
def ended() -> dict[str, tuple[int, str]]:
    """Exit status and standard error of each command, of one process without what the extra brings."""
    code = WITHOUT.format(missing=SERVICE, commands=COMMANDS)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    said = map(json.loads, done.stdout.splitlines())
    return {command: (status, errors) for command, (status, errors) in zip(COMMANDS, said, strict=True)}


@pytest.mark.parametrize("command", COMMANDS[:3])
def test_a_command_of_the_service_says_which_extra_it_needs(
    command: str, ended: dict[str, tuple[int, str]]
) -> None:
    status, errors = ended[command]

    assert status == 1
    assert "pip install 'lensmodel[service]'" in errors
    assert [line for line in errors.splitlines() if "Traceback" in line] == []


def test_commands_on_files_do_without_the_service(ended: dict[str, tuple[int, str]]) -> None:
    status, errors = ended[COMMANDS[3]]

    assert (status, "no photo called gone.dng" in errors) == (2, True)


@pytest.mark.parametrize(("module", "where"), [("app", "container image"), ("lab", "source tree")])
def test_a_command_that_is_no_part_of_the_wheel_says_where_it_runs(module: str, where: str) -> None:
    assert where in str(console.remedy(ModuleNotFoundError("no", name=module)))


def test_a_module_that_no_extra_brings_is_no_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "app", raising=False)
    assert console.remedy(ModuleNotFoundError("no", name="nonsense")) is None
