"""`lensmodel correct FOLDER --lens auto`: from a folder of mixed photos to corrected ones and a table."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from dataclasses import replace
from datetime import datetime, timedelta
from functools import partial
from itertools import groupby
from pathlib import Path

import pytest
from in_process import lensmodel
from PIL import Image
from running import SMALL, lens_of_one_blur, write_photo

from lensmodel.blind.sampling import photo_id
from lensmodel.cli import console
from lensmodel.cli.correct import Shot, groups
from lensmodel.lens import Lens
from lensmodel.model.identity import Camera
from lensmodel.photo.values import LensIdentity, PhotoMetadata

REPORTS = Path(__file__).parents[2] / "data" / "reports"
AUTO = ("correct", "holiday", "--lens", "auto", "--profiles", "lenses", "--method", "fast")


@pytest.fixture(scope="module")
def card(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as it comes from a card: two lenses, one of them known, and a file that is no photo."""
    here = tmp_path_factory.mktemp("card")
    photos = here / "holiday"
    photos.mkdir()
    write_photo(photos / "a.dng", 1, shape=SMALL)
    write_photo(photos / "b.dng", 2, shape=SMALL)
    write_photo(photos / "c.dng", 3, serial="L-43", sigma=20.0, shape=SMALL)  # nothing to be learned from
    (photos / "broken.dng").write_bytes(b"no photo")
    (photos / "phone.HEIC").write_bytes(b"another kind")
    (photos / "day 2").mkdir()
    shutil.copy(photos / "a.dng", photos / "day 2")
    known = {photo_id(photos / name): name for name in ("a.dng", "b.dng")}
    (here / "lenses").mkdir()
    (group,) = groups([Shot.of(photos / "a.dng")])
    profile = replace(lens_of_one_blur(), photos=known, cameras=(Camera("Test", "T-1", None),))
    profile.save(here / "lenses" / f"{group.name}.lensprofile")
    return here


@pytest.fixture(scope="module")
def journey(card: Path) -> Path:
    """The same folder after the command ran once."""
    (card / "before.json").write_text(json.dumps(_sums(card / "holiday")))
    done = lensmodel(*AUTO, cwd=card)
    (card / "said.txt").write_text(done.stdout)
    (card / "errors.txt").write_text(done.stderr)
    assert done.returncode == 1, done.stderr  # for the file that is no photo
    return card


def _sums(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.glob("*.dng")}


def test_each_lens_has_a_line(journey: Path) -> None:
    text = (journey / "said.txt").read_text()

    assert re.findall(r"#(\S+),", text) == ["L-42", "L-43"]
    figures = [line.partition(" mm: ")[2] for line in text.splitlines()]
    start = "photos 2, learned from 2, corrected 2, corrected before 0, left 0, failed 0, expected gain +"
    assert figures[0].startswith(start)
    assert figures[1].startswith(
        "photos 1, learned from 0, corrected 0, corrected before 0, left 1, failed 0"
    )


def test_what_cannot_be_read_is_named_and_the_rest_goes_on(journey: Path) -> None:
    errors = (journey / "errors.txt").read_text().splitlines()

    assert any("broken.dng" in line for line in errors)
    assert "lensmodel: passed over in holiday: folder 1, .heic 1" in errors
    (why,) = (line for line in errors if "#L-43" in line)
    assert "detail" in why


def test_a_group_names_every_body_and_none_that_another_photo_names(tmp_path: Path) -> None:
    exif = Image.Exif()
    for name in ("one.jpg", "two.jpg"):
        Image.new("RGB", (64, 48)).save(tmp_path / name, exif=exif)
        exif[271] = "Maker Only"

    (group,) = groups([Shot.of(tmp_path / "two.jpg"), Shot.of(tmp_path / "one.jpg")])

    assert set(group.words["camera"].split(", ")) == {"unknown camera", "Maker Only"}


