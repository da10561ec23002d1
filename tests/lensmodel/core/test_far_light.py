"""Light far from the core of a blur: its shape, and kernels that get it."""

from __future__ import annotations

import numpy as np
import pytest

from lensmodel.core.far_light import FAR, NEAR, SIDE, far_profile, with_far_light
from lensmodel.core.psf import gaussian


def radii(size: int) -> np.ndarray:
    t = np.arange(size) - size // 2
    return np.hypot(t[:, None], t[None, :])


def test_profile_is_round_of_sum_one_and_leaves_the_core_alone() -> None:
    light = far_profile()

    assert light.shape == (SIDE, SIDE)
    assert light.sum() == pytest.approx(1.0)
    np.testing.assert_array_equal(light, light.T)
    np.testing.assert_array_equal(light, light[::-1])
    r = radii(SIDE)
    assert not light[(r < NEAR) | (r >= FAR)].any()


def test_rings_hold_less_the_farther_they_are() -> None:
    light, r = far_profile(63), radii(63)
    rings = [light[(r >= a) & (r < a + 2.5)].sum() for a in (4.0, 7.0, 10.0, 13.0, 15.0)]
    assert np.all(np.diff(rings) < 0.0)


def test_small_profile_is_the_middle_of_the_whole_one() -> None:
    np.testing.assert_array_equal(far_profile(15), far_profile()[11:26, 11:26])
    assert far_profile(15).sum() < 1.0


def test_kernel_gets_its_share_and_keeps_its_sum() -> None:
    core = gaussian(55, 1.5 * np.eye(2))
    kernels = with_far_light(np.stack([core, core]), np.array([0.0, 0.3]))

    np.testing.assert_allclose(kernels.sum(axis=(1, 2)), 1.0)
    np.testing.assert_allclose(kernels[0], core)
    far = radii(55) > 6.0
    assert kernels[1][far].sum() == pytest.approx(0.3 * far_profile(55)[far].sum(), rel=1e-4)
    assert kernels[1][27, 27] == pytest.approx(0.7 * core[27, 27])
