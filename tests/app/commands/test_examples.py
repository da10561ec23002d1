"""What `--help` teaches: each command by example, and each example does what it says."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise, takewhile
from pathlib import Path
from typing import Any

import in_process
import numpy as np
import pytest
import typer
from deadline import stretched
from PIL import Image
from running import PROGRAM, lens_of_one_blur, scene, write_light, write_photo
from scipy import ndimage
from servers import free_port
from sqlalchemy import update
from typer.core import TyperCommand, TyperGroup

from app.blobs.storage import Storage
from app.runtime.backup import backup
from app.runtime.settings import Settings
from app.store import Store
from app.store.database import upgrade
from app.store.tables import KeyRow
from lab import targets
from lab.kernels import gaussian
from lab.lens_test import MARGIN, squares_chart
from lensmodel.cli.main import OnDemand, app
from lensmodel.core.types import Frame
from lensmodel.measured.target import TargetPage

HERE = Path(__file__).parents[3]
PATIENCE_S = 240.0
ROOT: Any = typer.main.get_command(app)


def commands(group: Any, names: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Walk over all commands that `--help` shows."""
    assert isinstance(group, TyperGroup)
    for name, listed in group.commands.items():
        command: Any = group.imported(name) if isinstance(group, OnDemand) else listed
        assert isinstance(command, TyperCommand | TyperGroup)
        if not command.hidden:
            yield " ".join((*names, name)), command
        if isinstance(command, TyperGroup):
            yield from commands(command, (*names, name))


COMMANDS = dict(commands(ROOT))
EXAMPLE = re.compile(r"^\s*lensmodel (.+?)\s*$", re.MULTILINE)
EXAMPLES = {line: name for name, command in COMMANDS.items() for line in EXAMPLE.findall(command.help or "")}

PAGES = [HERE / "README.md", *(HERE / "docs").rglob("*.md")]
PRINTED = r"^ {4,}(?:\.venv/bin/)?lensmodel ([a-z][^\\\n#]*[^\\\s#])[ ]*(?:#.*)?$"  # not those of two lines
DOCUMENTED = {line for page in PAGES for line in re.findall(PRINTED, page.read_text("utf-8"), re.MULTILINE)}


@pytest.mark.parametrize("line", sorted({*EXAMPLES, *DOCUMENTED}))
def test_each_example_is_understood_by_its_command(line: str) -> None:
    name = max((name for name in COMMANDS if f"{line} ".startswith(f"{name} ")), key=len)
    words = shlex.split(line.removeprefix(name))

    with contextlib.suppress(typer.Exit):  # `--help` ends the reading
        assert COMMANDS[name].make_context(name, words).params


# --- each example ------------------------------------------------------------------------------

SHORTER = {"calibrate": ["--estimator", "default"]}
"""What is added so that an example takes a minute at most; the estimators have tests of their own."""

NOT_RUN = {
    "reproduce --size quick -o reproduction",  # tests/lab/reproduce runs one lens from end to end
    "reproduce --lens 1003 --lens aspheric-f2.7.npz -o two-lenses",
    "bench blind --photos sharp --scenes 80 --half all --cases 200",
    "bench gallery --only simulated/snow --only simulated/sky -o two-pictures",  # tests/lab makes its page
}
"""Hours or minutes of the laboratory: that they are understood is tested, and their parts are."""

QUICK = {
    "correct one.dng --profile my-24mm.lensprofile -o linear --format dng --method fast --json",
    "export my-24mm.lensprofile --aperture 2 --rows 1 --cols 1 -o for-art.json",
    "config",
    "doctor --deep --json",
    "backup my-backup",
}
"""One of each command that takes a second at most; the others are run among the slow tests."""


def write_what_measures(folder: Path) -> None:
    """Write a photo of a printed page and of a chart of squares, and one scene at two apertures."""
    page = 0.8 * targets.target_scene(TargetPage(1000), (360, 510), targets.Setup(fill=0.97))[1]
    chart = squares_chart(Frame(720, 960), rows=3, cols=4)[0][1, MARGIN:-MARGIN, MARGIN:-MARGIN]
    noise = 0.4 + 0.12 * np.random.default_rng(7).standard_normal((720, 960))
    noise = np.clip(ndimage.gaussian_filter(noise, 0.5), 0.05, 0.9)
    for name, light, sigma, aperture in (
        ("page", page, 1.0, 2.8),
        ("open", noise, 1.3, 2.8),
        ("closed", noise, 0.4, 8.0),
        ("chart", chart, 1.0, 2.8),
    ):
        write_light(folder / f"{name}.dng", ndimage.gaussian_filter(light, sigma), 6, aperture=aperture)


