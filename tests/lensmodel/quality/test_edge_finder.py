"""Edges of a chart are found without being told where; other pictures have none."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from lab.images import by_zone, measure_edges
from lensmodel.core.types import Frame, NoiseModel
from lensmodel.quality import find_edges
from lensmodel.simulate import demo_scene, edge_chart

FRAME = Frame(900, 1200)
CHART = edge_chart(FRAME)
BOXES = [edge.box for edge in CHART.edges]
RNG_SEED = 3


def noisy(plane: NDArray[np.floating], noise: NoiseModel) -> NDArray[np.float32]:
    rng = np.random.default_rng(RNG_SEED)
    seen = plane + rng.normal(size=plane.shape) * np.sqrt(noise.variance(plane))
    return seen.astype(np.float32)


@cache
def soft(sigma: float) -> NDArray[np.float32]:
    rows = (CHART.scene.shape[1] - FRAME.height) // 2
    return ndimage.gaussian_filter(CHART.scene[1], sigma)[rows:-rows, rows:-rows]


@pytest.mark.parametrize("sigma", [0.6, 1.5, 3.0])
@pytest.mark.parametrize("noise", [NoiseModel(1 / 50000, 1e-6), NoiseModel(1 / 2500, 9e-6)])
def test_found_edges_are_as_sharp_as_those_in_known_boxes(sigma: float, noise: NoiseModel) -> None:
    photo = noisy(soft(sigma), noise)

    table = by_zone(measure_edges(photo, [edge.box for edge in find_edges(photo, noise=noise)]))

    known = by_zone(measure_edges(photo, BOXES))
    assert table.keys() == known.keys() == {"center", "mid", "corner"}
    for zone, row in table.items():
        assert row.edges >= 2
        assert row.mtf50 == pytest.approx(known[zone].mtf50, rel=0.05)


def test_found_boxes_lie_in_the_frame_and_every_edge_is_found_once() -> None:
    found = find_edges(soft(1.0))

    for edge in found:
        row, col, height, width = edge.box
        assert min(row, col) >= 0
        assert row + height <= FRAME.height
        assert col + width <= FRAME.width
    middles = np.array([edge.middle for edge in found])
    apart = np.hypot(*(middles[:, None] - middles).transpose(2, 0, 1)) + 1e9 * np.eye(len(found))
    assert len(found) >= len(BOXES)
    assert apart.min() > 40.0


@pytest.mark.parametrize("name", ["city", "lake"])
@pytest.mark.parametrize("sigma", [0.0, 1.5])
def test_photographs_of_other_things_have_none(name: str, sigma: float) -> None:
    plane = ndimage.gaussian_filter(demo_scene(name)[1], sigma)

    assert find_edges(plane) == ()


def test_one_strong_edge_is_no_chart() -> None:
    photo = np.full((FRAME.height, FRAME.width), 0.2, dtype=np.float32)
    row, col, height, width = BOXES[0]
    photo[row : row + height, col : col + width] = soft(1.0)[row : row + height, col : col + width]

    assert find_edges(photo) == ()


def test_clipped_edges_are_left_alone() -> None:
    photo = soft(1.0)

    assert find_edges(photo)
    assert find_edges(photo, clip=float(photo.max())) == ()
    assert find_edges(np.minimum(photo, 0.6), clip=0.6) == ()


@pytest.mark.parametrize(
    "plane",
    [
        np.zeros((0, 5)),
        np.zeros((1, 1)),
        np.zeros((300, 400)),
        np.ones((300, 400)),
        np.full((64, 64), -3.0),
        np.full((64, 3000), 1e30),
        np.full((200, 200), 1e-38),
        np.random.default_rng(0).normal(0.0, 1e6, (300, 300)),
        np.random.default_rng(1).random((65, 67)),
        np.random.default_rng(4).random((200, 200)) * 1e30,
        np.indices((200, 200)).sum(axis=0) % 2 * 0.5,
        np.tri(300) * 0.5 + 0.1,
        np.linspace(0.0, 1.0, 300)[:, None] * np.ones(300),
        np.where(np.random.default_rng(2).random((300, 300)) > 0.999, 1e18, 0.0),
    ],
    ids=lambda plane: f"{plane.shape}",
)
def test_strange_planes_have_no_edges_and_no_errors(plane: NDArray[np.float64]) -> None:
    plane = plane.astype(np.float32)

    assert find_edges(plane) == ()
