from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import special

from lensmodel import photo
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import LensSettings, Planes
from lensmodel.lab.camera_jpeg import CAMERA_JPEGS, CameraJpeg
from lensmodel.photo.noise import estimate_noise
from lensmodel.simulate import BlurOptions, SimulatedCamera, SimulatedPhoto, Truth, draw_lens

CAMERA = SimulatedCamera(height=96, width=128, full_well_electrons=4000.0)
PLAIN = CameraJpeg(amount=0.0, denoise=0.0, contrast=0.0, subsampling="4:4:4", quality=100)


def grey(rng: np.random.Generator | None, level: float = 0.3) -> np.ndarray:
    light = CAMERA.balanced(np.full((3, CAMERA.height, CAMERA.width), level, dtype=np.float32))
    return CAMERA.mosaic(light, rng)


def waves(period: float) -> Planes:
    """Grey light that swings along the columns, as the sensor sees it."""
    cols = np.arange(CAMERA.width)
    light = 0.3 + 0.15 * np.sin(2 * np.pi * cols / period)
    return CAMERA.balanced(np.broadcast_to(light, (3, CAMERA.height, CAMERA.width)).astype(np.float32))


def test_without_noise_the_picture_is_what_the_chain_renders_of_the_light() -> None:
    light = waves(24.0)
    chain = CameraJpeg(denoise=0.0)
    seen = chain.picture(CAMERA.mosaic(light, None), CAMERA) / 255.0
    rendered = np.moveaxis(chain.rendered(light, CAMERA), 0, -1)

    inner = (slice(8, -8), slice(8, -8))
    assert np.abs(seen - rendered)[inner].max() < 2.0 / 255.0


def test_the_unsharp_mask_overshoots_an_edge_as_its_gaussian_says() -> None:
    light = np.full((3, CAMERA.height, CAMERA.width), 0.1, dtype=np.float32)
    light[:, :, 64:] = 0.4
    chain = CameraJpeg(radius=1.0, amount=0.8, denoise=0.0, contrast=0.0)
    values = chain.rendered(CAMERA.balanced(light), CAMERA)[1, 40]

    low, high = values[20], values[110]
    # of the step, its Gaussian has left this much on the other side half a pixel beyond it
    beyond = 0.8 * 0.5 * special.erfc(0.5 / np.sqrt(2.0))
    assert values[64] - high == pytest.approx(beyond * (high - low), rel=0.05)
    assert low - values[63] == pytest.approx(beyond * (high - low), rel=0.05)
    assert np.ptp(replace(chain, amount=0.0).rendered(CAMERA.balanced(light), CAMERA)[1, 40]) == (
        pytest.approx(high - low, rel=1e-3)
    )


def test_denoising_takes_the_fine_noise_and_leaves_more_of_the_coarse_one() -> None:
    mosaic = grey(np.random.default_rng(3))
    fine, coarse = [], []
    for chain in (PLAIN, replace(PLAIN, denoise=1.0)):
        green = chain.picture(mosaic, CAMERA)[:, :, 1].astype(np.float32)
        fine.append(np.diff(green, axis=1).std())
        coarse.append(green.reshape(12, 8, 16, 8).mean(axis=(1, 3)).std())

    assert fine[1] < 0.5 * fine[0]
    assert coarse[1] / coarse[0] > 1.5 * fine[1] / fine[0]


def test_chroma_at_half_resolution_cannot_show_single_columns_of_colour_and_luma_can() -> None:
    light = np.full((3, CAMERA.height, CAMERA.width), 0.3, dtype=np.float32)
    light[0, :, ::2], light[2, :, 1::2] = 0.5, 0.5
    chain = CameraJpeg(amount=0.0, denoise=0.0, contrast=0.0)
    full = replace(chain, subsampling="4:4:4").rendered(CAMERA.balanced(light), CAMERA)
    half = chain.rendered(CAMERA.balanced(light), CAMERA)

    inner = (slice(8, -8), slice(8, -8))
    hue = [(values[0] - values[2])[inner] for values in (full, half)]
    assert np.ptp(hue[0]) > 0.3
    assert np.ptp(hue[1]) < 1e-3
    luma = [np.tensordot([0.299, 0.587, 0.114], values, axes=1)[inner] for values in (full, half)]
    np.testing.assert_allclose(luma[0], luma[1], atol=1e-5)


@pytest.mark.parametrize("subsampling", ["4:4:4", "4:2:2", "4:2:0"])
def test_the_file_says_what_a_cameras_file_says(tmp_path: Path, subsampling: str) -> None:
    lens, path = draw_lens(900), tmp_path / "photo.jpg"
    settings = LensSettings(aperture=lens.at_focal().f_number)
    light = waves(24.0)  # what the lens makes of a scene is not asked here
    truth = Truth(lens, CAMERA, settings, "", 1.0, BlurOptions(), 0)
    taken = SimulatedPhoto(CAMERA.mosaic(light, None), light, light, light, truth)
    CameraJpeg(subsampling=subsampling).write(path, taken)
    developed = photo.develop(path)

    said = developed.info.metadata
    assert developed.info.kind == "jpeg"
    assert (said.camera_model, said.lens.model) == (CAMERA.model, lens.model)
    assert said.aperture == pytest.approx(settings.aperture, abs=0.01)
    assert developed.chroma_step == {"4:4:4": (1, 1), "4:2:2": (1, 2), "4:2:0": (2, 2)}[subsampling]
    assert developed.planes.shape == (3, CAMERA.height, CAMERA.width)


def test_every_kind_of_camera_makes_less_noise_than_its_sensor_has() -> None:
    mosaic = grey(np.random.default_rng(5))
    plain = PLAIN.picture(mosaic, CAMERA)[:, :, 1].astype(np.float32)
    for chain in CAMERA_JPEGS.values():
        noise = estimate_noise(chain.picture(mosaic, CAMERA)[:, :, 1] / np.float32(255.0))
        assert noise.read + noise.shot > 0.0
        quiet = replace(chain, amount=0.0).picture(mosaic, CAMERA)[:, :, 1].astype(np.float32)
        assert quiet.std() < plain.std() * (1.0 + chain.contrast)


@pytest.mark.parametrize(
    "wrong",
    [{"radius": 0.0}, {"amount": -1.0}, {"contrast": 2.0}, {"quality": 0}, {"subsampling": "4:1:0"}],
)
def test_a_chain_that_no_camera_has_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InvalidInputError):
        CameraJpeg(**wrong)
