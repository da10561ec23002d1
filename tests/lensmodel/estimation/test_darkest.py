"""Shadows bound the light that a lens throws far: on scenes drawn here, blurred by halos of another shape."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage, signal

from lensmodel.estimation.darkest import REACH, darkest_share

SIDE = 2 * REACH + 80
MIDDLE = SIDE // 2


def scene(darkest: float, seed: int = 3) -> np.ndarray:
    """Bright ground with a disc in each square of 40 pixels, of a radius of four to six, as dark as said."""
    rng = np.random.default_rng(seed)
    ground = 0.5 + 0.1 * ndimage.gaussian_filter(rng.normal(size=(SIDE, SIDE)), 3.0) * 6.0
    rows, cols = np.mgrid[:SIDE, :SIDE]
    for row in range(20, SIDE, 40):
        for col in range(20, SIDE, 40):
            ground[(rows - row) ** 2 + (cols - col) ** 2 < rng.uniform(4.0, 6.0) ** 2] = darkest * 0.5
    return np.clip(ground, 0.0, 0.9)


def seen(scene: np.ndarray, share: float) -> np.ndarray:
    """Behind a core of one pixel and a flat disc of 11 pixels that holds a share of the light."""
    t = np.arange(-11, 12)
    disc = (np.hypot(t[:, None], t[None, :]) <= 11.0).astype(np.float64)
    core = ndimage.gaussian_filter(scene, 1.0)
    far = signal.fftconvolve(np.pad(core, 11, mode="reflect"), disc / disc.sum(), mode="valid")
    noise = np.random.default_rng(5).normal(0.0, 0.002, scene.shape)
    return ((1.0 - share) * core + share * far + noise).astype(np.float32)


def bound(plane: np.ndarray) -> float:
    found = darkest_share(plane, 1.0, MIDDLE, MIDDLE)
    assert found is not None
    return found


@pytest.mark.parametrize("share", [0.1, 0.2, 0.4])
def test_deep_shadows_tell_the_share_of_far_light(share: float) -> None:
    found = bound(seen(scene(0.01), share))
    assert 0.8 * share < found < share + 0.06


def test_black_shadows_behind_a_lens_without_far_light_say_so() -> None:
    assert bound(seen(scene(0.0), 0.0)) < 0.03


def test_light_of_the_scene_loosens_the_bound_and_never_tightens_it() -> None:
    bounds = [bound(seen(scene(darkest), 0.15)) for darkest in (0.0, 0.1, 0.3, 0.6)]
    assert np.all(np.diff(bounds) > 0.03)


def test_brightness_does_not_count() -> None:
    plane = seen(scene(0.02), 0.2)
    assert bound(0.5 * plane) == pytest.approx(bound(plane), rel=0.02)


def test_nothing_is_said_of_a_dark_a_clipped_or_a_small_picture() -> None:
    plane = seen(scene(0.02), 0.2)

    assert darkest_share(0.02 * plane, 1.0, MIDDLE, MIDDLE) is None
    assert darkest_share(plane, 0.3, MIDDLE, MIDDLE) is None
    assert darkest_share(plane[:40, :40], 1.0, 20, 20) is None


def test_shadows_beyond_reach_do_not_count() -> None:
    bright = np.full((900, 900), 0.5, dtype=np.float32)
    bright[:100, :100] = seen(scene(0.0), 0.0)[:100, :100]

    assert darkest_share(bright, 1.0, 600, 600) == pytest.approx(1.0, abs=0.01)