@pytest.fixture(scope="session")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all that the examples speak of."""
    folder = tmp_path_factory.mktemp("prepared")
    (folder / "holiday").mkdir()
    (folder / "sharp").mkdir()
    write_photo(folder / "holiday" / "first.dng", 2)
    for name, seed in (("one", 1), ("one-more", 3), ("mine", 4), ("first", 5)):
        write_photo(folder / f"{name}.dng", seed)
    for k in range(4):
        picture = np.rint(255.0 * scene(k)).astype(np.uint8)
        Image.fromarray(np.dstack([picture] * 3)).save(folder / "sharp" / f"{k}.png")
    shutil.copy(folder / "sharp" / "0.png", folder / "scan.png")
    with Image.open(folder / "scan.png") as scan:
        scan.save(folder / "scan.tif")
    shutil.copy(folder / "scan.tif", folder / "scan-sharpened.tif")
    (folder / "linear").mkdir()
    shutil.copy(folder / "one.dng", folder / "linear" / "one-corrected.dng")
    kernels = np.stack([gaussian(31, np.eye(2) * (0.8 + 0.3 * k)) for k in range(4)])
    np.savez(folder / "mine.npz", psf=kernels)
    r, phi = map(np.ravel, np.meshgrid((0.1, 0.3, 0.5, 0.7, 0.9), (-2.4, -0.8, 0.8, 2.4)))
    np.savez(
        folder / "stars.npz", psf=np.stack([gaussian(15, np.eye(2) * (1.0 + x)) for x in r]), r=r, phi=phi
    )
    known = lens_of_one_blur()
    known.save(folder / "my-24mm.lensprofile")
    replace(known, names={**known.names, "serial": "L-43"}).save(folder / "a-friends-24mm.lensprofile")
    settings = Settings(data_dir=folder / "lensmodel-data")
    with contextlib.closing(Store(settings)) as store:
        upgrade(store.database)
        store.accounts.create_key("anna", ["write"])
        with store.database.writing() as session:
            session.execute(update(KeyRow).values(prefix="abcd2345"))
        backup(store.database, Storage(settings.storage), folder / "my-backup")
    return folder


@pytest.fixture
def folder(prepared: Path, tmp_path: Path) -> Path:
    shutil.copytree(prepared, tmp_path / "work")
    return tmp_path / "work"


def environment(folder: Path) -> dict[str, str]:
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("LENS_", "LENSMODEL_"))}
    return {**kept, "PYTHONPATH": str(HERE), "HOME": str(folder)}


@pytest.mark.parametrize(
    "line",
    [
        pytest.param(line, id=line, marks=[] if line in QUICK else [pytest.mark.slow])
        for line in EXAMPLES
        if EXAMPLES[line] != "serve" and line not in NOT_RUN
    ],
)
def test_example_runs(line: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = [*shlex.split(line), *SHORTER.get(EXAMPLES[line], [])]
    if "auto" in words:
        words += ["--learn-from", "1"]
    if EXAMPLES[line] == "measure":
        write_what_measures(folder)
    if line in QUICK:
        for name in set(os.environ) - set(environment(folder)):
            monkeypatch.delenv(name)
        monkeypatch.setenv("HOME", str(folder))
        done = in_process.lensmodel(*words, cwd=folder)
    else:
        started: dict[str, Any] = {"cwd": folder, "env": environment(folder), "capture_output": True}
        done = subprocess.run([*PROGRAM, *words], **started, text=True, check=False, timeout=3600.0)

    assert done.returncode == 0, done.stderr
    assert done.stdout
    for flag, value in pairwise(words):
        if flag in {"-o", "--output", "--profile", "--json"} and not value.startswith("-"):
            assert (folder / value).exists(), flag
    if words[-1] == "--json":
        json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.parametrize("line", [k for k in EXAMPLES if EXAMPLES[k] == "serve"])
def test_example_serves_and_prints_its_address_last_until_it_is_told_to_stop(line: str, folder: Path) -> None:
    words = [word.replace("~", str(folder)) for word in shlex.split(line)]
    with subprocess.Popen(
        [*PROGRAM, *words, *([] if "--port" in words else ["--port", "0"])],
        cwd=folder,
        env=environment(folder),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        assert process.stdout is not None
        address = "lensmodel runs at http://127.0.0.1:"
        before = list(takewhile(lambda said: not said.startswith(address), process.stdout))
        process.send_signal(signal.SIGINT)
        after = process.stdout.read()
        status = process.wait(stretched(PATIENCE_S))

    assert any("startup complete" in said for said in before)
    assert "confined" not in after
    assert "startup complete" not in after
    assert status == 0


# --- the pages for operators, typed word for word in an empty folder ----------------------------

ELSEWHERE = "/var/lib/postgresql"
"""Commands about another machine's disk."""


def operators_commands() -> list[str]:
    pages = [HERE / "docs" / name for name in ("service.md", "topics/operating.md")]
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    blocks = re.findall(r"^```sh\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    return [line for block in blocks for line in block.splitlines() if ELSEWHERE not in line]


@pytest.mark.slow
def test_each_command_of_the_pages_does_what_it_says(tmp_path: Path) -> None:
    if shutil.which("curl") is None or shutil.which("bash") is None:
        pytest.skip("needs bash and curl, as the page does")
    port, lines = str(free_port()), ["set -e"]
    for line in operators_commands():
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
