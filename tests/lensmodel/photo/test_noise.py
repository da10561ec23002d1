from __future__ import annotations

import io
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from lensmodel import photo
from lensmodel.core.types import NoiseModel
from lensmodel.photo.colour import curves_of, srgb_to_linear
from lensmodel.photo.containers import opened_header
from lensmodel.photo.noise import estimate_noise, graininess
from lensmodel.photo.writing import write_bayer_dng

BLACK, WHITE = 512, 15000


@lru_cache(maxsize=4)  # most tests photograph the same one
def scene(height: int, width: int, seed: int, blur: float = 1.0) -> NDArray[np.float64]:
    """Leaves of random grey one over the other, out to the pixel, then a lens of some blur."""
    rng = np.random.default_rng(seed)
    image = np.full((height, width), 0.3)
    for radius in np.sort(rng.pareto(1.5, 400) * 6 + 3)[::-1]:
        row, col = rng.uniform(0, height), rng.uniform(0, width)
        top, left = max(int(row - radius), 0), max(int(col - radius), 0)
        box = image[top : int(row + radius) + 2, left : int(col + radius) + 2]
        rows, cols = np.ogrid[top : top + box.shape[0], left : left + box.shape[1]]
        box[(rows - row) ** 2 + (cols - col) ** 2 < radius**2] = rng.uniform(0.03, 0.8)
    image += 0.03 * ndimage.gaussian_filter(rng.standard_normal((height, width)), 1.0)
    return np.clip(ndimage.gaussian_filter(image, blur), 0.02, 0.9)


def noisy(clean: NDArray[np.float64], model: NoiseModel, seed: int) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    return (clean + np.sqrt(model.variance(clean)) * rng.standard_normal(clean.shape)).astype(np.float32)


@pytest.mark.parametrize(("shot", "read"), [(1e-3, 1e-6), (1e-4, 1e-6), (2e-4, 1e-5), (0.0, 1e-4)])
def test_noise_is_recovered_to_15_percent_from_a_textured_scene(shot: float, read: float) -> None:
    truth = NoiseModel(shot, read)
    found = estimate_noise(noisy(scene(600, 800, seed=1), truth, seed=2))

    levels = np.array([0.05, 0.2, 0.5])
    assert found.variance(levels) == pytest.approx(truth.variance(levels), rel=0.15)


@pytest.mark.parametrize("shot", [5e-6, 2e-5, 5e-5])
def test_noise_below_the_steps_of_8_bits_is_recovered_to_10_percent(shot: float) -> None:
    steps = curves_of("srgb")[1][::257]
    light = noisy(scene(600, 800, seed=1), NoiseModel(shot, 1e-7), seed=2)
    numbers = np.rint(np.interp(light, steps, np.arange(256.0))).astype(np.intp)
    found = estimate_noise(steps[numbers].astype(np.float32), codes=steps)

    levels = np.array([0.05, 0.2, 0.5])
    # what rounding adds is noise of the file as well
    truth = shot * levels + 1e-7 + np.interp(levels, steps, np.gradient(steps)) ** 2 / 12
    assert found.variance(levels) == pytest.approx(truth, rel=0.1)


def test_saturated_areas_do_not_count() -> None:
    truth = NoiseModel(1e-3, 1e-6)
    plane = noisy(scene(600, 800, seed=1), truth, seed=2)
    plane[:300] = 1.0
    found = estimate_noise(plane)

    assert found.variance(np.array([0.3])) == pytest.approx(truth.variance(np.array([0.3])), rel=0.15)


def test_noise_of_a_float_file_is_told_whatever_its_white(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).normal(50.0, 1.0, (256, 256, 3)).astype(np.float32)
    tifffile.imwrite(tmp_path / "x.tif", pixels, photometric="rgb")

    developed = photo.develop(tmp_path / "x.tif")

    assert [model.variance(np.array(50.0)) for model in developed.noise] == pytest.approx([1.0] * 3, rel=0.1)
    assert developed.grain == pytest.approx((1.0,) * 3, rel=0.2)


