"""`lensmodel.correction.limits.hue`: what a correction may do to colours, whatever came before."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from lensmodel.core.types import Planes
from lensmodel.correction.limits.hue import HUE_REACH, hue_bounded

CLIP = (1.0, 1.0, 1.0)
DARK = (1e-4, 1e-4, 1e-4)


def around(photo: Planes) -> Planes:
    margin = (HUE_REACH, HUE_REACH)
    return np.pad(photo, ((0, 0), margin, margin), mode="edge")


def differences(planes: Planes) -> Planes:
    """Red and blue less green, of light of 1."""
    share = planes / planes.sum(axis=0)
    return np.asarray(share[[0, 2]] - share[1])


@given(seed=st.integers(0, 2**32 - 1), purity=st.floats(0.0, 0.5))
def test_no_hue_leaves_those_nearby_and_the_light_stays(seed: int, purity: float) -> None:
    rng = np.random.default_rng(seed)
    grey = rng.uniform(0.2, 0.6, (1, 20, 24)).repeat(3, axis=0).astype(np.float32)
    photo = np.asarray(grey * (1.0 + purity * rng.uniform(-1.0, 1.0, (3, 20, 24))), dtype=np.float32)
    made = np.asarray(photo * rng.uniform(0.3, 2.0, photo.shape), dtype=np.float32)

    bounded = hue_bounded(around(photo), made, CLIP, DARK)

    np.testing.assert_allclose(bounded.sum(axis=0), made.sum(axis=0), rtol=1e-4)
    seen = differences(photo)
    window = (1, 2 * HUE_REACH + 1, 2 * HUE_REACH + 1)
    low, high = ndimage.minimum_filter(seen, window), ndimage.maximum_filter(seen, window)
    result = differences(bounded)
    # what is dark beside the brightest light nearby may have more of the hues there
    more = 1.0 + 0.05 * ndimage.maximum_filter(photo.sum(axis=0), window[1:]) / made.sum(axis=0)
    assert (result >= more * np.minimum(low - 0.04, 0.0)).all()
    assert (result <= more * np.maximum(high + 0.04, 0.0)).all()


def test_a_dark_speck_lends_no_colour_to_the_light_beside_it() -> None:
    """What is nearly black has shares like any paint, and none that is seen."""
    photo = np.full((3, 16, 16), 0.3, dtype=np.float32)
    photo[:, 8, 10] = (0.001, 0.001, 0.008)
    made = photo.copy()
    made[:, 8, 8] = (0.15, 0.15, 0.6)

    bounded = hue_bounded(around(photo), made, CLIP, DARK)

    share = bounded[:, 8, 8] / bounded[:, 8, 8].sum()
    np.testing.assert_allclose(share, 1.0 / 3.0, atol=0.12)  # the speck's is .8
    assert bounded.sum(axis=0)[8, 8] == pytest.approx(0.9, rel=1e-3)


def test_two_hues_of_the_surroundings_do_not_allow_a_third() -> None:
    """Brown beside grey: each colour's share of purple is within the range of theirs, purple is not."""
    photo = np.empty((3, 16, 16), dtype=np.float32)
    photo[:, :, :8] = np.array([0.33, 0.20, 0.09], dtype=np.float32)[:, None, None]
    photo[:, :, 8:] = 0.4
    made = photo.copy()
    made[:, 8, 8] = (0.5, 0.25, 0.45)

    bounded = hue_bounded(around(photo), made, CLIP, DARK)

    assert bounded[1, 8, 8] > 0.9 * min(bounded[0, 8, 8], bounded[2, 8, 8])
    assert bounded.sum(axis=0)[8, 8] == pytest.approx(1.2, rel=1e-3)
    untouched = np.ones((16, 16), dtype=bool)
    untouched[8, 8] = False
    np.testing.assert_array_equal(bounded[:, untouched], made[:, untouched])


def test_white_that_gets_darker_takes_the_hue_around_it() -> None:
    """Full wells of all colours are no hue: shown below saturation they would be pink."""
    photo = np.empty((3, 16, 16), dtype=np.float32)
    photo[:] = np.array([0.3, 0.6, 0.4], dtype=np.float32)[:, None, None]  # grey, before the white balance
    photo[:, 7:9, 7:9] = 1.0
    made = photo.copy()
    made[:, 7, 7] = 0.7

    bounded = hue_bounded(around(photo), made, CLIP, DARK)

    share = bounded[:, 7, 7] / bounded[:, 7, 7].sum()
    np.testing.assert_allclose(share, np.array([0.3, 0.6, 0.4]) / 1.3, atol=0.04)


def test_deeper_colour_of_a_hue_that_is_there_stays_to_a_part() -> None:
    photo = np.full((3, 16, 16), 0.4, dtype=np.float32)
    photo[0, 8, 8] = 0.5
    made = photo.copy()
    made[0, 8, 8] = 0.9

    bounded = hue_bounded(around(photo), made, CLIP, DARK)

    share = bounded[0, 8, 8] / bounded[:, 8, 8].sum()
    assert 0.5 / 1.3 + 0.02 < share < 0.9 / 1.7


def test_white_that_is_hardly_darker_stays_white() -> None:
    """A dip of one colour within a clipped light would take the hue of the light's glow: a dot."""
    photo = np.empty((3, 16, 16), dtype=np.float32)
    photo[:] = np.array([0.6, 0.3, 0.1], dtype=np.float32)[:, None, None]
    photo[:, 5:11, 5:11] = 1.0
    made = photo.copy()
    made[2, 7, 7] = 0.9

    bounded = hue_bounded(around(photo), made, CLIP, DARK)

    assert (bounded[:, 5:11, 5:11] >= 1.0).all()
