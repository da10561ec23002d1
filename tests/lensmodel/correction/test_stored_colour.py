from __future__ import annotations

import io
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from lab.images import to_srgb
from lab.kernels import gaussian
from lensmodel import correction, photo
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, Frame, Kernel, NoiseModel, Planes
from lensmodel.correction import StoredColour
from lensmodel.photo.colour import curves_of

LUMA = np.array([0.299, 0.587, 0.114])
CURVES = curves_of("srgb")


def luma_and_hue(planes: Planes) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    values = to_srgb(planes)
    luma = np.tensordot(LUMA, values, axes=1)
    return luma, values - luma


def grey(size: int = 48, seed: int = 0) -> Planes:
    return np.random.default_rng(seed).uniform(0.2, 0.5, (1, size, size)).repeat(3, axis=0).astype(np.float32)


def kept_of_the_finest(change: NDArray[np.floating]) -> NDArray[np.floating]:
    """1 - sin^6(pi f) along both axes, with periods of the picture's size; right away from its borders."""
    rows, cols = (1.0 - np.sin(np.pi * np.fft.fftfreq(side)) ** 6 for side in change.shape[-2:])
    return np.fft.ifft2(np.fft.fft2(change) * np.outer(rows, cols)).real


def test_a_coloured_pixel_keeps_its_luma_and_loses_its_colour() -> None:
    before = np.full((3, 32, 32), 0.3, dtype=np.float32)
    made = before.copy()
    made[0, 16, 16], made[2, 16, 16] = 0.5, 0.15
    held = StoredColour.of((2, 2), CURVES).held(before, made)

    (luma, hue), (wanted, dots) = luma_and_hue(held), luma_and_hue(made)
    first = luma_and_hue(before)[0]
    np.testing.assert_allclose(luma - first, kept_of_the_finest(wanted - first), atol=1e-4)
    assert np.abs(hue).max() < 0.15 * np.abs(dots).max()


def test_a_change_of_hue_over_a_wide_area_stays() -> None:
    before, made = grey(), grey()
    made[0] *= 1.2
    held = StoredColour.of((2, 2), CURVES).held(before, made)

    assert np.abs(luma_and_hue(held)[1] - luma_and_hue(made)[1]).max() < 0.02
    assert (luma_and_hue(held)[1] - luma_and_hue(before)[1])[0].mean() > 0.02


def test_detail_of_luma_stays_whatever_the_hue() -> None:
    before = grey()
    made = np.clip(before + 0.1 * (before - before.mean()), 0.0, 1.0)
    held = StoredColour.of((2, 2), CURVES).held(before, made)

    wanted = to_srgb(before) + kept_of_the_finest(to_srgb(made) - to_srgb(before))
    np.testing.assert_allclose(to_srgb(held)[:, 4:-4, 4:-4], wanted[:, 4:-4, 4:-4], atol=1e-4)


@pytest.mark.parametrize("step", [(1, 1), (1, 2), (2, 2)])
def test_a_comb_of_two_pixels_is_not_made_and_coarser_detail_is(step: tuple[int, int]) -> None:
    before = np.full((3, 64, 64), 0.3, dtype=np.float32)
    x = np.arange(64)
    for period, least, most in ((2, 0.0, 0.01), (4, 0.8, 0.9), (8, 0.99, 1.0)):
        made = before + np.float32(0.02) * np.cos(2 * np.pi * x / period).astype(np.float32)
        held = StoredColour.of(step, CURVES).held(before, made)
        left = (held - before)[:, 8:-8, 8:-8].std() / (made - before)[:, 8:-8, 8:-8].std()
        assert least - 0.01 <= left <= most + 0.01


