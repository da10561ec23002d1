"""Grain of a mosaic that a prior took for noise."""

import numpy as np
import pytest
from scipy import ndimage

from lensmodel.core.psf import gaussian
from lensmodel.core.types import NoiseModel, Planes
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.tiles.texture import SHARE, texture_kept

SIZE = 96
LIGHT = np.array([0.15, 0.4, 0.2], dtype=np.float32)[:, None, None]
NOISE = NoiseModel(1 / 2_500, 9e-6)
BLURS = [UniformBlur(gaussian(15, np.eye(2) * 1.5**2))] * 3


def photo() -> tuple[Planes, list[Sensor]]:
    """Even light on a mosaic, what was not measured the mean of neighbours."""
    rng = np.random.default_rng(0)
    sites = np.tile(((0, 1), (1, 2)), (SIZE // 2, SIZE // 2))
    between = np.outer([1.0, 2.0, 1.0], [1.0, 2.0, 1.0])
    planes, sensors = [], []
    for c, light in enumerate(LIGHT[:, 0, 0]):
        known = sites == c
        values = light + np.sqrt(NOISE.variance(np.array(light))) * rng.standard_normal((SIZE, SIZE))
        mean = ndimage.convolve(known * values, between) / ndimage.convolve(known.astype(float), between)
        planes.append(np.where(known, values, mean))
        sensors.append(Sensor(NOISE, measured=known))
    return np.array(planes, dtype=np.float32), sensors


def power(planes: np.ndarray) -> np.ndarray:
    """Mean power density up to .15, .3 and .5 cycles/pixel, inside, of `(n, row, col)`."""
    inside = planes[:, 12:-12, 12:-12]
    inside = inside - inside.mean(axis=(1, 2), keepdims=True)
    spectrum = np.square(np.abs(np.fft.fft2(inside))).mean(axis=0)
    f = np.fft.fftfreq(inside.shape[1])
    radius = np.hypot(f[:, None], f[None, :])
    bands = ((0.06, 0.15), (0.15, 0.3), (0.3, 0.5))
    return np.array([spectrum[(radius >= low) & (radius < high)].mean() for low, high in bands])


def colours(planes: Planes) -> np.ndarray:
    """Differences of colours."""
    return np.stack([planes[0] - planes[1], planes[2] - planes[1]])


def test_grain_that_was_erased_comes_back_as_light_of_no_colour() -> None:
    seen, sensors = photo()
    flat = np.broadcast_to(LIGHT, seen.shape).astype(np.float32)

    kept = texture_kept(seen, flat, BLURS, sensors)

    green = power(kept[1:2]) / power(seen[1:2])
    assert np.all(green[:2] > 0.6)
    assert np.all(green[:2] < 0.75)  # three quarters at most, as `SHARE` says
    assert 0.75 < green[2] < 1.25  # finer than the photo's, whose means of neighbours have none so fine
    assert np.all(power(colours(kept)) < 0.5 * power(colours(seen)))


def test_less_texture_is_less_grain() -> None:
    seen, sensors = photo()
    flat = np.broadcast_to(LIGHT, seen.shape).astype(np.float32)

    whole, half = (texture_kept(seen, flat, BLURS, sensors, texture=share) for share in (1.0, 0.5))

    np.testing.assert_allclose(power(half) / power(whole), 0.25, rtol=0.05)
    assert texture_kept(seen, flat, BLURS, sensors, texture=0.0) is flat


def test_coloured_edge_does_not_show_the_mosaic() -> None:
    seen, sensors = photo()
    red = seen.copy()
    red[0, :, 40:] += 0.3  # far beyond the noise, in one colour, and demosaiced with an error of one pixel
    red[0, 1::2, 41] -= 0.15
    flat = np.broadcast_to(LIGHT, seen.shape).astype(np.float32)

    kept = texture_kept(red, flat, BLURS, sensors)[0, 12:-12]

    even, odd = kept[0::2, 41].mean(), kept[1::2, 41].mean()
    assert abs(even - odd) < 3.5 * np.sqrt(NOISE.variance(np.array(LIGHT[0, 0, 0] + 0.3)))
    assert even == pytest.approx(float(LIGHT[0, 0, 0]) + SHARE * 0.3, abs=0.15)
