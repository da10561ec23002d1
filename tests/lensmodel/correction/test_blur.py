import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import signal

from lab.kernels import gaussian
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import as_kernel, crop_to_support, delta, support_radius
from lensmodel.core.types import Kernel
from lensmodel.correction.blur import Drift, UniformBlur, transfers


def kernels(side: int = 7) -> st.SearchStrategy[np.ndarray]:
    values = hnp.arrays(np.float64, (side, side), elements=st.floats(0.0, 1.0, width=32))
    return values.filter(lambda a: a.sum() > 0.1).map(as_kernel)


@given(kernel=kernels(), offset=st.sampled_from([(0.0, 0.0), (0.4, -1.3)]), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_adjoint_is_the_transpose_of_forward(kernel: Kernel, offset: tuple[float, float], seed: int) -> None:
    rng = np.random.default_rng(seed)
    blur = UniformBlur(kernel, offset)
    blurred = rng.standard_normal((24, 31), dtype=np.float32)
    latent = rng.standard_normal(blur.adjoint(blurred).shape, dtype=np.float32)

    left, right = np.vdot(blur.forward(latent), blurred), np.vdot(latent, blur.adjoint(blurred))

    assert left == pytest.approx(right, abs=1e-4 * float(np.linalg.norm(latent)))


@given(kernel=kernels(), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25)
def test_forward_is_the_convolution_where_all_light_is_known(kernel: np.ndarray, seed: int) -> None:
    latent = np.random.default_rng(seed).random((22, 27), dtype=np.float32)

    expected = signal.convolve2d(latent, kernel, mode="valid")

    np.testing.assert_allclose(UniformBlur(kernel).forward(latent), expected, atol=1e-6)


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.4, -1.3)])
def test_blur_of_a_constant_is_the_constant(offset: tuple[float, float]) -> None:
    blur = UniformBlur(gaussian(9, np.eye(2)), offset=offset)
    latent = np.full(blur.adjoint(np.ones((24, 31), dtype=np.float32)).shape, 0.7, dtype=np.float32)

    np.testing.assert_allclose(blur.forward(latent), 0.7, rtol=1e-4)


def test_offset_moves_a_point_by_whole_pixels() -> None:
    point = np.zeros((21, 21), dtype=np.float32)
    point[10, 10] = 1.0

    blur = UniformBlur(delta(5), offset=(-1.0, 2.0))
    blurred = blur.forward(point)

    row, col = np.unravel_index(blurred.argmax(), blurred.shape)
    assert (row + blur.reach - 10, col + blur.reach - 10) == (-1, 2)


def test_forward_refuses_a_latent_plane_without_a_frame() -> None:
    with pytest.raises(InvalidInputError, match="leaves no frame"):
        UniformBlur(delta(9)).forward(np.ones((8, 40), dtype=np.float32))


def test_support_radius_holds_the_energy_asked_for() -> None:
    kernel = gaussian(41, np.eye(2) * 4.0)
    radius = support_radius(kernel)
    held = kernel[20 - radius : 21 + radius, 20 - radius : 21 + radius].sum()
    less = kernel[21 - radius : 20 + radius, 21 - radius : 20 + radius].sum()

    assert less < 0.999 <= held
    assert crop_to_support(kernel).shape == (2 * radius + 1, 2 * radius + 1)


def test_drift_is_the_change_of_the_transfer_function_per_pixel() -> None:
    narrow, wide = UniformBlur(gaussian(5, np.eye(2))), UniformBlur(gaussian(9, 2.0 * np.eye(2)))
    shifted = UniformBlur(narrow.kernel, (0.5, -0.25))

    drift = Drift((narrow, wide, 40.0), (narrow, shifted, 20.0), (0.0, 0.0))

    K, rates = transfers([UniformBlur(narrow.kernel, drift=drift)], (32, 30), 0.0)

    np.testing.assert_allclose(K[0], narrow.spectrum((32, 30)), atol=1e-6)
    for rate, blur, pixels in zip(rates[0], (wide, shifted), (40.0, 20.0), strict=True):
        change = blur.spectrum((32, 30)) - narrow.spectrum((32, 30))
        np.testing.assert_allclose(rate, change / pixels, atol=1e-7)


@pytest.mark.parametrize("shift", [0.28, 0.5, 1.3, -0.4, -3.0])
def test_shifted_point_stays_where_it_is_put(shift: float) -> None:
    """A sinc would cross the picture; undone, it draws nets of dots."""
    blur = UniformBlur(delta(1), (0.0, shift))
    point = np.zeros((33, 64), dtype=np.float32)
    point[16, 32] = 1.0
    spread = np.fft.irfft2(np.fft.rfft2(point) * blur.spectrum(point.shape), point.shape)

    at = 32 + shift
    far = np.abs(np.arange(64) - at) >= 2.0
    assert np.abs(spread[:, far]).max() < 1e-6
    assert spread.sum() == pytest.approx(1.0)
    assert (spread[16] * np.arange(64)).sum() == pytest.approx(at, abs=1e-5)
