from __future__ import annotations

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from lensmodel.blind.patch_recurrence import window_products


@pytest.mark.parametrize(("shape", "side"), [((40, 30), 7), ((3, 25), 9), ((1, 4), 5), ((20, 20), 1)])
def test_products_are_those_of_windows_written_out(shape: tuple[int, int], side: int) -> None:
    rng = np.random.default_rng(3)
    x = rng.standard_normal((shape[0] + side - 1, shape[1] + side - 1))
    y = rng.standard_normal(shape) + 0.3
    columns = sliding_window_view(x, (side, side)).reshape(-1, side * side)
    columns = columns - columns.mean(axis=0)
    gram, cross = window_products(x, y, side)

    np.testing.assert_allclose(gram, columns.T @ columns, atol=1e-5 * y.size)
    np.testing.assert_allclose(cross, columns.T @ (y - y.mean()).ravel(), atol=1e-5 * y.size)
    np.testing.assert_array_equal(gram, gram.T)
