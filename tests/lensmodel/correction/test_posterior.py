"""What is thought of a PSF: a kernel and the variance that its error makes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lab.kernels import gaussian
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import otf
from lensmodel.correction.posterior import GRID, PsfPosterior

SIDE = 31
WIDE = gaussian(SIDE, 2.0**2 * np.eye(2))


TIMES = np.array([1.0, *[2.0] * (GRID[1] // 2 - 1), 1.0])  # each column of the half spectrum in the whole


@pytest.mark.parametrize("error", [0.1, 0.5])
def test_variance_of_a_known_error_has_its_size_and_spares_what_has_no_blur(error: float) -> None:
    posterior = PsfPosterior.of_error(WIDE, error)
    power = np.abs(otf(WIDE, GRID)) ** 2

    assert (TIMES * posterior.variance).sum() == pytest.approx(error**2 * (TIMES * power).sum(), rel=1e-4)
    assert posterior.variance[0, 0] == pytest.approx(0.0, abs=1e-9)


def test_variance_is_no_more_than_the_error_that_is_known_by_frequency() -> None:
    rings = np.array([0.004, 0.02, 0.03, 0.1, 0.4, 0.4, 0.4, 0.4])
    wide, bounded = (PsfPosterior.of_error(WIDE, 0.5, known).variance for known in (None, rings))

    f = np.hypot(np.fft.fftfreq(64)[:, None], np.fft.rfftfreq(64))
    assert np.all(bounded <= wide)
    middle = np.abs(f - 3.0 / 32.0) < 1e-9  # of the second ring
    np.testing.assert_allclose(bounded[middle], 0.02**2, rtol=1e-5)
    np.testing.assert_allclose(
        bounded[0, 1], 0.004**2 / 16.0, rtol=1e-5
    )  # 1/64: half way to the first middle
    np.testing.assert_allclose(bounded[f > 0.3], wide[f > 0.3])


@pytest.mark.parametrize("bad", [-0.1, math.nan, math.inf])
def test_impossible_errors_are_refused(bad: float) -> None:
    with pytest.raises(InvalidInputError, match="psf_error"):
        PsfPosterior.of_error(WIDE, bad)
