from __future__ import annotations

import numpy as np

from lensmodel.core.least_squares import nonnegative_least_squares


def test_least_squares_respects_the_sign_constraint() -> None:
    a = np.diag([2.0, 4.0, 1.0])

    k = nonnegative_least_squares(a, np.array([2.0, -3.0, 0.5]), np.ones(3))

    assert np.allclose(k, [1.0, 0.0, 0.5], atol=1e-6)


def test_where_nothing_is_known_the_start_comes_back() -> None:
    assert nonnegative_least_squares(np.zeros((2, 2)), np.zeros(2), np.ones(2)).tolist() == [1.0, 1.0]
