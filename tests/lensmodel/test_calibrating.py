"""The loop over photos that command, library and service share, without estimating anything."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest
import rawpy

import lensmodel
from lab.kernels import gaussian
from lensmodel import photo
from lensmodel.api import Calibration, LensStore
from lensmodel.blind import sampling
from lensmodel.core import processes
from lensmodel.core.errors import CancelledError, InvalidInputError, MetadataMissingError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import FieldPosition, LensSettings, Plane
from lensmodel.lens import Lens
from lensmodel.model import LensModel
from lensmodel.photo.writing import write_bayer_dng


def samples_of(name: str) -> list[PsfSample]:
    return [
        PsfSample(gaussian(15, np.eye(2)), FieldPosition(r, phi), LensSettings(2.8), photo=name)
        for r in (0.1, 0.5, 0.9)
        for phi in (-2.0, 0.5, 2.5)
    ]


@pytest.fixture
def photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Two files that pass for photos; their samples are made up."""

    def estimated(path: Path, config: object, *, key: str, admit: Callable, **_: object) -> list[PsfSample]:
        admit(photo.PhotoMetadata(aperture=None if path.stem == "unknown" else 2.8))
        return samples_of(key)

    monkeypatch.setattr("lensmodel.blind.sampling.samples_of_photo", estimated)
    paths = [tmp_path / "a.dng", tmp_path / "b.dng"]
    for path in paths:
        path.write_bytes(path.name.encode())
    return paths


class Noting(LensStore):
    """Notes how many samples a lens has whenever it is kept."""

    def __init__(self, lens: Lens | None = None) -> None:
        super().__init__(lens)
        self.kept: list[int] = []

    def keep(self, lens: Lens) -> None:
        super().keep(lens)
        self.kept.append(len(lens.samples))


def test_a_lens_is_kept_after_each_photo_and_what_another_run_added_meanwhile_stays(
    photos: list[Path],
) -> None:
    store = Noting()
    events = Calibration(store, sampling.PRESETS["default"]).learn([*photos, photos[0]])

    first = next(events)
    kept = store.lens()
    assert kept is not None
    model = LensModel.fit([*kept.samples, *samples_of("x")])
    store.keep(replace(kept, model=model, photos={**kept.photos, "x": "x.dng"}))

    assert [(event.stage, event.total) for event in (first, *events)] == [
        ("counted", 9),
        ("counted", 9),
        ("skipped", 0),
    ]
    lens = store.lens()
    assert lens is not None
    assert sorted(lens.photos.values()) == ["a.dng", "b.dng", "x.dng"]
    assert store.kept == [9, 18, 27]


def test_nothing_is_kept_where_nothing_was_learned(photos: list[Path]) -> None:
    key = sampling.photo_id(photos[0])
    store = Noting(Lens(LensModel.fit(samples_of(key)), {}, {key: "a.dng"}))
    calibration = Calibration(store, sampling.PRESETS["default"])

    (event,) = calibration.learn(photos[:1])

    assert (event.stage, event.error) == ("skipped", None)
    assert calibration.known is store.lens()
    assert store.kept == []


def test_photos_that_cannot_teach_a_lens_are_passed_over_with_the_reason(
    tmp_path: Path, photos: object
) -> None:
    paths = [tmp_path / "a-corrected.dng", tmp_path / "unknown.dng"]
    for path in paths:
        path.write_bytes(path.name.encode())
    calibration = Calibration(Noting(), sampling.PRESETS["default"])

    corrected, unknown = (event.error for event in calibration.learn(paths))

    assert isinstance(corrected, InvalidInputError)
    assert "give the original" in str(corrected)
    assert isinstance(unknown, MetadataMissingError)
    assert calibration.known is None


@dataclass(frozen=True)
class Round:
    """An estimator of kernels that needs no work."""

    name: str = "round"
    version: int = 1

    def estimate(
        self, patches: Sequence[Plane], noise: object, *, size: int, green: lensmodel.PsfEstimate | None
    ) -> lensmodel.PsfEstimate:
        return green or lensmodel.PsfEstimate(gaussian(size, np.eye(2)), 0.3)


def test_a_raw_file_is_opened_and_hashed_once_and_all_share_one_pool(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts: Counter[str] = Counter()

    class Raw(rawpy.RawPy):
        def open_file(self, path: str) -> None:
            counts["opened"] += 1
            super().open_file(path)

    class Pool(ThreadPoolExecutor):
        def __init__(self, count: int, **_: object) -> None:
            counts["pools"] += 1
            super().__init__(count)

    def hashed(file: BinaryIO, name: str) -> hashlib._Hash:
        counts["hashed"] += 1
        return hashlib.new(name, file.read())

    monkeypatch.setattr(rawpy, "RawPy", Raw)
    monkeypatch.setattr(processes, "ProcessPoolExecutor", Pool)
    monkeypatch.setattr(hashlib, "file_digest", hashed)
    blocks = np.random.default_rng(0).integers(700, 14000, (2, 110, 160))
    for name, squares in zip("ab", blocks, strict=True):
        mosaic = np.kron(squares, np.ones((7, 7))).astype(np.uint16)[:768, :1120]
        metadata = photo.PhotoMetadata(aperture=2.8)
        write_bayer_dng(tmp_path / f"{name}.dng", mosaic, black=512, white=15872, metadata=metadata)

    lens = lensmodel.calibrate(sorted(tmp_path.glob("*.dng")), estimator=Round(), kernel_size=15, patches=24)

    assert len(lens.photos) == 2
    assert counts == {"opened": 2, "hashed": 2, "pools": 1}


def test_a_calibration_that_is_cancelled_is_no_photo_that_failed(
    photos: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def cancelled(path: Path, config: sampling.Config, **options: object) -> list[PsfSample]:
        raise CancelledError("enough")

    monkeypatch.setattr("lensmodel.blind.sampling.samples_of_photo", cancelled)

    with pytest.raises(CancelledError, match="enough"):
        lensmodel.calibrate(photos)