def test_a_plane_without_noise_has_only_that_of_rounding() -> None:
    assert estimate_noise(np.zeros((5, 9), dtype=np.float32)) == NoiseModel(0.0, 0.0)
    assert estimate_noise(np.full((64, 64), 0.5, dtype=np.float32)) == NoiseModel(0.0, 0.0)
    assert estimate_noise(np.full((64, 64), 0.5, dtype=np.float32), step=0.01).read == pytest.approx(
        1e-4 / 12
    )


def test_a_large_plane_gives_the_same_model_from_a_part_of_its_rows() -> None:
    truth = NoiseModel(5e-4, 1e-4)
    ramp = np.linspace(0.02, 0.9, 1300)[None].repeat(2400, axis=0)  # so large that half of it is looked at
    found = estimate_noise(noisy(ramp, truth, seed=4))

    assert found.shot == pytest.approx(5e-4, rel=0.05)
    assert found.read == pytest.approx(1e-4, rel=0.15)


def test_the_noise_of_the_sensor_is_found_on_the_mosaic(tmp_path: Path) -> None:
    truth = NoiseModel(4e-4, 2e-6)
    mosaic = noisy(scene(700, 900, seed=5), truth, seed=6) * (WHITE - BLACK) + BLACK
    write_bayer_dng(tmp_path / "x.dng", np.rint(mosaic).astype(np.uint16), black=BLACK, white=WHITE)
    developed = photo.develop(tmp_path / "x.dng")

    levels = np.array([0.1, 0.3, 0.5])
    assert developed.sensor_noise is not None
    assert developed.correction_noise == developed.sensor_noise
    for found in developed.sensor_noise:
        assert found.variance(levels) == pytest.approx(truth.variance(levels), rel=0.15)


@pytest.mark.parametrize("share", [(1.0, 1.0, 1.0), (0.4, 1.0, 0.6)])
def test_the_noise_of_the_planes_is_what_demosaicing_leaves_of_it(
    share: tuple[float, float, float], tmp_path: Path
) -> None:
    neutral = np.array(share)  # a grey scene, perhaps on a sensor with weak red and blue
    colours = np.tile([[0, 1], [1, 2]], (256, 256))
    flat = noisy(0.4 * neutral[colours], NoiseModel(1e-3, 0.0), seed=8) * (WHITE - BLACK) + BLACK
    write_bayer_dng(
        tmp_path / "x.dng", np.rint(flat).astype(np.uint16), black=BLACK, white=WHITE, as_shot_neutral=neutral
    )
    developed = photo.develop(tmp_path / "x.dng")

    inside = developed.planes[:, 16:-16, 16:-16].astype(np.float64)
    for plane, model in zip(inside, developed.noise, strict=True):
        assert model.variance(plane.mean()) == pytest.approx(plane.var(), rel=0.1)


@pytest.mark.parametrize("width", [0.0, 0.5, 1.0])
def test_the_coarseness_of_correlated_noise_is_what_its_spectrum_says(width: float) -> None:
    white = np.random.default_rng(9).standard_normal((1024, 1024))
    plane = (0.3 + 0.01 * ndimage.gaussian_filter(white, width, mode="wrap")).astype(np.float32)

    # The power that each of the two high passes sees: of pixels, and of means over 4 x 4 of them.
    f = np.fft.fftfreq(1024)
    point = np.zeros(1024)
    point[0] = 1.0
    power = np.abs(np.fft.fft(ndimage.gaussian_filter(point, width, mode="wrap"))) ** 2
    box = np.abs(np.exp(-2j * np.pi * np.outer(f, np.arange(4))).mean(axis=1)) ** 2
    fine = (power * (2 - 2 * np.cos(2 * np.pi * f)) ** 2).mean()
    coarse = 4 * (power * box * (2 - 2 * np.cos(8 * np.pi * f)) ** 2).mean()
    expected = (coarse / fine) ** 2
    found = graininess(plane, estimate_noise(plane))

    assert found == pytest.approx(expected, rel=0.1)


