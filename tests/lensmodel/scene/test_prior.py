"""What is known of scenes, for windows and for patches."""

from __future__ import annotations

import numpy as np
import pytest

from lensmodel.core.spectrum import SECTORS, bin_frequencies
from lensmodel.optics.transfer import BINS
from lensmodel.scene.prior import (
    FIRST_WINDOW_RING,
    PATCH_SHAPES,
    PATCHES,
    WINDOW_BINS,
    WINDOW_SHAPES,
    WindowPrior,
    by_ring,
    polynomial,
)


def test_windows_and_patches_have_the_same_polynomial() -> None:
    more = WINDOW_BINS - BINS

    assert more == SECTORS
    assert np.array_equal(WINDOW_SHAPES[more:], PATCH_SHAPES[:, : WINDOW_SHAPES.shape[1]])


def test_a_power_law_is_a_line_of_the_polynomial() -> None:
    modulus, angle = bin_frequencies()
    line = polynomial(modulus, angle) @ np.array([-3.0, -2.0, *[0.0] * 13])

    assert np.exp(line) == pytest.approx(np.exp(-3.0) * (modulus / 0.1) ** -2.0)


def test_usual_scenes_fall_off_about_as_natural_images_do() -> None:
    """D. J. Field, JOSA A 4, 1987: with about the square of the frequency."""
    modulus, _ = bin_frequencies(FIRST_WINDOW_RING)
    of_windows = np.polyfit(np.log(modulus), WindowPrior.load().usual, 1)[0]

    assert -3.2 < of_windows < -1.8
    assert -2.6 < PATCHES.usual[1] < -1.8


def test_the_spread_of_windows_is_a_covariance_that_leaves_the_amplitude_free() -> None:
    spread = WindowPrior.load().spread

    assert not spread[0].any()
    assert spread == pytest.approx(spread.T, abs=1e-12)
    assert np.linalg.eigvalsh(spread[1:, 1:]).min() > 0.0


def test_a_ring_has_one_value_in_all_its_sectors() -> None:
    values = by_ring([1.0, 2.0])

    assert values.shape == (2 * SECTORS,)
    assert set(values[:SECTORS]) == {1.0}
