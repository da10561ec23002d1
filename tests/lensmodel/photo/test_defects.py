"""Defective pixels are found and replaced before anything is measured; points of light and texture stay."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from lab.images import gains, to_srgb
from lensmodel import calibrate, correct, photo, simulate
from lensmodel.core.errors import RawDecodeError, UnsupportedFormatError
from lensmodel.core.types import LensSettings, Zone
from lensmodel.photo.containers import BYTE, SHORT, write_strip
from lensmodel.photo.mosaic import replace_defects
from lensmodel.photo.writing import dng_tags, write_bayer_dng

CAMERA = simulate.SimulatedCamera(height=400, width=600)
RANGE = CAMERA.white - CAMERA.black
UNSEEN = 0.0123
"""Root mean square that 110 of them do to the planes where nothing is replaced."""

BAYER = ["RG", "GB"]
XTRANS = ["GBGGRG", "RGRBGB", "GBGGRG", "GRGGBG", "BGBRGR", "GRGGBG"]
SCENES = ["spices", "city", "colosseum", "lake", "tea-gardens"]


def colours_of(cell: list[str], shape: tuple[int, int] = (400, 600)) -> NDArray[np.uint8]:
    numbers = np.array([["RGB".index(letter) for letter in row] for row in cell], dtype=np.uint8)
    return np.tile(numbers, [-(-side // len(cell)) for side in shape])[: shape[0], : shape[1]]


@cache
def mosaic(scene: str = "spices", *, xtrans: bool = False, height: int = 400) -> NDArray[np.uint16]:
    """What a sensor sees of a scene through a sharp lens."""
    light = simulate.demo_scene(scene)[:, 100 : 100 + height, 200:800]
    light = ndimage.gaussian_filter(light, (0, 0.8, 0.8))
    filters = colours_of(XTRANS if xtrans else BAYER, (height, 600)).astype(np.intp)
    seen = np.take_along_axis(light / np.reshape(CAMERA.white_balance, (3, 1, 1)), filters[None], axis=0)[0]
    noise = np.sqrt(CAMERA.noise.variance(seen)) * np.random.default_rng(4).standard_normal(seen.shape)
    return np.clip(CAMERA.black + RANGE * (seen + noise), 0, CAMERA.white).astype(np.uint16)


def defective(clean: NDArray[np.uint16], at: NDArray[np.int64]) -> NDArray[np.uint16]:
    """Let pixels shine by a tenth to all of the range."""
    rng = np.random.default_rng(1)
    values = clean.copy().ravel()
    values[at] = np.minimum(values[at] + rng.uniform(0.1, 1.0, len(at)) * RANGE, CAMERA.white)
    return values.reshape(clean.shape)


def write(path: Path, values: NDArray[np.uint16]) -> Path:
    write_bayer_dng(path, values, black=CAMERA.black, white=CAMERA.white, pattern=CAMERA.pattern)
    return path


def write_xtrans(path: Path, values: NDArray[np.uint16]) -> Path:
    tags = {
        **dng_tags(photo.PhotoMetadata(camera_model="X-1"), np.eye(3), (0.5, 1.0, 0.5), None),
        262: (SHORT, 32803),
        33421: (SHORT, (6, 6)),
        33422: (BYTE, bytes("RGB".index(letter) for letter in "".join(XTRANS))),
        50714: (SHORT, CAMERA.black),
        50717: (SHORT, CAMERA.white),
    }
    with path.open("wb") as file:
        write_strip(file, tags, values)
    return path


@pytest.mark.parametrize(("count", "xtrans"), [(11, False), (110, False), (110, True)])
def test_defects_are_replaced_and_told(
    count: int, xtrans: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    # 11 and 110 are as 60 and 600 of 1.3 million
    save, height = (write_xtrans, 600) if xtrans else (write, 400)
    seen = mosaic(xtrans=xtrans, height=height)
    hot = np.random.default_rng(0).permutation(400 * 600)[:count]
    clean = photo.develop(save(tmp_path / "clean.dng", seen))
    repaired = photo.develop(save(tmp_path / "hot.dng", defective(seen, hot)))

    assert clean.remarks == ()
    assert (clean.cfa is None) == xtrans
    assert f"hot.dng: {repaired.remarks[0]}" in caplog.text
    assert repaired.noise[1].variance(0.3) == pytest.approx(clean.noise[1].variance(0.3), rel=0.05)
    assert 0.4 * count <= int(repaired.remarks[0].split()[0]) <= count
    damage = np.sqrt(np.mean((repaired.planes - clean.planes) ** 2))
    assert damage < 0.6 * UNSEEN * np.sqrt(count / 110)


@pytest.mark.parametrize("xtrans", [False, True])
@pytest.mark.parametrize("scene", SCENES)
def test_a_picture_without_defects_has_none(scene: str, xtrans: bool) -> None:
    values = mosaic(scene, xtrans=xtrans).copy()

    assert replace_defects(values, colours_of(XTRANS if xtrans else BAYER), 6 if xtrans else 2) == 0


def test_the_fine_detail_of_an_xtrans_photo_is_no_damage(tmp_path: Path) -> None:
    fine = mosaic("tea-gardens", xtrans=True, height=600).astype(np.float64)
    bright = np.uint16(np.clip(CAMERA.black + 1.6 * (fine - CAMERA.black), 0, CAMERA.white))
    noise = np.random.default_rng(0).integers(CAMERA.black, CAMERA.white, bright.shape).astype(np.uint16)

    assert photo.develop(write_xtrans(tmp_path / "fine.dng", bright)).cfa is None
    with pytest.raises(RawDecodeError, match="random numbers"):
        photo.develop(write_xtrans(tmp_path / "noise.dng", noise))
    with pytest.raises(UnsupportedFormatError, match="600 x 400 pixels of an X-Trans mosaic are too few"):
        photo.develop(write_xtrans(tmp_path / "small.dng", bright[:400]))


@pytest.mark.slow
@pytest.mark.parametrize("xtrans", [False, True])
def test_defects_cost_the_whole_chain_nothing(xtrans: bool, tmp_path: Path) -> None:
    camera = simulate.SimulatedCamera(height=576, width=720, full_well_electrons=20_000.0)
    lens = simulate.draw_lens(1001)
    settings = LensSettings(aperture=lens.at_focal().f_number)
    filters = colours_of(XTRANS if xtrans else BAYER, (576, 720)).astype(np.intp)[None]
    balance = np.reshape(camera.white_balance, (3, 1, 1))
    shots = [
        simulate.photograph(simulate.demo_scene(scene)[:, 40:680, 100:884], lens, settings, camera, None)
        for scene in ("city", "tea-gardens", "colosseum")
    ]
    truth = np.moveaxis(to_srgb(shots[-1].sharp * balance), 0, -1)
    gained: dict[int, dict[Zone, float]] = {}
    for count in (0, 16, 160):  # as none, 60 and 600 of 1.3 million
        paths = []
        for number, shot in enumerate(shots):
            light = np.maximum(np.take_along_axis(shot.clean, filters, axis=0)[0], 0.0)
            rng = np.random.default_rng(number)
            light = light + np.sqrt(camera.noise.variance(light)) * rng.standard_normal(light.shape)
            seen = np.clip(CAMERA.black + RANGE * light, 0, CAMERA.white).astype(np.uint16)
            hot = np.random.default_rng(0).permutation(seen.size)[:count]
            save = write_xtrans if xtrans else write
            paths.append(save(tmp_path / f"{count}-{number}.dng", defective(seen, hot)))
        known = calibrate(paths[:2], aperture=settings.aperture, workers=1)
        developed = photo.develop(paths[2])
        corrected = correct(developed, known, aperture=settings.aperture, workers=1)
        before, after = (
            np.moveaxis(to_srgb(planes * balance), 0, -1) for planes in (developed.planes, corrected.planes)
        )
        found = gains(before, after, truth)
        assert found is not None
        gained[count] = found.zones

    for zone, clean in gained[0].items():
        assert clean > 0.3
        assert gained[16][zone] > clean - 0.1
        assert gained[160][zone] > clean - 0.3


@pytest.mark.parametrize("sigma_px", [0.5, 0.7, 1.0])
@pytest.mark.parametrize("colour", [(1.0, 1.0, 1.0), (1.0, 0.6, 0.3), (0.5, 0.7, 1.0)])
@pytest.mark.parametrize("xtrans", [False, True])
def test_points_of_light_behind_the_sharpest_lenses_are_no_defects(
    sigma_px: float, colour: tuple[float, ...], xtrans: bool
) -> None:
    rng = np.random.default_rng(1)
    fine = np.zeros((200 * 5, 300 * 5))
    rows, cols = rng.integers(40, 960, 150), rng.integers(40, 1460, 150)
    fine[rows, cols] = 25 * rng.uniform(0.5, 3.0, 150)
    light = ndimage.uniform_filter(ndimage.gaussian_filter(fine, 5 * sigma_px), 5)[2::5, 2::5]
    filters = colours_of(XTRANS if xtrans else BAYER, (200, 300))
    seen = 0.02 + 0.9 * light * np.take(np.array(colour) / np.array([2.0, 1.0, 1.6]), filters)
    noisy = seen + rng.normal(0.0, 0.002, seen.shape)
    values = np.clip(CAMERA.black + RANGE * noisy, 0, CAMERA.white).astype(np.uint16)

    assert replace_defects(values, filters, 6 if xtrans else 2) == 0


@pytest.mark.parametrize("dead", [True, False])
@pytest.mark.parametrize("cell", [BAYER, XTRANS])
@pytest.mark.parametrize("where", [(0, 0), (0, 299), (1, 1), (199, 0), (198, 299), (100, 299)])
def test_hot_and_dead_pixels_at_the_rim_are_found_too(
    where: tuple[int, int], cell: list[str], dead: bool
) -> None:
    rng = np.random.default_rng(2)
    values = np.rint(3000 + 20 * rng.standard_normal((200, 300))).astype(np.uint16)
    values[where] = 512 if dead else 9000
    before = values.copy()

    assert replace_defects(values, colours_of(cell, (200, 300)), len(cell)) == 1
    assert np.argwhere(values != before).tolist() == [[*where]]


def test_what_covers_the_picture_is_the_picture() -> None:
    values = np.rint(3000 + 20 * np.random.default_rng(2).standard_normal((200, 300))).astype(np.uint16)
    values[4::16, 4::16] = 9000

    assert replace_defects(values, colours_of(BAYER, (200, 300)), 2) == 0
