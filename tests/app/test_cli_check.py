"""`lensmodel check` on files, as a person types it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from app.cli import app
from app.commands.failure import UsageError

ROWS, COLS = 200, 240


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A photo, and a copy of it with dots in one colour in the upper left quarter."""
    rng = np.random.default_rng(0)
    rows, cols = np.indices((ROWS, COLS))
    grey = 110 + 40 * np.sin(rows / 17.0) + 30 * np.cos(cols / 23.0) + rng.normal(0.0, 1.5, (ROWS, COLS))
    photo = np.clip(np.rint(np.dstack([grey, 0.9 * grey, 0.8 * grey])), 0, 255).astype(np.uint8)
    Image.fromarray(photo).save(tmp_path / "scan.png")
    spoiled = photo.copy()
    spoiled[5:100:7, 5:120:7, 0] = 255
    Image.fromarray(spoiled).save(tmp_path / "spoiled.png")
    Image.fromarray(photo[:-8]).save(tmp_path / "cropped.png")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_check_says_that_an_unchanged_photo_is_in_order(folder: Path) -> None:
    done = CliRunner().invoke(app, ["check", "scan.png", "scan.png"], catch_exceptions=False)

    assert done.exit_code == 0
    assert "nothing to say" in done.stdout
    assert "held back" in done.stdout


def test_check_tells_faults_as_json_and_draws_them_where_they_are(folder: Path) -> None:
    words = ["check", "scan.png", "spoiled.png", "--json", "--map", "faults.png"]
    done = CliRunner().invoke(app, words, catch_exceptions=False)

    assert done.exit_code == 0
    document = json.loads(done.stdout)
    assert document["held_back"] > 0.005
    worst = document["report"]["worst"][0]
    assert worst["row"] < 110
    assert worst["col"] < 130
    drawn = np.asarray(Image.open(folder / "faults.png")).astype(int)
    red = drawn[..., 0] - drawn[..., 1:].max(axis=-1)
    assert drawn.shape == (ROWS, COLS, 3)
    assert red[40, 40] > 100
    assert (red[130:, 150:] < 60).all()


def test_check_refuses_another_size_and_says_both(folder: Path) -> None:
    with pytest.raises(Exception, match=r"240 x 200 pixels and cropped\.png 240 x 192"):
        CliRunner().invoke(app, ["check", "scan.png", "cropped.png"], catch_exceptions=False)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["scan.png", "absent.png"], "no photo at absent.png"),
        (["scan.png", "spoiled.png", "--map", "faults.jpg"], "ends in .png"),
        (["scan.png", "spoiled.png", "--map", "scan.png"], "is there already"),
        (["scan.png", "spoiled.png", "--profile", "absent.lensprofile"], "no lens profile"),
    ],
)
def test_check_called_wrongly_says_how_to_call_it(folder: Path, words: list[str], reason: str) -> None:
    with pytest.raises(UsageError, match=reason):
        CliRunner().invoke(app, ["check", *words], catch_exceptions=False)
