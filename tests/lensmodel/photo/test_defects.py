"""Defective pixels are found and replaced before anything is measured; points of light and texture stay."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel import photo, simulate
from lensmodel.photo.defects import find_defects
from lensmodel.photo.dng import write_bayer_dng

CAMERA = simulate.SimulatedCamera(height=400, width=600)
RANGE = CAMERA.white - CAMERA.black
UNSEEN = 0.0123
"""Root mean square that 110 of them do to the planes where nothing is replaced."""


@cache
def mosaic(scene: str = "spices") -> NDArray[np.uint16]:
    """What a sensor sees of a scene through a sharp lens."""
    light = simulate.demo_scene(scene)[:, 200:600, 200:800]
    light = ndimage.gaussian_filter(light, (0, 0.8, 0.8))
    filters = np.tile([[0, 1], [1, 2]], (light.shape[1] // 2, light.shape[2] // 2))
    seen = np.take_along_axis(light / np.reshape(CAMERA.white_balance, (3, 1, 1)), filters[None], axis=0)[0]
    noise = np.sqrt(CAMERA.noise.variance(seen)) * np.random.default_rng(4).standard_normal(seen.shape)
    return np.clip(CAMERA.black + RANGE * (seen + noise), 0, CAMERA.white).astype(np.uint16)


def defective(clean: NDArray[np.uint16], count: int) -> NDArray[np.uint16]:
    """Let so many pixels shine by a tenth to all of the range."""
    rng = np.random.default_rng(0)
    at = rng.permutation(clean.size)[:count]
    values = clean.copy().ravel()
    values[at] = np.minimum(values[at] + rng.uniform(0.1, 1.0, count) * RANGE, CAMERA.white).astype(np.uint16)
    return values.reshape(clean.shape)


def developed(path: Path, values: NDArray[np.uint16]) -> photo.LinearPhoto:
    write_bayer_dng(path, values, black=CAMERA.black, white=CAMERA.white, pattern=CAMERA.pattern)
    return photo.develop(path)


@pytest.mark.parametrize("count", [11, 110])  # as 60 and 600 of 1.3 million
def test_defects_are_replaced_counted_and_told(
    count: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    clean = developed(tmp_path / "clean.dng", mosaic())
    repaired = developed(tmp_path / "hot.dng", defective(mosaic(), count))

    assert clean.remarks == ()
    (told,) = repaired.remarks
    assert 0.72 * count <= int(told.split()[0]) <= count
    assert f"hot.dng: {told}" in caplog.text
    damage = np.sqrt(np.mean((repaired.planes - clean.planes) ** 2))
    assert damage < 0.45 * UNSEEN * np.sqrt(count / 110)
    assert repaired.noise[1].variance(0.3) == pytest.approx(clean.noise[1].variance(0.3), rel=0.05)


@pytest.mark.parametrize("scene", ["spices", "city", "colosseum"])
def test_a_picture_without_defects_has_none(scene: str, tmp_path: Path) -> None:
    assert developed(tmp_path / "x.dng", mosaic(scene)).remarks == ()


@pytest.mark.parametrize("sigma_px", [0.5, 0.7, 1.0])
@pytest.mark.parametrize("colour", [(1.0, 1.0, 1.0), (1.0, 0.6, 0.3), (0.5, 0.7, 1.0)])
def test_points_of_light_behind_the_sharpest_lenses_are_no_defects(
    sigma_px: float, colour: tuple[float, ...]
) -> None:
    rng = np.random.default_rng(1)
    fine = np.zeros((200 * 5, 300 * 5))
    rows, cols = rng.integers(40, 960, 150), rng.integers(40, 1460, 150)
    fine[rows, cols] = 25 * rng.uniform(0.5, 3.0, 150)
    light = ndimage.uniform_filter(ndimage.gaussian_filter(fine, 5 * sigma_px), 5)[2::5, 2::5]
    filters = np.tile([[0, 1], [1, 2]], (100, 150))
    seen = 0.02 + 0.9 * light * np.take(np.array(colour) / np.array([2.0, 1.0, 1.6]), filters)
    noisy = seen + rng.normal(0.0, 0.002, seen.shape)
    values = np.clip(CAMERA.black + RANGE * noisy, 0, CAMERA.white).astype(np.uint16)

    found = find_defects(values, np.full((2, 2, 65), 0.002 * RANGE))

    assert len(found[0]) == 0


@pytest.mark.parametrize("dead", [True, False])
@pytest.mark.parametrize("where", [(0, 0), (0, 299), (1, 1), (199, 0), (198, 299), (100, 299)])
def test_hot_and_dead_pixels_at_the_rim_are_found_too(where: tuple[int, int], dead: bool) -> None:
    rng = np.random.default_rng(2)
    values = np.rint(3000 + 20 * rng.standard_normal((200, 300))).astype(np.uint16)
    values[where] = 512 if dead else 9000

    rows, cols = find_defects(values, np.full((2, 2, 65), 20.0))

    assert [(int(r), int(c)) for r, c in zip(rows, cols, strict=True)] == [where]


def test_what_covers_the_picture_is_the_picture() -> None:
    values = np.rint(3000 + 20 * np.random.default_rng(2).standard_normal((200, 300))).astype(np.uint16)
    values[4::16, 4::16] = 9000

    assert len(find_defects(values, np.full((2, 2, 65), 20.0))[0]) == 0