def test_a_file_that_is_no_jpeg_is_left_to_the_correction(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    for name, is_jpeg in (("x.jpg", True), ("x.png", False)):
        Image.fromarray(pixels).save(tmp_path / name)
        assert (StoredColour.of_photo(photo.develop(tmp_path / name)) is not None) == is_jpeg


@pytest.mark.parametrize(("subsampling", "step"), [(0, (1, 1)), (1, (1, 2)), (2, (2, 2)), (None, (1, 1))])
def test_the_header_says_which_pixels_share_chroma(
    tmp_path: Path, subsampling: int | None, step: tuple[int, int]
) -> None:
    path = tmp_path / "photo.jpg"
    pixels = np.random.default_rng(1).integers(0, 255, (64, 80, 3), dtype=np.uint8)
    Image.fromarray(pixels if subsampling is not None else pixels[:, :, 0]).save(
        path, subsampling=subsampling or 0
    )
    developed = photo.develop(path)

    assert developed.chroma_step == step
    stored = StoredColour.of_photo(developed)
    assert stored is not None
    assert stored.step == step


def test_what_is_shown_of_chroma_is_what_a_file_shows_of_it() -> None:
    """A red line on grey, written and read by another program, at every place in its cell."""
    through = []
    for shift in (0, 1):
        pixels = np.full((64, 64, 3), 120, dtype=np.uint8)
        pixels[:, 32 + shift] = 170, 110, 100
        buffer = io.BytesIO()
        Image.fromarray(pixels).save(buffer, "JPEG", quality=100, subsampling=2)
        read = np.asarray(Image.open(buffer), dtype=np.float64)[32, :, 0]
        luma = np.asarray(Image.open(buffer).convert("YCbCr"), dtype=np.float64)[32, :, 0]
        through.append(np.roll(read - luma, -shift))
    line = np.zeros((1, 64, 64), dtype=np.float32)
    line[0, :, 32] = 170.0 - LUMA @ (170.0, 110.0, 100.0)
    shown = StoredColour.of((2, 2), CURVES).shown(line)[0, 32]

    np.testing.assert_allclose(shown, np.mean(through, axis=0), atol=2.0)


class Soft:
    """One kernel for the whole field, red wider than green."""

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        return gaussian(size, {"r": 1.3, "g": 0.9, "b": 1.1}[channel] ** 2 * np.eye(2))


def test_a_part_is_the_same_as_in_the_whole_and_luma_gains() -> None:
    rng = np.random.default_rng(2)
    tiles = rng.uniform(0.1, 0.6, (3, 20, 22)).repeat(6, axis=1).repeat(6, axis=2)
    blurred = [
        ndimage.convolve(plane, Soft().kernel_at(FieldPosition(0.5, 0.0), channel, 9), mode="nearest")
        for plane, channel in zip(tiles, CHANNELS, strict=True)
    ]
    planes = (np.stack(blurred) + 0.004 * rng.standard_normal(tiles.shape)).astype(np.float32)
    correct = partial(
        correction.correct_planes, planes, Soft(), Frame(120, 132), noise=[NoiseModel(0.0, 1.6e-5)] * 3
    )
    stored = StoredColour.of((2, 2), CURVES)
    whole, free = correct(stored=stored).planes, correct().planes
    part = correct(stored=stored, roi=(20, 30, 60, 70)).planes

    np.testing.assert_array_equal(part, whole[:, 20:80, 30:100])
    change = [luma_and_hue(made)[1] - luma_and_hue(planes)[1] for made in (whole, free)]
    fine = [np.diff(hue, n=2, axis=2).std() for hue in change]
    assert 0.0 < fine[0] < 0.5 * fine[1]
    luma = [np.abs(luma_and_hue(made)[0] - luma_and_hue(tiles)[0]).mean() for made in (planes, whole)]
    assert luma[1] < 0.9 * luma[0]


@pytest.mark.parametrize("step", [(0, 2), (3, 1)])
def test_steps_that_no_file_has_are_refused(step: tuple[int, int]) -> None:
    with pytest.raises(InvalidInputError):
        StoredColour.of(step, CURVES)
