from __future__ import annotations

import numpy as np
import pytest
from scipy.special import j1

from lab.population import kernels
from lab.population.kernels import TERMS, Renderer, basis, behind_sensor, kernels_of, scaled, spots
from lab.population.wavefronts import RandomLens
from lensmodel.neural.network import SIDE

OPEN = np.zeros((0, 3))
AT = np.arange(SIDE) - SIDE // 2


def one_term(n: int, m: int, value: float, *, sine: bool = False) -> np.ndarray:
    coefficients = np.zeros(kernels.COLUMNS)
    coefficients[2 * TERMS.index((n, m)) + sine] = value
    return coefficients


def test_a_perfect_lens_gives_airys_disc_on_pixels() -> None:
    f_number, pitch, wavelength = 8.0, 2.0, 0.55
    kernel = Renderer(f_number, pitch).kernel(np.zeros(kernels.COLUMNS), OPEN, wavelength)
    points = np.arange(-11 * SIDE // 2 + 1, 11 * SIDE // 2 + 1) / 11 * pitch
    radius = np.hypot(points[:, None], points[None]) * np.pi / (wavelength * f_number) + 1e-9
    airy = ((2 * j1(radius) / radius) ** 2).reshape(SIDE, 11, SIDE, 11).sum((1, 3))
    assert np.abs(kernel - airy / airy.sum()).max() < 0.01 * kernel.max()
    assert kernel.sum() == pytest.approx(1.0, abs=1e-5)


def test_light_goes_where_the_wavefront_slopes() -> None:
    """Coma whose rays land to the right and above has its tail there."""
    for sine, axis in ((False, 0), (True, 1)):
        coefficients = one_term(3, 1, 1.2, sine=sine)
        kernel = Renderer(2.8, 4.0).kernel(coefficients, OPEN, 0.55)
        profile = kernel.sum(0) if axis == 0 else kernel.sum(1)[::-1]
        skewness = (profile @ AT**3) / (profile @ AT**2) ** 1.5
        assert skewness > 0.3
        assert abs(kernel.sum(0) @ AT) < 0.06
        assert abs(kernel.sum(1) @ AT) < 0.06


def test_width_of_strong_defocus_is_that_of_its_rays() -> None:
    coefficients = one_term(2, 0, 3.0)
    kernel = Renderer(2.8, 4.0).kernel(coefficients, OPEN, 0.55)
    rays = spots(coefficients[None], 2.8)[1][0] / 4.0
    measured = np.sqrt((kernel.sum(0) @ AT**2 + kernel.sum(1) @ AT**2) / 2 - 1 / 12)
    assert measured == pytest.approx(rays, rel=0.06)


def test_stopping_down_keeps_the_wavefront_of_the_inner_pupil() -> None:
    rng = np.random.default_rng(4)
    coefficients = rng.normal(size=kernels.COLUMNS)
    inner = coefficients @ kernels.stopped_down(0.6)
    angle, radius = rng.uniform(0, 6.28, 50), np.sqrt(rng.uniform(0, 0.9, 50))
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    difference = coefficients @ basis(0.6 * x, 0.6 * y) - inner @ basis(x, y)
    flat = np.stack([np.ones_like(x), x, y], 1)  # piston and tilt are left out
    rest = difference - flat @ np.linalg.lstsq(flat, difference, rcond=None)[0]
    assert np.abs(rest).max() < 1e-6


@pytest.mark.parametrize("family", ["wavefront", "third-order"])
def test_a_drawn_lens_has_centred_kernels_and_is_the_same_again(family: str) -> None:
    xy = np.array([[0.001, 0.0005], [0.5, 0.2], [-0.7, 0.5]])
    drawn = kernels_of(RandomLens(np.random.default_rng(5), family), xy)  # type: ignore[arg-type]
    again = kernels_of(RandomLens(np.random.default_rng(5), family), xy)  # type: ignore[arg-type]
    np.testing.assert_array_equal(drawn, again)
    assert (drawn >= 0).all()
    np.testing.assert_allclose(drawn.sum((-1, -2)), 1.0, atol=1e-5)
    assert np.abs(drawn.sum(-2) @ AT).max() < 0.1


@pytest.mark.parametrize(("separation", "diffusion"), [(0.8, 0.0), (0.0, 1.3), (0.6, 0.7)])
def test_a_sensor_adds_variances_of_filter_and_diffusion(separation: float, diffusion: float) -> None:
    kernel = np.exp(-0.5 * (AT[:, None] ** 2 + AT**2) / 2.0**2)[None].astype(np.float32)
    kernel /= kernel.sum()
    blurred = behind_sensor(kernel, separation, diffusion)
    before, after = ((k[0].sum(0) * AT**2).sum() for k in (kernel, blurred))
    assert after - before == pytest.approx(separation**2 / 4 + diffusion**2, abs=2e-3)
    assert blurred.sum() == pytest.approx(1.0, abs=1e-5)
    assert np.abs(blurred[0] - blurred[0, ::-1, ::-1]).max() < 1e-6


@pytest.mark.parametrize("scale", [0.75, 1.0, 1.35])
def test_a_scaled_kernel_is_as_much_wider(scale: float) -> None:
    at = np.arange(SIDE) - SIDE // 2
    kernel = np.exp(-0.5 * (at[:, None] ** 2 / 4.0 + at[None] ** 2 / 9.0))
    drawn = scaled(kernel / kernel.sum(), scale)
    assert drawn.sum() == pytest.approx(1.0)
    for axis, variance in ((1, 4.0), (0, 9.0)):
        assert float(drawn.sum(axis) @ at**2) == pytest.approx(variance * scale**2, rel=0.01)
