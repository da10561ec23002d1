from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from lensmodel.core.types import NoiseModel, Plane, ignore_step
from lensmodel.patches import Selector
from lensmodel.patches.good_regions import FEATURES, GoodRegionsSelector, features_of
from lensmodel.patches.select import RMapSelector
from lensmodel.patches.windows import Windows, details_of, windows_of

SIGMA = 0.004


def plane_of(seed: int, sigma: float = SIGMA) -> Plane:
    """Overlapping rectangles, slightly blurred, with noise."""
    rng = np.random.default_rng(seed)
    plane = np.full((320, 384), 0.4, dtype=np.float32)
    for _ in range(220):
        row, col = rng.integers(plane.shape)
        tall, wide = rng.integers(4, 60, size=2)
        plane[row : row + tall, col : col + wide] = rng.uniform(0.1, 0.8)
    blurred = ndimage.gaussian_filter(plane, 0.9)
    return (blurred + rng.normal(0.0, sigma, plane.shape)).astype(np.float32)


def looked_at(plane: Plane, sigma: float = SIGMA) -> Windows:
    windows = windows_of(plane, NoiseModel.white(sigma), 32, 1.0, ignore_step)
    return details_of(plane, windows, 1.0)


@pytest.fixture(scope="module")
def looked() -> Windows:
    return looked_at(plane_of(0))


def test_features_have_the_named_columns_and_are_finite_even_on_a_flat_plane(looked: Windows) -> None:
    flat = looked_at(np.full((256, 256), 0.5, dtype=np.float32))

    for windows in (looked, flat):
        features = features_of(windows)
        assert features.shape == (len(windows), FEATURES)
        assert np.isfinite(features).all()


def test_features_hardly_change_when_the_plane_is_turned(looked: Windows) -> None:
    plane = plane_of(0)[:320, :320].copy()
    straight = features_of(looked_at(plane))
    turned = features_of(looked_at(np.rot90(plane).copy()))
    spread = features_of(looked).std(axis=0)
    order = np.rot90(np.arange(49).reshape(7, 7)).ravel()
    difference = np.abs(turned - straight[order])

    assert np.all(difference.max(axis=0) <= 0.2 * spread + 0.03)


@pytest.mark.parametrize("selector", [GoodRegionsSelector(), RMapSelector()])
def test_windows_score_above_the_same_in_heavy_noise(selector: Selector) -> None:
    quiet, loud = (looked_at(plane_of(3, sigma=sigma), sigma) for sigma in (SIGMA, 10 * SIGMA))

    assert selector.score(quiet).mean() > selector.score(loud).mean() + 0.1
