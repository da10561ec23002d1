from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from lab.blind.steps import pyramid
from lab.blind.steps.pyramid import RATIO, Image, Level, View, coarse_to_fine, odd, resample, rescaled
from lab.kernels import gaussian
from lensmodel.core.psf import centroid, second_moments
from lensmodel.core.types import Kernel, NoiseModel


def picture(height: int = 60, width: int = 48) -> Image:
    rng = np.random.default_rng(0)
    return signal.convolve(rng.normal(size=(height + 8, width + 8)), gaussian(9, 2.0 * np.eye(2)), "valid")


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_resampling_commutes_with_turns(turns: int) -> None:
    y = picture()
    shape = (43, 34)
    turned = resample(np.rot90(y, turns), shape if turns % 2 == 0 else shape[::-1])

    assert np.allclose(turned, np.rot90(resample(y, shape), turns))


def test_stripes_finer_than_the_coarse_grid_do_not_alias() -> None:
    stripes = np.broadcast_to(np.cos(2 * np.pi * 0.45 * np.arange(120)), (120, 120))

    # Mirroring breaks the stripes at the border.
    assert np.abs(resample(stripes, (60, 60))[:, 3:-3]).max() < 0.02


def test_noise_gain_is_what_white_noise_keeps() -> None:
    white = np.random.default_rng(1).normal(size=(300, 300))

    assert resample(white, (212, 212)).std() == pytest.approx(
        pyramid.noise_gain((300, 300), (212, 212)), rel=0.02
    )


def test_affine_change_of_values_changes_no_view() -> None:
    y = (0.3 + 0.05 * picture()).astype(np.float32)
    first = View.of(y, NoiseModel.white(0.01))
    second = View.of((0.5 * y + 0.1).astype(np.float32), NoiseModel.white(0.005))

    assert np.allclose(first.y, second.y, atol=1e-5)
    assert first.noise == pytest.approx(second.noise, rel=1e-4)


def test_rescaled_kernels_keep_their_centre_and_scale_their_moments() -> None:
    kernel = gaussian(31, [[9.0, 2.0], [2.0, 4.0]])

    half = rescaled(kernel, RATIO, 23)
    double = rescaled(kernel, 1.0 / RATIO, 45)

    assert np.allclose(centroid(half), 0.0, atol=1e-9)
    assert np.allclose(second_moments(half, 0.0) * 2.0, second_moments(kernel, 0.0), atol=0.6)
    assert np.allclose(second_moments(double, 0.0) / 2.0, second_moments(kernel, 0.0), atol=0.3)


def test_every_level_gets_shapes_that_fit_together() -> None:
    levels: list[Level] = []

    def look(level: Level, kernel: Kernel, latent: Image) -> tuple[Kernel, Image]:
        assert kernel.shape == (level.side, level.side)
        assert latent.shape == level.view.y.shape
        levels.append(level)
        return kernel, latent

    found = coarse_to_fine(View(picture(96, 80), 0.01), look, 15, start=gaussian(15, np.eye(2)))

    sides = pyramid.kernel_sides(15, 80)
    assert sides == tuple(odd(15 * RATIO**i) for i in range(len(sides)))
    assert sides[-1] >= 5 > odd(15 * RATIO ** len(sides))
    assert [level.side for level in levels] == [*reversed(sides)]
    assert found.shape == (15, 15)
    assert all(level.view.noise <= 0.01 for level in levels)
