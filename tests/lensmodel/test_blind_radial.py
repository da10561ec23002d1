from __future__ import annotations

import numpy as np
import pytest

from lensmodel.blind.radial import radial_mtf, with_radial_mtf
from lensmodel.psf import delta, gaussian


def test_point_passes_every_frequency() -> None:
    np.testing.assert_allclose(radial_mtf(delta(31)), 1.0, atol=1e-12)


def test_gaussian_follows_its_formula() -> None:
    middle = np.array([0.055, 0.105, 0.155, 0.205])

    mtf = radial_mtf(gaussian(31, np.eye(2) * 1.2**2))[:4]

    np.testing.assert_allclose(mtf, np.exp(-2 * np.pi**2 * 1.2**2 * middle**2), rtol=0.08)


@pytest.mark.parametrize("width", [0.8, 1.0])
def test_kernel_takes_the_mtf_it_is_given_and_keeps_its_direction(width: float) -> None:
    oval = gaussian(31, np.diag([2.4, 1.0]))
    wanted = radial_mtf(gaussian(31, np.eye(2) * width**2))

    changed = with_radial_mtf(oval, wanted)

    assert changed.sum() == pytest.approx(1.0)
    assert changed.min() >= 0.0
    assert np.abs(radial_mtf(changed) - wanted).max() < 0.12
    assert np.abs(radial_mtf(changed) - wanted).max() < 0.5 * np.abs(radial_mtf(oval) - wanted).max()
    rows, cols = np.indices((31, 31)) - 15
    assert (changed * rows**2).sum() > (changed * cols**2).sum()
