"""The command line as a person types it: real processes, real files."""

from __future__ import annotations

import json
import logging
import os
import pty
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import in_process
import numpy as np
import pytest
import rawpy
import tifffile
from deadline import Deadline, stretched
from PIL import ExifTags, Image
from running import SMALL, lens_of_one_blur, scene, write_photo
from scipy import ndimage

from lab.kernels import gaussian
from lensmodel import photo
from lensmodel.blind import sampling
from lensmodel.cli import console, files
from lensmodel.cli.correct import targets_of
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.lens import Lens

HERE = Path(__file__).parents[1]
PICTURE = np.random.default_rng(0).integers(20, 220, (320, 400, 3), dtype=np.uint8)
PROFILE = "my-24mm.lensprofile"
PATIENCE_S = 240.0
ENVIRONMENT = {name: value for name, value in os.environ.items() if not name.startswith("LENS_")}


def command(*words: str | Path) -> list[str]:
    return [sys.executable, "-m", "lensmodel", *map(str, words)]


Here = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def here(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Here:
    """Run `main` in this process, in that folder: saves two seconds of imports where nothing is lost."""
    # a command that is quick says nothing of its progress, and a busy machine makes none slow
    monkeypatch.setattr(console, "EVERY_S", stretched(console.EVERY_S))
    return partial(in_process.lensmodel, cwd=folder)


def start(*words: str | Path, cwd: Path) -> subprocess.Popen[str]:
    """Start a command as a terminal does, in a process group of its own."""
    return subprocess.Popen(
        command(*words),
        cwd=cwd,
        env={**ENVIRONMENT, "PYTHONPATH": str(HERE.parents[1])},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def wait_for(fact: Callable[[], object]) -> None:
    deadline = Deadline(PATIENCE_S)
    while not fact():
        assert not deadline.passed()
        time.sleep(0.02)


def one_sentence(text: str) -> str:
    """Check that standard error is one plain line, and return it."""
    lines = text.strip().splitlines()
    assert len(lines) == 1, text
    assert "Traceback" not in text
    assert lines[0].startswith("lensmodel: ")
    return lines[0]


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A profile of a known blur, and photos of that lens and of another."""
    folder = tmp_path_factory.mktemp("made")
    write_photo(folder / "a.dng", 1, shape=SMALL)
    write_photo(folder / "b.dng", 2, shape=SMALL)
    write_photo(folder / "other.dng", 3, serial="L-43", shape=SMALL)
    lens_of_one_blur().save(folder / PROFILE)
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Iterator[Path]:
    """A working folder with a profile and one photo, and nothing left behind in it."""
    shutil.copy(made / PROFILE, tmp_path)
    shutil.copy(made / "a.dng", tmp_path / "one.dng")
    yield tmp_path
    assert not [path for path in tmp_path.rglob("*") if ".part" in path.name]


@pytest.fixture
def few_patches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Learn from two patches of a photo, too few for a wavefront: its fit takes longer than the rest."""
    few = {name: replace(preset, patches=2) for name, preset in sampling.PRESETS.items()}
    monkeypatch.setattr("lensmodel.blind.sampling.PRESETS", few)


# --- results -----------------------------------------------------------------------------------


def test_calibrate_learns_once_from_each_photo_and_says_so_in_json(
    folder: Path, here: Here, few_patches: None
) -> None:
    words = ("calibrate", "one.dng", "--profile", "new/lens.lensprofile", "--estimator", "default", "--json")
    first = here(*words, "--workers", "1")
    again = here(*words)

    said, then = json.loads(first.stdout), json.loads(again.stdout)
    assert first.returncode == again.returncode == 0
    assert [result["state"] for result in said["results"]] == ["counted"]
    assert [result["state"] for result in then["results"]] == ["known"]
    assert said["samples"] == then["samples"] > 0
    assert Lens.load(folder / "new/lens.lensprofile").names["serial"] == "L-42"


@pytest.mark.slow
def test_calibrate_force_begins_anew(folder: Path, here: Here) -> None:
    write_photo(folder / "one.dng", 1)
    done = here("calibrate", "one.dng", "-p", PROFILE, "--estimator", "default", "--force")

    assert done.returncode == 0, done.stderr
    assert list(Lens.load(folder / PROFILE).photos.values()) == ["one.dng"]


def test_correct_leaves_what_is_there_alone_unless_forced(folder: Path, here: Here) -> None:
    (folder / "out").mkdir()
    target = folder / "out" / "one-corrected.tif"
    target.write_bytes(b"mine")
    words = ("correct", "one.dng", "--profile", PROFILE, "-o", "out", "--method", "fast")
    kept = here(*words)
    was = target.read_bytes()
    forced = here(*words, "--force", "-q")

    assert kept.returncode == forced.returncode == 0
    assert was == b"mine"
    assert "--force" in one_sentence(kept.stderr)
    assert target.stat().st_size > 10000
    assert forced.stdout == forced.stderr == ""


@pytest.mark.parametrize(
    ("photos", "output", "written"),
    [
        (["a.dng"], "new/sharp.JPG", ["new/sharp.JPG"]),
        (["a.dng"], "sharp.tif/", ["sharp.tif/a-corrected.tif"]),
        (["a.dng"], "there.png", ["there.png/a-corrected.tif"]),
        (["a.dng", "b.dng"], "out.tif", ["out.tif/a-corrected.tif", "out.tif/b-corrected.tif"]),
        (["in/a.dng"], None, ["in/corrected/a-corrected.tif"]),
    ],
)
def test_a_name_that_ends_as_a_pictures_is_a_file_for_one_photo_and_any_other_a_folder(
    photos: list[str], output: str | None, written: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("there.png").mkdir()

    assert targets_of([*map(Path, photos)], output, None) == dict(
        zip(map(Path, photos), map(Path, written), strict=True)
    )


SHOTS = {
    "ending in capitals": (["IMG_1.DNG", "img_1.jpg"], ["IMG_1.DNG"]),
    "phone": (
        ["P.RAW-01.MP.COVER.jpg", "P.RAW-02.ORIGINAL.dng", "P2.jpg"],
        ["P.RAW-02.ORIGINAL.dng", "P2.jpg"],
    ),
    "both endings": (["a.CR2", "a.CR2.jpg", "A.cr2.tif"], ["a.CR2"]),
    "others": (["a.jpg", "a1.dng", "b.RAWS.jpg"], ["a.jpg", "a1.dng", "b.RAWS.jpg"]),
    "corrected": (["a.jpg", "a-corrected.dng"], ["a.jpg"]),
}


@pytest.mark.parametrize("case", SHOTS)
@pytest.mark.parametrize("given", ["folder", "files"])
def test_raw_and_other_files_of_one_shot_are_one_photo(case: str, given: str, tmp_path: Path) -> None:
    names, expected = SHOTS[case]
    for name in names:
        (tmp_path / name).touch()

    found = files.photos([tmp_path] if given == "folder" else [tmp_path / name for name in names], print)

    if given == "files" and case == "corrected":  # who names it will be told
        expected = names
    assert sorted(path.name for path in found) == sorted(expected)


def test_what_a_photographer_allows_reaches_the_correction(folder: Path, here: Here) -> None:
    words = ("--method", "fast", "--halo", "0", "--texture", "0.5", "--denoise", "1")
    done = here("correct", "one.dng", "-p", PROFILE, "-o", "new/bound.tif", *words)

    assert done.returncode == 0, done.stderr
    with tifffile.TiffFile(folder / "new" / "bound.tif") as file:
        said = file.pages[0].description
    assert "profile of 1 photo, method fast, strength 1, halo 0, texture 0.5, denoised 1" in said


def test_corrected_dng_opens_as_raw_and_without_a_terminal_standard_error_stays_empty(
    folder: Path, here: Here
) -> None:
    done = here("correct", "one.dng", "-p", PROFILE, "-o", "out", "--format", "dng", "--method", "fast")

    assert done.stdout.splitlines() == [str(Path("out/one-corrected.dng"))]
    assert done.stderr == ""
    with rawpy.imread(str(folder / "out/one-corrected.dng")) as raw:
        assert (raw.sizes.height, raw.sizes.width) == SMALL


def test_folders_pass_over_what_was_made_of_a_raw_file_and_bad_photos_do_not_stop_the_others(
    folder: Path, here: Here
) -> None:
    for name in ("one.jpg", "one.tif", "one-corrected.tif", "two.jpg", "two.png"):
        Image.fromarray(PICTURE).save(folder / name)
    (folder / "a-note.dng").write_text("this is text")
    done = here("correct", ".", "-p", PROFILE, "-o", "out", "--method", "fast", "--json")

    assert done.returncode == 1
    states = {result["photo"]: result["state"] for result in json.loads(done.stdout)["results"]}
    bad = dict.fromkeys(("a-note.dng", "two.jpg", "two.png"), "failed")
    assert states == {**bad, "one.dng": "corrected"}
    assert "give RAW, DNG, TIFF, PNG or JPEG" in done.stderr
    assert done.stderr.count("another photo would become") == 2
    assert [path.name for path in (folder / "out").iterdir()] == ["one-corrected.tif"]


def test_two_runs_on_one_profile_drop_nothing_of_each_other(
    folder: Path, made: Path, here: Here, monkeypatch: pytest.MonkeyPatch
) -> None:
    def estimated(path: Path, config: sampling.Config, **options: Any) -> list[PsfSample]:
        assert config.settings.aperture == 8.0  # for photos that do not say their own
        options["admit"](photo.inspect(path).metadata)
        known = Lens.load(folder / PROFILE)  # the other run saves while this one estimates
        replace(known, photos={**known.photos, "fedcba9876543210": "y.dng"}).save(folder / PROFILE)
        return [PsfSample(gaussian(15, np.eye(2)), FieldPosition(0.5, 0.0), LensSettings(2.8), photo="z")]

    monkeypatch.setattr("lensmodel.blind.sampling.samples_of_photo", estimated)
    done = here("calibrate", "one.dng", "-p", PROFILE, "--aperture", "8")

    assert done.returncode == 0, done.stderr
    assert sorted(Lens.load(folder / PROFILE).photos.values()) == ["one.dng", "x.dng", "y.dng"]


def test_a_photo_that_does_not_count_leaves_no_trace(folder: Path, here: Here) -> None:
    Image.fromarray(PICTURE).save(folder / "scan.png")
    done = here("calibrate", "scan.png", "-p", "no/such/lens.lensprofile")

    assert done.returncode == 1
    assert done.stderr.startswith("lensmodel: scan.png: it does not say its aperture")
    assert not (folder / "no").exists()


@pytest.mark.parametrize("consent", ["--any-lens", "--force"])
@pytest.mark.slow
def test_a_photo_of_another_lens_is_corrected_on_demand_and_said_to_be_one(
    folder: Path, here: Here, made: Path, consent: str
) -> None:
    shutil.copy(made / "other.dng", folder)
    done = here("correct", "other.dng", "-p", PROFILE, "-o", "out", consent, "--method", "fast")

    assert done.returncode == 0, done.stderr
    assert "its serial number is L-43, that of the lens L-42" in done.stderr
    assert (folder / "out/other-corrected.tif").exists()


# --- refusals ----------------------------------------------------------------------------------

CORRECT, CALIBRATE = ("correct", "one.dng", "-o", "o"), ("calibrate", "one.dng")
REFUSED = {
    "half a pair": (("measure", "pair", "one.dng", "-p", "new"), 2, "takes 2 photos at a time, got 1"),
    "missing photo": (("calibrate", "gone.dng", "-p", "new"), 2, "no photo called gone.dng"),
    "empty folder": (("calibrate", "empty", "-p", "new"), 2, "no photo in the folder empty"),
    "no image": (("correct", "text.dng", "-p", PROFILE), 1, "belong to no photo format"),
    "other lens": (("correct", "other.dng", "-p", PROFILE), 1, "another lens: .*L-43.*L-42.*--any-lens"),
    "add other lens": (("calibrate", "other.dng", "-p", PROFILE), 1, "lens: .*L-43.*profile of its own"),
    "no profile": ((*CORRECT, "-p", "gone"), 2, "no lens profile at gone; make it"),
    "bad profile": ((*CORRECT, "-p", "bad"), 1, "bad is no lens profile"),
    "bad profile to add to": ((*CALIBRATE, "-p", "bad"), 1, "bad is .*a damaged one; give another"),
    "profile is a photo": ((*CALIBRATE, "-p", "sub/one.dng", "--force"), 2, "one.dng is a photo; name a new"),
    "profile is the photo": (("calibrate", "there.npy", "-p", "there.npy", "--force"), 2, "npy is a photo"),
    "profile is a folder": ((*CALIBRATE, "-p", "empty"), 2, "empty is a folder"),
    "folder of profiles": ((*CORRECT, "-p", "empty"), 2, "empty is a folder; give the file"),
    "output is a file": (("correct", "one.dng", "-p", PROFILE, "-o", "bad"), 2, "bad is a file"),
    "halo that is none": ((*CORRECT, "-p", PROFILE, "--halo", "nan"), 2, "halo must not be negative.*nan"),
    "other format": (
        (*CORRECT[:-1], "o.png", "--format", "jpeg", "-p", PROFILE),
        2,
        "no name .*end it in .jpg",
    ),
    "unknown method": ((*CORRECT, "-p", PROFILE, "--method", "x"), 2, "known: .*fast"),
    "aperture": ((*CALIBRATE, "-p", "new", "--aperture", "-2"), 2, "-2"),
    "aperture in words": (("report", PROFILE, "--aperture", "wide"), 2, "such as 2.8 or f/2.8, got 'wide'"),
    "noise in words": (("bench", "blind", "--noise", "much"), 2, "such as 0.01,0.003, got 'much'"),
    "part to time": (("bench", "correct", "--roi", "1,2,x,4"), 2, "whole numbers T,L,H,W, got '1,2,x,4'"),
    "export by no format": (("export", PROFILE, "-o", "new.bmp"), 2, "ends in .fits, .json"),
    "finished benchmark": (("bench", "blind", "-o", "out"), 2, "blind.md is there already; --force replaces"),
    "profile and auto": ((*CORRECT, "--lens", "auto", "-p", PROFILE), 2, "one of them"),
    "neither profile nor auto": (CORRECT, 2, "--lens auto"),
}


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}


@pytest.mark.parametrize("case", REFUSED)
def test_refusal_is_one_sentence_with_the_value_and_a_remedy(
    case: str, folder: Path, made: Path, here: Here
) -> None:
    words, status, expected = REFUSED[case]
    for name in ("empty", "sub", "out"):
        (folder / name).mkdir()
    for name in ("text.dng", "out/blind.md"):
        (folder / name).write_text("no picture at all")
    shutil.copy(made / "other.dng", folder)
    shutil.copy(made / "other.dng", folder / "sub" / "one.dng")
    (folder / "bad").write_bytes((folder / PROFILE).read_bytes()[:-200])
    (folder / "there.npy").write_bytes(b"mine")
    before = contents(folder)

    done = here(*words)

    assert done.returncode == status, done.stderr
    assert re.search(expected, one_sentence(done.stderr)), done.stderr
    assert done.stdout == ""
    assert contents(folder) == before


def test_unknown_options_and_settings_are_wrong_usage(here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = ["--profil", "x"], ["-p", "x", "--model", "papers"], []
    options = [here("calibrate", "one.dng", *words) for words in wrong]
    monkeypatch.setenv("LENS_PROT", "9000")
    setting = here("serve")

    assert [done.returncode for done in (*options, setting)] == [2] * 4
    assert "did you mean LENS_PORT" in one_sentence(setting.stderr)


def test_the_settings_are_told_with_what_they_mean_and_without_passwords(
    here: Here, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LENS_DATABASE_URL", "postgresql+psycopg://lens:a[b@c/d@db:5432/lens")
    monkeypatch.setenv("LENS_STORAGE_URL", "s3://lensmodel")
    lines = here("config").stdout.splitlines()

    assert "LENS_DATABASE_URL=postgresql+psycopg://lens:********@db:5432/lens" in lines
    assert lines[lines.index("LENS_PORT=8000") - 1] == "# Port to listen on; 0 takes any free one."
    assert not [line for line in lines if "a[b" in line or "None" in line]


@pytest.mark.parametrize("part", ["serve", "api"])
def test_a_taken_port_is_told_as_such(part: str, here: Here) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        done = here(part, "--port", str(taken.getsockname()[1]), "--data", "data")

    assert done.returncode == 1
    assert re.search("cannot listen on 127.0.0.1:.* give another --port", done.stderr.splitlines()[-1])


def test_the_api_alone_logs_as_much_as_its_setting_says(here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LENS_LOG_LEVEL", "info")
    monkeypatch.setattr("uvicorn.Server.run", lambda *_, **__: logging.getLogger("app").info("GET /readyz"))

    assert "INFO api app: GET /readyz" in here("api", "--port", "0", "--data", "data").stderr


# --- what is there already ---------------------------------------------------------------------


def test_demo_renews_what_an_earlier_demo_left_and_no_folder_of_others_unless_forced(
    folder: Path, here: Here, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs: list[Path] = []

    def run(output: Path, say: Callable[[str], None]) -> bool:
        runs.append(output)
        say("working")
        output.mkdir(parents=True, exist_ok=True)
        (output / "report.md").write_text(f"run {len(runs)}", encoding="utf-8")
        return True

    monkeypatch.setattr("lab.demo.run", run)

    first, second = here("demo", "-o", "out"), here("demo", "-o", "out")
    assert first.returncode == second.returncode == 0
    assert second.stdout.strip() == "run 2"
    assert first.stderr.splitlines() == ["lensmodel: [0:00:00] working"]

    (folder / "out" / "mine.txt").write_text("my notes", encoding="utf-8")
    refused = here("demo", "-o", "out")
    assert refused.returncode == 2
    assert re.search("mine.txt is not of a demo; .*--force", one_sentence(refused.stderr))
    assert len(runs) == 2

    assert here("demo", "-o", "out", "--force").returncode == 0
    assert (folder / "out" / "mine.txt").read_text(encoding="utf-8") == "my notes"


def test_a_lens_learned_the_papers_way_stays_so_and_is_corrected_so(
    folder: Path, here: Here, few_patches: None, estimated_here: None
) -> None:
    new = "paper.lensprofile"
    words = ("calibrate", "one.dng", "-p", new, "--workers", "1", "--any-lens", "--json")
    quick = ("--estimator", "default", "--kernel-size", "21")
    result = json.loads(here(*words, *quick, "--model", "paper").stdout)

    kept = Lens.load(folder / new).model
    assert (result["model"], kept.mode) == ("paper", "paper")
    assert max(sample.kernel.shape for sample in kept.samples) <= (21, 21)
    assert json.loads(here(*words, *quick).stdout)["model"] == "paper"
    assert here("correct", "one.dng", "-p", new, "-o", "out").returncode == 0
    with Image.open(folder / "out" / "one-corrected.tif") as written:
        assert "method paper" in str(written.tag_v2.get(270))
    assert here(*words, "--kernel-size", "57").returncode == 2
    # kernels of the two models are not to be mixed
    for profile, asked, has in ((new, "default", "paper"), (PROFILE, "paper", "default")):
        refused = here("calibrate", "one.dng", "-p", profile, "--any-lens", *quick, "--model", asked)
        assert refused.returncode != 0
        assert f"has the model {has}, not {asked}" in refused.stderr
        assert Lens.load(folder / profile).model.mode == has


def test_a_photo_that_says_little_is_corrected_with_a_word_of_warning(folder: Path, here: Here) -> None:
    Image.fromarray(PICTURE).save(folder / "scan.tif")
    done = here("correct", "scan.tif", "-p", PROFILE, "-o", "out", "--method", "fast")

    assert done.returncode == 0
    assert re.search("does not name its lens.*\n.*does not say its aperture", done.stderr)


@pytest.mark.parametrize(("seen", "state"), [(True, "corrected"), (False, "left")])
def test_a_jpeg_that_would_gain_too_little_to_be_seen_is_left_unless_forced(
    seen: bool, state: str, folder: Path, here: Here
) -> None:
    write_jpeg(folder / "one.jpg", 1, blur_px=1.3 if seen else 60.0)
    words = ("correct", "one.jpg", "-p", PROFILE, "-o", "out.tif", "--method", "fast", "--any-lens")
    done = here(*words, "--json")

    assert done.returncode == 0, done.stderr
    (result,) = json.loads(done.stdout)["results"]
    assert result["state"] == state
    assert (folder / "out.tif").exists() == seen
    if not seen:
        assert "less than 0.3 dB" in result["reason"]
        assert re.search(r"one\.jpg: left as it is: .*--force", here(*words).stderr)
        assert here(*words, "--force", "-q").returncode == 0
        assert (folder / "out.tif").exists()


# --- interrupting ------------------------------------------------------------------------------


def write_jpeg(path: Path, seed: int, blur_px: float = 1.3) -> None:
    """Write a photo of such a lens as its camera would: nothing is learned of it in the end, all at once."""
    light = ndimage.gaussian_filter(scene(seed), blur_px)
    picture = np.rint(255.0 * light ** (1.0 / 2.2)).astype(np.uint8)
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif).update({ExifTags.Base.FNumber: 2.8, ExifTags.Base.LensModel: "Test 35mm"})
    Image.fromarray(np.dstack([picture] * 3)).save(path, quality=95, exif=exif)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=str)
def test_stopped_calibration_keeps_finished_photos_and_goes_on(
    number: signal.Signals, folder: Path, here: Here
) -> None:
    for seed, name in enumerate(("one.jpg", "two.jpg")):
        write_jpeg(folder / name, seed)
    profile = folder / "new.lensprofile"
    words = ("calibrate", "one.jpg", "two.jpg", "-p", "new.lensprofile", "--estimator", "default", "--json")
    process = start(*words, "-q", cwd=folder)  # on a slow machine it would tell how far it is
    wait_for(profile.exists)
    os.killpg(process.pid, number)  # the whole group, as a terminal does
    said, errors = process.communicate(timeout=stretched(20))

    assert process.returncode == 128 + number
    assert said == ""
    assert "finished files are kept" in one_sentence(errors)
    assert list(Lens.load(profile).photos.values()) == ["one.jpg"]
    again = json.loads(here(*words, "--workers", "1").stdout)
    assert [result["state"] for result in again["results"]] == ["known", "counted"]


def test_stopped_correction_leaves_whole_files_only_and_goes_on(folder: Path, made: Path, here: Here) -> None:
    shutil.copy(made / "b.dng", folder / "two.dng")
    words = ("correct", "one.dng", "two.dng", "-p", PROFILE, "-o", "out", "--method", "paper")
    process = start(*words, cwd=folder)
    first = folder / "out" / "one-corrected.tif"
    wait_for(first.exists)
    os.killpg(process.pid, signal.SIGINT)
    process.communicate(timeout=stretched(20))
    stamp = first.stat().st_mtime_ns

    assert process.returncode == 130
    assert [path.name for path in (folder / "out").iterdir()] == ["one-corrected.tif"]
    again = here(*words)
    assert again.stdout.splitlines() == [str(Path("out/two-corrected.tif"))]
    assert first.stat().st_mtime_ns == stamp


# --- progress ----------------------------------------------------------------------------------


def test_progress_is_on_a_terminal_and_results_are_in_the_pipe(
    here: Here, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("export", PROFILE, "-o", "new.npz", "--size", "15")
    ours, theirs = pty.openpty()
    seen: list[bytes] = []
    reader = threading.Thread(target=lambda: seen.extend(iter(partial(_read, ours), b"")))
    reader.start()
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    with os.fdopen(theirs, "w") as terminal:
        said = here(*words, terminal=terminal).stdout
    reader.join()
    os.close(ours)

    assert said.splitlines() == ["new.npz"]
    assert "computing its PSFs" in b"".join(seen).decode()


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 4096)
    except OSError:  # Linux says so when the other side is closed
        return b""