def test_nothing_but_unreadable_files_makes_no_line(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("no photo")

    done = lensmodel("correct", "notes.txt", "--lens", "auto", cwd=tmp_path)

    assert (done.returncode, done.stdout) == (1, "")
    assert "notes.txt" in done.stderr


def test_corrected_photos_are_beside_the_originals(journey: Path) -> None:
    out = journey / "holiday" / "corrected"

    assert sorted(path.name for path in out.glob("*.tif")) == ["a-corrected.tif", "b-corrected.tif"]
    said = (out / "a-corrected.tif").read_bytes()
    assert b"Test 35mm f/1.8" in said
    assert b"L-42" not in said


def test_the_photos_themselves_stay_as_they_are(journey: Path) -> None:
    assert _sums(journey / "holiday") == json.loads((journey / "before.json").read_text())


def test_the_same_command_again_does_nothing_twice(journey: Path) -> None:
    stamps = {path: path.stat().st_mtime_ns for path in journey.rglob("*.*") if path.suffix != ".json"}

    done = lensmodel(*AUTO, "--json", cwd=journey)

    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps
    found = json.loads(done.stdout)
    assert [group["corrected_before"] for group in found["groups"]] == [2, 0]
    assert [group["left"] for group in found["groups"]] == [0, 1]
    assert sorted(result["state"] for result in found["results"]) == ["failed", "kept", "kept", "left"]


def test_quiet_says_nothing_but_errors_and_verbose_tells_of_each_photo(journey: Path) -> None:
    quiet, verbose = (lensmodel(*AUTO, option, cwd=journey) for option in ("-q", "-v"))

    assert quiet.stdout == ""
    assert len(quiet.stderr.splitlines()) == 1
    assert "a-corrected.tif is there already" in verbose.stderr


@pytest.mark.slow
def test_a_folder_of_an_unknown_lens_is_learned_and_corrected(tmp_path: Path) -> None:
    (tmp_path / "holiday").mkdir()
    write_photo(tmp_path / "holiday" / "a.dng", 1)
    write_photo(tmp_path / "holiday" / "b.dng", 2)

    done = lensmodel(*AUTO, "--learn-from", "1", "--json", cwd=tmp_path)

    (group,) = json.loads(done.stdout)["groups"]
    assert group["learned_from"] == 1
    assert group["corrected"] + group["left"] == 2
    assert Lens.load(tmp_path / Path(group["profile"])).model.samples


# --- sorting -----------------------------------------------------------------------------------

ZOOM = PhotoMetadata(
    camera_model="T-1", lens=LensIdentity("Test", "24-70mm", "7", "exif"), focal_mm=24.0, aperture=2.8
)


def shots(*metadata: PhotoMetadata) -> list[Shot]:
    return [Shot(Path(f"{i}.dng"), said) for i, said in enumerate(metadata)]


def at(focal: float | None) -> PhotoMetadata:
    return replace(ZOOM, focal_mm=focal)


def test_focal_lengths_of_a_zoom_are_groups_of_one_profile() -> None:
    found = groups(shots(at(24.0), at(26.0), at(70.0), at(None)))

    assert [group.words["focal_length"] for group in found] == ["unknown focal length", "24-26 mm", "70 mm"]
    assert len({group.name for group in found}) == 1


def lens(serial: str | None) -> PhotoMetadata:
    return replace(ZOOM, lens=LensIdentity("Test", "24-70mm", serial, "exif"))


@pytest.mark.parametrize(
    "apart",
    [
        [ZOOM, lens("8")],
        [lens("111234"), lens("991234")],
        [lens(None), replace(lens(None), body_serial="1")],
        [replace(at(focal), lens=LensIdentity()) for focal in (24.0, 50.0)],
    ],
    ids=["two copies", "serials that end alike", "two bodies, no serial", "focal lengths, no name"],
)
def test_what_may_be_two_lenses_has_two_profiles(apart: list[PhotoMetadata]) -> None:
    assert len({group.name for group in groups(shots(*apart, *apart))}) == 2


def test_a_lens_on_two_bodies_is_one_lens_and_the_larger_frames_are_learned_from_first() -> None:
    small = replace(ZOOM, camera_model="T-2", body_serial="1")
    cropped, whole, other = (
        Shot(Path(name), said, half)
        for name, said, half in (("a.dng", ZOOM, 14.2), ("b.dng", ZOOM, 21.6), ("c.dng", small, 14.1))
    )

    (group,) = groups([cropped, whole, other])

    assert [path.name for path in group.to_learn_from()[0]] == ["b.dng", "a.dng", "c.dng"]


def test_a_name_of_a_lens_is_never_a_path() -> None:
    evil = replace(ZOOM, camera_model="../../etc", lens=LensIdentity("x", "a/b\\c", None, "none"))

    (group,) = groups(shots(evil))

    assert not set("/\\") & set(group.name)
    assert not group.name.startswith(".")


def test_the_frames_of_a_burst_are_one_scene_and_others_are_learned_from_first() -> None:
    start = datetime(2024, 5, 1, 12, 0, 0)  # noqa: DTZ001 - cameras' clocks have no zone
    taken = [replace(ZOOM, taken_at=start + timedelta(seconds=s)) for s in (0, 1, 2, 3, 60, 62, 90, 91)]
    taken[6] = replace(taken[6], aperture=8.0)  # the last two are of two apertures: no burst
    (group,) = groups(shots(*taken))

    paths, scenes = group.to_learn_from()
    assert scenes == 4
    assert [path.name for path in paths[:4]] == ["0.dng", "6.dng", "4.dng", "7.dng"]
    assert len(paths) == 8
    assert groups(shots(ZOOM, ZOOM, ZOOM))[0].to_learn_from()[1] == 3  # without a time


def test_every_aperture_is_learned_from_before_any_is_twice() -> None:
    (group,) = groups(shots(*(replace(ZOOM, aperture=n) for n in (2.8, 2.8, 2.8, 8.0, 4.0))))

    assert [path.name for path in group.to_learn_from()[0]] == ["0.dng", "4.dng", "3.dng", "1.dng", "2.dng"]


# --- why a photo teaches nothing ----------------------------------------------------------------


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])


