"""The loop over photos that command, library and service share, without estimating anything."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lensmodel
from lensmodel import photo
from lensmodel.core.errors import CancelledError, InvalidInputError, MetadataMissingError
from lensmodel.core.psf import PsfSample, gaussian
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import LensModel, LensProfile
from lensmodel.workflow import calibrating, pipeline
from lensmodel.workflow.lens import Lens


def samples_of(name: str) -> list[PsfSample]:
    return [
        PsfSample(gaussian(15, np.eye(2)), FieldPosition(r, phi), LensSettings(2.8), photo=name)
        for r in (0.1, 0.5, 0.9)
        for phi in (-2.0, 0.5, 2.5)
    ]


@pytest.fixture
def photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Two files that pass for photos; their samples are made up."""

    def estimated(path: Path, recipe: pipeline.Recipe, **options: object) -> list[PsfSample]:
        return samples_of(pipeline.photo_id(path))

    def inspected(path: Path) -> photo.PhotoInfo:
        aperture = None if path.stem == "unknown" else 2.8
        return photo.PhotoInfo("dng", 6, 4, photo.PhotoMetadata(aperture=aperture))

    monkeypatch.setattr(calibrating, "samples_of_photo", estimated)
    monkeypatch.setattr(calibrating.photo, "inspect", inspected)
    paths = [tmp_path / "a.dng", tmp_path / "b.dng"]
    for path in paths:
        path.write_bytes(path.name.encode())
    return paths


class Noting(pipeline.InMemory):
    """Notes how many samples a lens has whenever it is kept."""

    def __init__(self, lens: Lens | None = None) -> None:
        super().__init__(lens)
        self.kept: list[int] = []

    def keep(self, lens: Lens) -> None:
        super().keep(lens)
        self.kept.append(len(lens.samples))


def test_a_lens_is_kept_after_each_photo(photos: list[Path]) -> None:
    keeper = Noting()
    calibration = pipeline.Calibration(keeper, pipeline.Recipe())

    verdicts = list(calibration.learn([*photos, photos[0]]))
    lens = calibration.known

    assert [verdict.samples for verdict in verdicts] == [9, 9, None]
    assert lens is not None
    assert sorted(lens.profile.photos.values()) == ["a.dng", "b.dng"]
    assert keeper.kept == [9, 18]


def test_nothing_is_kept_where_nothing_was_learned(photos: list[Path]) -> None:
    key = pipeline.photo_id(photos[0])
    keeper = Noting(Lens(LensProfile(LensModel.fit(samples_of(key)), {}, {key: "a.dng"})))
    calibration = pipeline.Calibration(keeper, pipeline.Recipe())

    assert calibration.add(photos[0]) is None
    assert calibration.known is keeper.lens()
    assert keeper.kept == []


def test_what_another_run_added_meanwhile_stays(photos: list[Path]) -> None:
    keeper = Noting()
    calibration = pipeline.Calibration(keeper, pipeline.Recipe())
    calibration.add(photos[0])
    kept = keeper.lens()
    assert kept is not None
    others = Lens(
        replace(kept.profile, model=LensModel.fit([*kept.samples, *samples_of("x")]), photos={"x": "x.dng"})
    )

    keeper.keep(others)
    calibration.add(photos[1])
    lens = calibration.known

    assert lens is not None
    assert len(lens.samples) == 27
    assert sorted(lens.profile.photos.values()) == ["b.dng", "x.dng"]


def test_photos_that_cannot_teach_a_lens_are_refused_before_any_work(
    photos: list[Path], tmp_path: Path
) -> None:
    calibration = pipeline.Calibration(Noting(), pipeline.Recipe())
    for name in ("a-corrected.dng", "unknown.dng"):
        (tmp_path / name).write_bytes(name.encode())

    with pytest.raises(InvalidInputError, match="give the original"):
        calibration.add(tmp_path / "a-corrected.dng")
    with pytest.raises(MetadataMissingError, match="--aperture"):
        calibration.add(tmp_path / "unknown.dng")

    assert calibration.known is None


class Written:
    """Steps that only say that they were taken."""

    def __init__(self, *, goes_on: bool) -> None:
        self.taken: list[str] = []
        self._goes_on = goes_on

    def inspect(self) -> bool:
        self.taken.append("inspect")
        return self._goes_on

    def enter(self, stage: pipeline.Stage) -> None:
        self.taken.append(stage)

    def develop(self) -> None:
        self.taken.append("develop")

    def select(self) -> None:
        self.taken.append("select")

    def estimate(self) -> None:
        self.taken.append("estimate")

    def count(self) -> None:
        self.taken.append("count")


def test_a_photo_takes_its_steps_in_order_and_none_after_a_refusal() -> None:
    counted, refused = Written(goes_on=True), Written(goes_on=False)

    pipeline.take(counted)
    pipeline.take(refused)

    assert counted.taken == [
        *("inspect", "developing", "develop", "selecting", "select", "estimating", "estimate", "count")
    ]
    assert refused.taken == ["inspect"]


def test_a_calibration_that_is_cancelled_is_no_photo_that_failed(
    photos: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def cancelled(path: Path, recipe: pipeline.Recipe, **options: object) -> list[PsfSample]:
        raise CancelledError("enough")

    monkeypatch.setattr(calibrating, "samples_of_photo", cancelled)

    with pytest.raises(CancelledError, match="enough"):
        lensmodel.calibrate(photos)
