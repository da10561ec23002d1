import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from lab.correction.filter_flow import EfficientFilterFlow, partition
from lab.kernels import gaussian
from lensmodel.correction.blur import UniformBlur


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


def test_filter_flow_of_one_kernel_is_the_uniform_blur() -> None:
    kernel = _grid()[1][1]
    flow = EfficientFilterFlow(60, 77, ((kernel,) * 4,) * 3)
    latent = np.random.default_rng(4).random(flow.latent_shape, dtype=np.float32)

    np.testing.assert_allclose(flow.forward(latent), UniformBlur(kernel).forward(latent), atol=2e-6)


def test_filter_flow_keeps_the_light_of_every_point_inside() -> None:
    flow = EfficientFilterFlow(60, 77, _grid())

    reach = flow.reach
    latent = np.zeros(flow.latent_shape, dtype=np.float32)
    inner = np.s_[2 * reach : -2 * reach, 2 * reach : -2 * reach]
    latent[inner] = np.random.default_rng(2).random(latent[inner].shape)

    np.testing.assert_allclose(flow.forward(latent).sum(), latent.sum(), rtol=1e-5)


def test_filter_flow_spreads_a_point_with_the_kernel_of_its_window() -> None:
    grid = _grid()
    flow = EfficientFilterFlow(60, 80, grid)
    latent = np.zeros(flow.latent_shape, dtype=np.float32)
    latent[flow.reach + 10, flow.reach + 30] = 1.0  # next to the centre of window (0, 1) at (9.5, 29.5)

    spread = flow.forward(latent)[6:15, 26:35]

    assert np.corrcoef(spread.ravel(), grid[0][1].ravel())[0, 1] > 0.999