USELESS = {
    "a.dng": (partial(write_photo, seed=1, shape=SMALL, aperture=None), "does not say its aperture"),
    "b.dng": (_cut, "copy it again"),
    "c.dng": (partial(shutil.copy, REPORTS / "quad-bayer.dng"), "4 x 4"),
}


@pytest.mark.parametrize("name", USELESS)
def test_what_teaches_nothing_for_another_reason_than_its_detail_fails_with_that_reason(
    name: str, tmp_path: Path
) -> None:
    spoil, reason = USELESS[name]
    (tmp_path / "holiday").mkdir()
    path = tmp_path / "holiday" / name
    if name.endswith("dng"):
        write_photo(path, 1, shape=SMALL)
    spoil(path)

    done = lensmodel(*AUTO, "--json", cwd=tmp_path)

    assert done.returncode == 1
    assert reason in done.stderr
    assert "no photo shows enough" not in done.stderr
    (result,) = json.loads(done.stdout)["results"]
    assert result["state"] == "failed"
    assert reason in result["reason"]


def test_all_lenses_are_learned_before_photos_are_corrected(
    card: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(card / "holiday", tmp_path / "holiday", ignore=shutil.ignore_patterns("corrected"))
    shutil.copytree(card / "lenses", tmp_path / "lenses")
    monkeypatch.setattr(console, "EVERY_S", 0.0)

    lines = re.findall(r"\] +(\d+) % (\w+)", lensmodel(*AUTO, cwd=tmp_path).stderr)

    parts = [(verb, [int(share) for share, _ in part]) for verb, part in groupby(lines, lambda line: line[1])]
    assert [verb for verb, _ in parts] == ["learning", "correcting"]
    assert parts[-1][1][-1] == 100
