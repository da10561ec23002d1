import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lab.correction.filter_flow import EfficientFilterFlow
from lab.correction.windows import bartlett_hann, partition
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import delta, gaussian
from lensmodel.correction.blur import UniformBlur


@given(half=st.integers(1, 300))
@settings(deadline=None)
def test_bartlett_hann_tiles_exactly_at_half_overlap(half: int) -> None:
    window = bartlett_hann(2 * half)

    np.testing.assert_allclose(window + np.roll(window, half), 1.0, atol=1e-12)


def test_bartlett_hann_refuses_odd_lengths() -> None:
    with pytest.raises(InvalidInputError, match="even length"):
        bartlett_hann(7)


@given(extent=st.integers(1, 400), parts=st.integers(1, 12))
@settings(deadline=None)
def test_partition_sums_to_one_everywhere(extent: int, parts: int) -> None:
    parts = min(parts, extent)
    total = np.zeros(extent)
    for start, window in partition(extent, parts):
        total[start : start + len(window)] += window

    np.testing.assert_allclose(total, 1.0, atol=1e-12)


def _grid() -> tuple[tuple[np.ndarray, ...], ...]:
    return tuple(
        tuple(np.roll(gaussian(9, [[0.5 + i, 0.2], [0.2, 0.5 + j]]), 1, axis=j % 2) for j in range(4))
        for i in range(3)
    )


def test_filter_flow_adjoint_is_the_transpose_of_forward() -> None:
    flow, rng = EfficientFilterFlow(60, 77, _grid()), np.random.default_rng(2)
    latent = rng.standard_normal(flow.latent_shape, dtype=np.float32)
    blurred = rng.standard_normal((60, 77), dtype=np.float32)

    difference = np.vdot(flow.forward(latent), blurred) - np.vdot(latent, flow.adjoint(blurred))

    assert abs(difference) <= 1e-5 * np.linalg.norm(flow.forward(latent)) * np.linalg.norm(blurred)


def test_filter_flow_of_one_kernel_is_the_uniform_blur() -> None:
    kernel = _grid()[1][1]
    flow = EfficientFilterFlow(60, 77, ((kernel,) * 4,) * 3)
    latent = np.random.default_rng(4).random(flow.latent_shape, dtype=np.float32)

    np.testing.assert_allclose(flow.forward(latent), UniformBlur(kernel).forward(latent), atol=2e-6)


def test_filter_flow_keeps_the_light_of_every_point_inside() -> None:
    flow = EfficientFilterFlow(60, 77, _grid())

    arriving = flow.adjoint(np.ones((60, 77), dtype=np.float32))

    np.testing.assert_allclose(arriving[9:-9, 9:-9], 1.0, atol=1e-5)


def test_filter_flow_spreads_a_point_with_the_kernel_of_its_window() -> None:
    grid = _grid()
    flow = EfficientFilterFlow(60, 80, grid)
    latent = np.zeros(flow.latent_shape, dtype=np.float32)
    latent[flow.reach + 10, flow.reach + 30] = 1.0  # next to the centre of window (0, 1) at (9.5, 29.5)

    spread = flow.forward(latent)[6:15, 26:35]

    assert np.corrcoef(spread.ravel(), grid[0][1].ravel())[0, 1] > 0.999


def test_filter_flow_refuses_a_ragged_grid() -> None:
    with pytest.raises(InvalidInputError, match="full grid"):
        EfficientFilterFlow(60, 77, ((delta(3), delta(3)), (delta(3),)))
