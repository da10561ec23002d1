"""`lensmodel reproduce` through the service; the service is real only in the slow test."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from app.cli import app
from app.client import JobEndedError
from app.lab.reproduce import WorkLines
from app.lab.service_route import CODE, ServiceRoute, ServiceRoutes
from app.schemas import JobOut
from lensmodel.core.errors import NoSamplesError
from lensmodel.core.psf import gaussian
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.lab.reproduce import Reproduction, planned, run_reproduction
from lensmodel.simulate import draw_lens


class FakeClient:
    """Answers as the service would; `refuses` makes every photo fail."""

    def __init__(self, *, refuses: bool = False) -> None:
        self.refuses = refuses
        self.asked: list[dict[str, Any]] = []
        self.said: dict[str, dict[str, str | None]] = {}

    def upload(self, path: Path, *, calibrate: bool = True, **said: str | None) -> SimpleNamespace:
        self.said[path.suffix] = said
        return SimpleNamespace(id=path.stem, calibrate=calibrate)

    def wait(self, work: SimpleNamespace, **_: object) -> None:
        if self.refuses:
            raise JobEndedError(JobOut.model_construct(id=work.id, kind="photo", state="failed", error=None))

    def photo(self, photo_id: str) -> SimpleNamespace:
        return SimpleNamespace(id=photo_id, lens_id="lens-1")

    def psf(self, lens_id: str, **query: Any) -> SimpleNamespace:
        self.asked.append({"lens_id": lens_id, **query})
        kernel = gaussian(query["size"], np.eye(2)).tolist()
        return SimpleNamespace(
            psf=SimpleNamespace(data=kernel), support=SimpleNamespace(predicted_error=None)
        )


def test_route_asks_the_service_for_the_lens_of_the_photos(tmp_path: Path) -> None:
    client = FakeClient()
    route = ServiceRoute(client, tmp_path)  # type: ignore[arg-type]  # as much of a client as it needs
    assert route.learn(tmp_path / "one.dng") == ""
    place, settings = FieldPosition(0.5, 1.0), LensSettings(aperture=2.0, focal_mm=24.0)
    (answer,) = route.answers([(place, "r")], settings, 9)
    assert answer.kernel.shape == (9, 9)
    assert np.isnan(answer.predicted_error)
    (asked,) = client.asked
    assert asked["lens_id"] == "lens-1"
    assert (asked["aperture"], asked["focal_length_mm"], asked["channel"]) == (2.0, 24.0, "r")


def test_route_names_the_lens_of_photos_that_do_not(tmp_path: Path) -> None:
    client, lens = FakeClient(), draw_lens(1003)
    route = ServiceRoute(client, tmp_path, lens)  # type: ignore[arg-type]  # as above
    route.learn(tmp_path / "raw.dng")
    route.learn(tmp_path / "developed.tif")
    assert client.said[".dng"]["lens_serial"] is None
    assert client.said[".tif"]["lens_serial"] == lens.serial


def test_route_says_why_a_photo_did_not_count(tmp_path: Path) -> None:
    route = ServiceRoute(FakeClient(refuses=True), tmp_path)  # type: ignore[arg-type]  # as above
    assert "failed" in route.learn(tmp_path / "one.dng")
    with pytest.raises(NoSamplesError, match="no photo has counted"):
        route.answers([], LensSettings(), 9)


def test_progress_tells_the_share_done_and_leaves_stored_work_out_of_the_estimate(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = iter([0.0, 0.0, 10.0, 20.0])  # begun, then once a line
    monkeypatch.setattr("app.lab.reproduce.time", SimpleNamespace(monotonic=lambda: next(now)))
    tell = WorkLines()
    tell("stored", 50.0, 100.0, fresh=False)
    tell("photo", 60.0, 100.0, fresh=True)
    tell("end", 100.0, 100.0, fresh=True)
    first, second, last = capsys.readouterr().err.splitlines()
    assert first == "[ 50 %] stored"
    assert second == "[ 60 %] photo, about 40 s left"
    assert last == "[100 %] end"


def test_quick_and_full_exclude_each_other() -> None:
    done = CliRunner().invoke(app, ["reproduce", "--quick", "--full"])
    assert "exclude each other" in str(done.exception)


@pytest.mark.slow
def test_lens_is_learned_and_corrected_by_a_real_service(tmp_path: Path) -> None:
    one = replace(planned("quick").cases[0], height=480, width=640, photos=(1,))
    chosen = Reproduction(
        (one,), estimator="whittle", methods=("standard",), size="quick", paper=False, general=False
    )
    messages: list[str] = []

    def on_work(words: str, done: float, total: float, *, fresh: bool) -> None:
        del done, total, fresh
        messages.append(words)

    made = run_reproduction(
        chosen,
        ServiceRoutes("whittle"),
        tmp_path,
        route="by the service",
        code=CODE,
        workers=2,
        with_figures=False,
        on_work=on_work,
    )
    unit = made["cases"][0]["learned"]["1"]
    assert unit["counted"] == 1
    before, after = made["cases"][0]["truth"]["before"], unit["methods"]["standard"]
    assert after["edges"]["center"]["mtf50"] > before["edges"]["center"]["mtf50"]
    assert after["psnr"]["center"] > before["psnr"]["center"]
    assert unit["psf"]["rel_l2"]["g"]["center"] < 1.0
    assert any(re.search("learned from photo-00", words) for words in messages)
    assert not list(tmp_path.rglob("service"))


def test_scenes_that_hurt_are_taken_when_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    planned_for: list[Reproduction] = []

    def run(plan: Reproduction, *_: object, **__: object) -> None:
        planned_for.append(plan)
        raise NoSamplesError("that is enough")

    monkeypatch.setattr("lensmodel.lab.reproduce.run_reproduction", run)
    for asked in ([], ["--hard"]):
        CliRunner().invoke(app, ["reproduce", "--quick", "--direct", "-o", str(tmp_path), *asked])
    without, hard = ({case.condition for case in plan.cases} for plan in planned_for)
    assert without == {"base"}
    assert {"base", "high-iso", "tiff", "jpeg", "depth", "motion", "night", "text", "foliage"} < hard


@pytest.mark.parametrize(("lines", "status"), [([], 0), (["n = 5: relative L2 of the PSF"], 1)])
def test_missed_bars_fail_a_run_that_asserts_them(
    lines: list[str], status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: dict[str, Any] = {"code": "0", "figures": {}}
    for name, value in {
        "planned": None,
        "run_reproduction": made,
        "write_page": (),
        "collected": None,
        "missed": lines,
    }.items():
        monkeypatch.setattr(f"lensmodel.lab.reproduce.{name}", lambda *_, value=value, **__: value)
    arguments = ["reproduce", "--direct", "-o", str(tmp_path)]

    asserted = CliRunner().invoke(app, [*arguments, "--assert-bars"])
    assert (asserted.exit_code, CliRunner().invoke(app, arguments).exit_code) == (status, 0)
    assert all(line in asserted.stderr for line in lines)
