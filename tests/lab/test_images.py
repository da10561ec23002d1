"""Figures of the laboratory for pictures: PSNR."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lab.images import psnr
from lensmodel.core.errors import InvalidInputError
from lensmodel.quality import to_srgb


def test_psnr_is_that_of_the_mean_square_and_infinite_for_equal_pictures() -> None:
    reference = np.full((3, 20, 30), 0.5)

    assert psnr(reference + 0.1, reference) == pytest.approx(20.0)
    assert psnr(reference, reference) == math.inf
    mask = np.zeros((20, 30), dtype=bool)
    mask[:, 0] = True
    changed = reference.copy()
    changed[:, :, 0] += 0.01
    assert psnr(changed, reference, mask=mask) == pytest.approx(40.0)
    assert psnr(reference * 0.9, reference, srgb=True) == pytest.approx(
        -20 * math.log10(to_srgb(np.array(0.5)) - to_srgb(np.array(0.45)))
    )
    with pytest.raises(InvalidInputError, match="mask"):
        psnr(reference, reference, mask=np.zeros((20, 30), dtype=bool))
    with pytest.raises(InvalidInputError, match="same shape"):
        psnr(reference, reference[:, 1:])
