"""Calibration by executors of any kind, a Dask cluster of two processes among them."""

from __future__ import annotations

import importlib.util
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from running import SMALL, write_photo
from typer.testing import CliRunner, Result

import lensmodel
from lensmodel.blind import sampling
from lensmodel.cli.main import app
from lensmodel.core import processes
from lensmodel.core.psf import PsfSample
from lensmodel.lens import Lens


class Counting(ThreadPoolExecutor):
    """Notes how many calls are submitted and not yet taken."""

    def __init__(self) -> None:
        super().__init__(2)
        self.submitted = 0

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.submitted += 1
        return super().submit(fn, *args, **kwargs)


def test_items_come_in_order_and_few_are_submitted_ahead() -> None:
    with Counting() as executor:
        seen = []
        for taken, (item, future) in enumerate(
            processes.in_order(executor, pow, range(20), lambda k: (k, 2) if k % 3 else None, ahead=4),
            start=1,
        ):
            assert executor.submitted <= taken + 4
            seen.append((item, None if future is None else future.result()))

    assert seen == [(k, k**2 if k % 3 else None) for k in range(20)]


def test_what_is_not_taken_any_more_is_cancelled() -> None:
    gate = threading.Event()
    with ThreadPoolExecutor(1) as executor:
        jobs = processes.in_order(executor, gate.wait, range(9), lambda _: (5.0,), ahead=8)
        first = next(jobs)[1]
        jobs.close()  # type: ignore[attr-defined]  # a generator
        gate.set()
        assert first is not None
        assert first.result()
        assert executor._work_queue.qsize() == 0 or all(
            item is None or item.future.cancelled() for item in executor._work_queue.queue
        )


@pytest.fixture(scope="module")
def photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_photo(tmp_path_factory.mktemp("photos") / "one.dng", 1, shape=SMALL)


def calibrate(*words: str | Path) -> Result:
    return CliRunner().invoke(app, ["calibrate", *map(str, words)])


def stacked(samples: list[PsfSample]) -> np.ndarray:
    return np.stack([sample.kernel for sample in samples])


def test_a_photo_gives_the_same_samples_wherever_it_is_estimated(photo: Path) -> None:
    config = replace(sampling.PRESETS["default"], patches=4)
    here = sampling.samples_of_photo(photo, config, workers=1)
    with ThreadPoolExecutor(2) as threads:
        beside = sampling.samples_of_photo(photo, config, executor=threads)
    sent = sampling.samples_of_bytes(photo.name, photo.read_bytes(), config, "")

    np.testing.assert_array_equal(stacked(beside), stacked(here))
    np.testing.assert_array_equal(stacked(sent), stacked(here))
    assert [sample.photo for sample in sent] == [sample.photo for sample in here]


def test_whole_photos_are_calibrated_by_an_executor(photo: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.dng"
    broken.write_bytes(photo.read_bytes()[:2000])
    events: list[sampling.CalibrationEvent] = []

    with ThreadPoolExecutor(2) as threads:
        lens = lensmodel.calibrate(
            [photo, broken, photo], estimator="default", patches=4, executor=threads, on_event=events.append
        )

    assert [event.stage for event in events] == ["counted", "skipped", "skipped"]
    assert {sample.photo for sample in lens.samples} == {sampling.photo_id(photo)}


@pytest.mark.slow
def test_a_cluster_of_two_processes_calibrates_the_same_profile(tmp_path: Path) -> None:
    if importlib.util.find_spec("distributed") is None:
        pytest.skip("Dask is not installed: pip install 'lensmodel[cluster]'")
    from distributed import LocalCluster  # noqa: PLC0415 - an extra

    photos, quick = (
        [write_photo(tmp_path / f"{k}.dng", k) for k in range(4)],
        ["--estimator", "default", "-q"],
    )
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, protocol="tcp"
    ) as cluster:
        address = cluster.scheduler_address
        far = calibrate(*photos, *quick, "-p", tmp_path / "far.lensprofile", "--scheduler", address)
        assert len(cluster.scheduler_info["workers"]) == 2
    near = calibrate(*photos, *quick, "-p", tmp_path / "near.lensprofile")

    assert (far.exit_code, near.exit_code) == (0, 0), far.output + near.output
    one, other = (Lens.load(tmp_path / f"{name}.lensprofile").model for name in ("far", "near"))
    np.testing.assert_array_equal(stacked(list(one.samples)), stacked(list(other.samples)))


def test_a_cluster_that_does_not_answer_is_said(
    photo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("lensmodel.cli.calibrate.CONNECT_S", 0.5)

    result = calibrate(photo, "-p", tmp_path / "x.lensprofile", "--scheduler", "tcp://127.0.0.1:9")

    assert "no cluster answers there" in str(result.exception)
