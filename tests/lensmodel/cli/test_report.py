"""`lensmodel report` and `lensmodel export` on a profile, as a person types them."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from lab.kernels import gaussian
from lensmodel.cli.console import UsageError
from lensmodel.cli.main import app
from lensmodel.core.files import from_json
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.lens import Lens
from lensmodel.model import LensModel
from lensmodel.report.lens_report import LensReport, lens_report, provenance

NAME = "my-24mm.lensprofile"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a profile of two apertures, and the command run in it."""
    samples = []
    for photo, aperture in (("a", 2.0), ("b", 2.0), ("c", 5.6)):
        for r in (0.1, 0.35, 0.6, 0.85):
            for k in range(5):
                place = FieldPosition(r, 2.0 * math.pi * k / 5 + r)
                kernel = gaussian(15, np.eye(2) * (0.5 + 1.5 * r + 2.0 / aperture))
                samples.append(PsfSample(kernel, place, LensSettings(aperture=aperture), photo=photo))
    Lens(LensModel.fit(samples)).save(tmp_path / NAME)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def few_places(monkeypatch: pytest.MonkeyPatch) -> None:
    """Test lenses at few places: that takes a third of the time."""

    def quick(*given: Any, **options: Any) -> LensReport:
        return lens_report(*given, **options | {"rows": 3})

    monkeypatch.setattr("lensmodel.cli.report.lens_report", quick)


def run(*words: str) -> str:
    result = CliRunner().invoke(app, [*words], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def test_the_report_speaks_of_sharpness_centring_aperture_and_the_next_photo(folder: Path) -> None:
    text = run("report", NAME)

    assert text.startswith("my-24mm: 3 photos, blur measured at 60 places; f/2\n")
    for words in ("MTF50", "centred", "sharpest over the whole picture at f/5.6", "would help most"):
        assert words in text
    assert "about the same in the centre" in run("report", NAME, "--against", NAME, "--aperture", "2")


def test_the_report_folder_holds_numbers_and_pictures_that_agree(folder: Path, few_places: None) -> None:
    run("report", NAME, "-o", "out")

    names = {p.name for p in (folder / "out").iterdir()}
    assert names == {f"report.{ending}" for ending in ("pdf", "png", "csv", "json")}
    stored = json.loads((folder / "out" / "report.json").read_text(encoding="utf-8"))
    assert from_json(LensReport, stored).advice
    with (folder / "out" / "report.csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["quantity"] == "MTF50"]
    found = [row for row in rows if row["aperture"] == "2" and row["direction"] == "sagittal"]
    assert [float(row["value"]) for row in found] == pytest.approx(
        [spot["mtf50"][1] for spot in stored["tested"][0]["map"]], rel=1e-4
    )


def test_a_name_that_ends_as_a_form_is_that_file_alone(folder: Path, few_places: None) -> None:
    run("report", NAME, "-o", "out/mine.pdf", "--aperture", "2")

    assert [p.name for p in (folder / "out").iterdir()] == ["mine.pdf"]
    assert (folder / "out" / "mine.pdf").read_bytes().startswith(b"%PDF-")


def test_the_page_says_what_it_rests_on() -> None:
    found = provenance("12", ["Canon EOS 6D", "Canon EOS 6D", ""], ["b.dng", "a.jpg"])

    assert found | {"Serial number": "12", "Camera": "Canon EOS 6D", "Photos": "a.jpg, b.dng"} == found
    assert found["Caution"].startswith("Learned from JPEG files (1 of 2 photos): the camera's sharpening")
    assert not {"Caution", "Serial number"} & provenance(None, [], ["b.dng"]).keys()
    assert provenance(None, [], [f"{k}.dng" for k in range(20)])["Photos"].endswith("and 12 more")


def test_files_that_are_there_are_kept_without_force(folder: Path) -> None:
    (folder / "out").mkdir()
    for name in ("out/report.json", "psf.npz"):
        (folder / name).write_text("mine", encoding="utf-8")

    for words in (("report", NAME, "-o", "out"), ("export", NAME, "-o", "psf.npz")):
        with pytest.raises(UsageError, match="--force replaces it"):
            run(*words)
    assert {p.name for p in (folder / "out").iterdir()} == {"report.json"}
    assert (folder / "psf.npz").read_text(encoding="utf-8") == "mine"

    run("export", NAME, "-o", "psf.npz", "--force")
    assert np.load(folder / "psf.npz")["psf"].shape == (35, 31, 31)


@pytest.mark.parametrize(
    "words",
    [
        ("report", NAME, "-o", "mine.html"),
        ("report", NAME, "-o", "out", "--against", "nobodys.lensprofile"),
        ("report", "nobodys.lensprofile", "-o", "out"),
        ("target", "."),
    ],
)
def test_what_cannot_be_written_is_refused_before_anything_is(
    folder: Path, few_places: None, words: tuple[str, ...]
) -> None:
    refused = CliRunner().invoke(app, [*words])

    assert isinstance(refused.exception, UsageError)
    assert "--force" not in str(refused.exception)
    assert [p.name for p in folder.iterdir()] == [NAME]
