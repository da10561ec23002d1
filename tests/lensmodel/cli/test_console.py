"""What commands say: numbers in words, progress without a terminal, completion of the shell."""

from __future__ import annotations

import io
import logging
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from in_process import lensmodel
from rich.console import Console
from running import SMALL, write_photo

from lab.kernels import gaussian
from lensmodel.cli import console
from lensmodel.cli.console import Display
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings


def test_names_with_brackets_are_shown_whole_and_no_share_falls_where_a_photo_is_passed_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = io.StringIO()
    monkeypatch.setattr(console, "Console", lambda **_: Console(file=out, force_terminal=True, width=100))
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with Display().progress("correcting IMG[b].dng", 10) as bar:
        for done, share in ((2, 2), (1, 2), (3, 3)):
            bar.show(done)
            assert bar.tasks[0].completed == share

    assert "IMG[b].dng" in out.getvalue()


def test_without_a_terminal_progress_is_told_in_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with Display().progress("quick work", 1) as bar:
        bar.show(1)
    monkeypatch.setattr(console, "EVERY_S", 0.0)
    with Display().progress("learning from a.dng", 4) as bar:
        bar.show(1)
    with Display(quiet=True).progress("in silence", 4) as bar:
        bar.show(1)

    assert capsys.readouterr().err == "[0:00:00]  25 % learning from a.dng\n"


def test_a_measurement_and_its_report_count_the_same_places(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def measure(*_: Any, **given: Any) -> list[PsfSample]:
        return [  # points of light: a colour sees others of them, whose middle lies elsewhere
            PsfSample(
                gaussian(15, np.eye(2)),
                FieldPosition(r, 0.1 * k),
                LensSettings(2.8, channel=channel),
                estimator="measured-points/1",
                error=0.1,
            )
            for k, channel in enumerate(CHANNELS)
            for r in (0.2, 0.5, 0.7)[: 3 - k]
        ]

    write_photo(tmp_path / "stars.dng", 1, shape=SMALL)
    monkeypatch.setattr("lensmodel.measured.points.Points.measure", measure)
    done = lensmodel("measure", "points", "stars.dng", "--profile", "a.lensprofile", cwd=tmp_path)
    report = lensmodel("report", "a.lensprofile", cwd=tmp_path)

    assert "3 places measured on stars.dng" in done.stdout
    assert "blur measured at 3 places" in report.stdout


def test_that_loops_are_compiled_is_said_in_words_above_the_bar(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    Display()
    with monkeypatch.context() as redirected:
        redirected.setattr(sys, "stderr", io.StringIO())  # as `Bar` does
        logging.getLogger(console.COMPILING).info("compiling, about %d s", 30)
        assert sys.stderr.getvalue() == "lensmodel: compiling, about 30 s\n"  # type: ignore[attr-defined]
    assert capsys.readouterr().err == ""


def test_a_record_that_cannot_be_printed_ends_no_work(capsys: pytest.CaptureFixture[str]) -> None:
    Display()
    logging.getLogger("other").warning("%d photos", "no number")
    logging.getLogger("lensmodel.remarks").warning("the next one")
    said = capsys.readouterr().err
    assert "Logging error" in said
    assert said.endswith("lensmodel: the next one\n")


def test_commands_of_the_service_and_the_list_of_commands_do_not_wait_for_scipy() -> None:
    modules = "lensmodel.cli.main", "app.commands.keys", "app.commands.service", "app.commands.upkeep"
    script = f"import sys, {', '.join(modules)}\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)

    assert not {"scipy", "skimage", "lensmodel.model", "sqlalchemy"} & set(done.stdout.split())