def test_noise_that_denoising_left_coarse_counts_more_than_that_of_demosaicing(tmp_path: Path) -> None:
    rng = np.random.default_rng(10)
    noise = [ndimage.gaussian_filter(rng.standard_normal((400, 400, 3)), (s, s, 0)) for s in (0.0, 1.6)]
    ratios = []
    for grain in noise:
        numbers = np.rint(np.clip(30000 + 600 * grain / grain.std(), 0, 65535)).astype(np.uint16)
        tifffile.imwrite(tmp_path / "x.tif", numbers, photometric="rgb")
        developed = photo.develop(tmp_path / "x.tif")
        levels = np.array(0.2)
        ratios.append([developed.correction_noise[1].variance(levels) / developed.noise[1].variance(levels)])

    assert ratios[0] == pytest.approx([16.0])
    assert ratios[1] == pytest.approx([64.0])


# --- compression that loses something: lossy DNG beside JPEG ---------------------------------------

SIDE = 256


def smooth_scene(seed: int = 0) -> NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    fine = ndimage.gaussian_filter(rng.standard_normal((SIDE, SIDE)), 1.0)
    grey = np.clip(120 + 150 * fine, 5, 250).astype(np.uint8)
    return np.stack([grey] * 3, axis=-1)


def even_scene() -> NDArray[np.uint8]:
    """As much detail at all frequencies, far above the rounding of the coefficients."""
    light = np.clip(0.2 + 0.06 * np.random.default_rng(3).standard_normal((SIDE, SIDE)), 0.05, 0.5)
    levels = srgb_to_linear(np.arange(256) / 255)
    grey = np.rint(np.interp(light, levels, np.arange(256.0))).astype(np.uint8)
    return np.stack([grey] * 3, axis=-1)


def jpeg_tile(pixels: NDArray[np.uint8], quality: int) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=quality, subsampling=0)
    return buffer.getvalue()


def write_lossy_dng(path: Path, tile: bytes) -> None:
    """One tile of eight-bit LinearRaw, as a converter with lossy compression writes it."""
    matrix = (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1)
    tifffile.imwrite(
        path,
        iter([tile]),
        shape=(SIDE, SIDE, 3),
        dtype=np.uint8,
        photometric=34892,
        compression=34892,
        tile=(SIDE, SIDE),
        metadata=None,
        extratags=[
            (50706, "B", 4, (1, 4, 0, 0), True),
            (50708, "s", 0, "Made Up", True),
            (50721, "2i", 9, matrix, True),
            (50728, "2I", 3, (1, 1, 1, 1, 1, 1), True),
        ],
    )


@pytest.mark.parametrize("kind", ["dng", "jpeg"])
@pytest.mark.parametrize("quality", [92, 85, 75, 70])
@pytest.mark.parametrize(
    ("pixels", "least", "most"),
    [
        (smooth_scene(), 1 / 3, 1 / 0.3),  # of smooth detail fewer coefficients are left to be rounded
        (even_scene(), 0.3, 1.2),  # the middle step stands for all 64, of which some are twice as coarse
    ],
    ids=["smooth", "even"],
)
def test_the_noise_of_a_lossy_file_is_the_error_that_rounding_made(
    kind: str, quality: int, pixels: NDArray[np.uint8], least: float, most: float, tmp_path: Path
) -> None:
    planes = []
    for each in (100, quality):
        write = write_lossy_dng if kind == "dng" else Path.write_bytes
        write(tmp_path / "x", jpeg_tile(pixels, each))
        developed = photo.develop(tmp_path / "x")
        planes.append(developed.planes[1])
    coded = developed.coding_noise
    assert coded is not None
    assert (developed.info.kind, developed.lossy) == (kind, True)
    for noise in (*developed.correction_noise, *developed.coarse_noise):
        assert noise.variance(np.array(0.2)) >= 0.999 * coded.variance(np.array(0.2))
    error = float(np.square(planes[1] - planes[0]).mean())
    assert least < float(coded.variance(planes[0]).mean()) / error < most


@pytest.mark.parametrize(
    "tile", [b"\xff\xd8\xff\xdb\x00\x43\x00", b"no JPEG at all", b"\xff\xd8" + b"\xff" * 40]
)
def test_a_damaged_tile_of_a_lossy_dng_leaves_its_noise_unknown(tmp_path: Path, tile: bytes) -> None:
    write_lossy_dng(tmp_path / "x.dng", tile)
    with opened_header(tmp_path / "x.dng", photo.Limits()) as header:
        assert (header.kind, header.coarseness) == ("dng", 0.0)
