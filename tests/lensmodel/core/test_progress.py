"""What a call of the library shows of its progress."""

from __future__ import annotations

import sys
from types import ModuleType

import pytest

from lensmodel.api import say


@pytest.mark.parametrize(
    ("terminal", "notebook", "said"),
    [
        (True, False, "\r\x1b[Ka.dng: 50%\r\x1b[Ka.dng: done\n"),
        (False, True, "a.dng: done\n"),
        (False, False, ""),
    ],
)
def test_a_terminal_shows_each_step_and_a_notebook_whole_lines(
    terminal: bool,
    notebook: bool,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    monkeypatch.delitem(sys.modules, "ipykernel", raising=False)
    if notebook:
        monkeypatch.setitem(sys.modules, "ipykernel", ModuleType("ipykernel"))

    say("a.dng: 50%")
    say("a.dng: done", stays=True)

    assert capsys.readouterr().err == said
