"""What is thought of a PSF: means, variances, and what a correction makes of them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lensmodel.core.belief import GRID, Belief, Narrowing, narrowed
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import delta, gaussian, otf, rms_width

SIDE = 31
WIDE, NARROW = gaussian(SIDE, 2.0**2 * np.eye(2)), gaussian(SIDE, 1.0**2 * np.eye(2))
PLAIN = (Narrowing(),)


def times() -> np.ndarray:
    """How often each half-spectrum column counts, by Parseval of a white plane."""
    found = np.full((GRID[0], GRID[1] // 2 + 1), 2.0)
    found[:, [0, -1]] = 1.0
    return found


@pytest.mark.parametrize("width", [0.7, 0.5])
def test_narrowed_kernel_has_that_width_and_all_its_light_in_place(width: float) -> None:
    found = narrowed(WIDE, width)

    assert rms_width(found) == pytest.approx(width * 2.0, rel=0.07)  # and a little by its pixels
    assert found.sum() == pytest.approx(1.0)
    point = narrowed(delta(SIDE), width)
    assert point[15, 15] == pytest.approx(1.0)


def test_narrowing_puts_no_light_where_none_was() -> None:
    sharp = np.zeros((SIDE, SIDE))
    sharp[15, 15], sharp[15, 16], sharp[12, 18] = 0.7, 0.2, 0.1

    assert narrowed(sharp, 0.6)[:12].sum() == 0.0
    assert narrowed(sharp, 0.6)[:, :15].sum() == 0.0


def test_mixture_of_one_is_that_one_and_sure() -> None:
    belief = Belief.mixture([WIDE], PLAIN, np.array([[1.0]]))

    assert np.allclose(belief.kernel, WIDE, atol=1e-6)
    assert belief.error == pytest.approx(0.0, abs=1e-6)


def test_mean_and_variance_of_two_kernels_are_those_of_their_transfer_functions() -> None:
    belief = Belief.mixture([WIDE, NARROW], PLAIN, np.array([[0.25], [0.75]]))
    one, other = otf(WIDE, GRID), otf(NARROW, GRID)

    assert np.allclose(belief.kernel, 0.25 * WIDE + 0.75 * NARROW, atol=1e-6)
    assert np.allclose(belief.variance, 0.25 * 0.75 * np.abs(one - other) ** 2, atol=1e-6)
    apart = np.linalg.norm(WIDE - NARROW) * math.sqrt(0.25 * 0.75)
    assert belief.error == pytest.approx(apart / np.linalg.norm(belief.kernel), rel=1e-3)


def test_share_of_a_point_is_mixed_in() -> None:
    belief = Belief.mixture([WIDE], (Narrowing(share=0.4),), np.array([[1.0]]))

    assert np.allclose(belief.kernel, 0.4 * WIDE + 0.6 * delta(SIDE), atol=1e-6)


@pytest.mark.parametrize("error", [0.1, 0.5])
def test_variance_of_a_known_error_has_its_size_and_spares_what_has_no_blur(error: float) -> None:
    belief = Belief.of_error(WIDE, error)
    power = np.abs(otf(WIDE, GRID)) ** 2

    assert (times() * belief.variance).sum() == pytest.approx(error**2 * (times() * power).sum(), rel=1e-4)
    assert belief.variance[0, 0] == pytest.approx(0.0, abs=1e-9)


def test_wider_belief_has_more_variance_and_the_same_mean() -> None:
    belief = Belief.mixture([WIDE, NARROW], PLAIN, np.array([[0.5], [0.5]]))
    wider = belief.widened(4.0)

    assert np.allclose(wider.variance, 4.0 * belief.variance)
    assert wider.error == pytest.approx(2.0 * belief.error)
    assert wider.kernel is belief.kernel


def test_mean_keeps_the_place_of_its_light() -> None:
    coma = np.zeros((SIDE, SIDE))
    coma[15, 15], coma[13, 18] = 0.7, 0.3
    belief = Belief.mixture([coma, NARROW], PLAIN, np.array([[1.0], [0.0]]))

    assert belief.kernel[13, 18] == pytest.approx(0.3, abs=1e-6)
    assert rms_width(belief.kernel) == pytest.approx(rms_width(coma), rel=1e-4)


@pytest.mark.parametrize("bad", [-0.1, math.nan, math.inf])
def test_impossible_errors_are_refused(bad: float) -> None:
    with pytest.raises(InvalidInputError, match="psf_error"):
        Belief.of_error(WIDE, bad)


def test_kernels_that_the_grid_cannot_hold_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="at most 63"):
        Belief.mixture([gaussian(65, np.eye(2))], PLAIN, np.array([[1.0]]))
