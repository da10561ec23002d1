"""`lensmodel check` on files, as a person types it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image
from typer.testing import CliRunner

from lensmodel.cli.ending import UsageError
from lensmodel.cli.main import app
from lensmodel.core.errors import LensModelError

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
        (["scan.png", "spoiled.png", "--map", "absent/faults.png"], "no folder absent"),
        (["scan.png", "."], "no photo at"),
        (["scan.png", "spoiled.png", "--profile", "absent.lensprofile"], "no lens profile"),
    ],
)
def test_check_called_wrongly_says_how_to_call_it(folder: Path, words: list[str], reason: str) -> None:
    with pytest.raises(UsageError, match=reason):
        CliRunner().invoke(app, ["check", *words], catch_exceptions=False)


@pytest.mark.parametrize("kind", ["grey", "alpha", "sixteen bits", "broken colour profile", "quarter turn"])
def test_check_finds_nothing_where_only_the_file_differs(folder: Path, kind: str) -> None:
    photo = Image.open(folder / "scan.png")
    pixels = np.asarray(photo)
    before, after = "scan.png", "other.png"
    if kind == "grey":
        before = after = "grey.png"
        Image.fromarray(pixels[..., 0]).save(after)
    elif kind == "alpha":
        photo.convert("RGBA").save(after)
    elif kind == "sixteen bits":
        after = "other.tif"
        tifffile.imwrite(after, pixels.astype(np.uint16) * 257, photometric="rgb")
    elif kind == "broken colour profile":
        photo.save(after, icc_profile=b"rubbish")
    else:  # a note that programs add or leave out, while the pixels lie as they did
        before, after = "scan.jpg", "turned.jpg"
        note = Image.Exif()
        note[0x0112] = 6
        photo.save(before, quality=95)
        photo.save(after, quality=95, exif=note)

    done = CliRunner().invoke(app, ["check", before, after, "--json"], catch_exceptions=False)

    assert json.loads(done.stdout)["held_back"] == 0.0


def test_check_finds_a_pixel_of_infinite_light(folder: Path) -> None:
    light = (np.asarray(Image.open("scan.png")) / 255.0).astype(np.float32)
    tifffile.imwrite("light.tif", light, photometric="rgb")
    light[100, 60] = np.inf
    tifffile.imwrite("broken.tif", light, photometric="rgb")

    done = CliRunner().invoke(app, ["check", "light.tif", "broken.tif", "--json"], catch_exceptions=False)

    document = json.loads(done.stdout)
    assert 0.0 < document["held_back"] < 0.05
    worst = document["report"]["worst"][0]
    assert abs(worst["row"] - 100) <= 8
    assert abs(worst["col"] - 60) <= 8


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("empty.png", b"", "the file is empty"),
        ("words.png", b"hello", "no photo format"),
    ],
)
def test_check_refuses_what_is_no_photo(folder: Path, name: str, content: bytes, reason: str) -> None:
    (folder / name).write_bytes(content)
    with pytest.raises(LensModelError, match=reason):
        CliRunner().invoke(app, ["check", "scan.png", name], catch_exceptions=False)


@pytest.mark.parametrize("shape", [(1, 1), (1, 120), (20, 20)])
def test_check_takes_photos_of_16_pixels_and_more(folder: Path, shape: tuple[int, int]) -> None:
    Image.fromarray(np.full((*shape, 3), 99, dtype=np.uint8)).save("small.png")
    words = ["check", "small.png", "small.png", "--json"]
    if min(shape) < 16:
        with pytest.raises(LensModelError, match="16"):
            CliRunner().invoke(app, words, catch_exceptions=False)
    else:
        done = CliRunner().invoke(app, words, catch_exceptions=False)
        assert json.loads(done.stdout)["held_back"] == 0.0
