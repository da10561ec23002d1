"""Power of a patch in rings and sectors."""

from __future__ import annotations

import numpy as np
import pytest

from lensmodel.core.spectrum import RINGS, SECTORS, binned_spectrum
from lensmodel.core.types import NoiseModel


def test_white_noise_fills_every_bin_with_its_variance() -> None:
    noise = np.random.default_rng(0).normal(0.5, 0.1, (512, 512)).astype(np.float32)

    spectrum, floor = binned_spectrum(noise, NoiseModel.white(0.1))

    assert spectrum.shape == (RINGS, SECTORS)
    assert floor == pytest.approx(0.01)
    assert spectrum[4:].mean() == pytest.approx(floor, rel=0.05)
