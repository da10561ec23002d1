"""Samples of whole photos: windows all over the frame, statistics, tokens and kernels of single patches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lensmodel import blind
from lensmodel.blind.learned import LearnedEstimator
from lensmodel.core.errors import NoUsablePatchesError
from lensmodel.core.types import CHANNELS, Frame, LensSettings, NoiseModel
from lensmodel.patches.select import spread_evenly
from lensmodel.photo import Encoding, LinearPhoto, PhotoInfo
from lensmodel.simulate import demo_scene

RGGB = ((0, 1), (1, 2))


def shot(height: int = 640, width: int = 896, **changed: object) -> LinearPhoto:
    """A sharp scene as a photo with a mosaic."""
    planes = np.ascontiguousarray(0.5 * demo_scene("city")[:, 100 : 100 + height, 200 : 200 + width])
    noise = (NoiseModel(1e-4, 1e-6),) * 3
    developed = LinearPhoto(
        planes.astype(np.float32),
        Frame(height, width),
        noise,
        (1.0, 1.0, 1.0),
        PhotoInfo("dng", width, height),
        Encoding(),
        sensor_noise=noise,
        cfa=RGGB,
    )
    return replace(developed, **changed)  # type: ignore[arg-type] # fields of the photo


def test_windows_lie_all_over_the_frame_and_on_the_mosaic() -> None:
    chosen = spread_evenly(shot(), count=24, size=128).patches

    assert 16 <= len(chosen) <= 24
    assert len({(p.row, p.col) for p in chosen}) == len(chosen)
    assert all(p.row % 2 == p.col % 2 == 0 for p in chosen)
    assert all(0 <= p.row <= 512 and 0 <= p.col <= 768 for p in chosen)
    assert {(p.row > 256, p.col > 384) for p in chosen} == {
        (a, b) for a in (True, False) for b in (True, False)
    }
    assert spread_evenly(shot(), count=24, size=128).patches == chosen


def test_flat_and_clipped_windows_are_left_out_with_the_reason() -> None:
    planes = shot().planes.copy()
    planes[:, :, :320] = 0.3
    planes[:, 320:, 600:] = 1.0

    found = spread_evenly(shot(planes=planes), count=35, size=128)

    assert found.patches
    assert all(p.col + 128 > 320 and (p.row < 320 or p.col + 64 < 600) for p in found.patches)
    assert {r.reason for r in found.rejected} == {"flat", "clipped"}


def test_a_photo_smaller_than_a_window_is_refused() -> None:
    with pytest.raises(NoUsablePatchesError, match="full size"):
        spread_evenly(shot(100, 400), count=24, size=128)


def test_a_photo_becomes_three_samples_of_each_window_with_what_it_encodes() -> None:
    developed, method = shot(), LearnedEstimator()
    patches = method.select(developed, count=6).patches

    samples = method.samples(developed, patches, settings=LensSettings(2.8), photo="a", size=31)

    assert [s.settings.channel for s in samples] == list(CHANNELS) * len(patches)
    assert {s.position for s in samples} == {p.position for p in patches}
    for sample in samples:
        assert sample.encoded is not None
        assert len(sample.encoded.to_bytes()) <= 4096
        assert sample.estimator == f"default/{method.version}"
        assert sample.kernel.shape[0] <= 31
        assert 0.0 < (sample.error or 0.0) <= 1.0
    assert samples[0].encoded is samples[1].encoded


def test_files_are_told_apart_by_how_their_pixels_were_made() -> None:
    method = LearnedEstimator()
    kinds = {}
    for kind, cfa in (("dng", RGGB), ("dng", None), ("tiff", None), ("jpeg", None)):
        developed = shot(info=PhotoInfo(kind, 896, 640), cfa=cfa)  # type: ignore[arg-type] # kinds of files
        patches = method.select(developed, count=2).patches
        encoded = method.samples(developed, patches, settings=LensSettings(2.8), photo="", size=31)[0].encoded
        assert encoded is not None
        kinds[kind, cfa is None] = encoded.kind

    assert list(kinds.values()) == ["raw", "tiff", "tiff", "jpeg"]


def test_it_reads_whole_photos_and_others_do_not() -> None:
    assert isinstance(blind.estimators.create("default"), blind.PhotoEstimator)
    assert not isinstance(blind.estimators.create("michaeli-irani"), blind.PhotoEstimator)
