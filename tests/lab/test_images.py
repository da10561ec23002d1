"""Figures of the laboratory for pictures: PSNR, SSIM, noise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import ndimage

from lab.images import flat_noise, noise_gain, psnr, ssim
from lab.scenes import dead_leaves
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


def test_ssim_is_one_for_equal_pictures_and_falls_with_blur() -> None:
    scene = dead_leaves(64, 96, np.random.default_rng(0))
    soft, softer = (np.stack([ndimage.gaussian_filter(p, s) for p in scene]) for s in (0.7, 2.0))

    assert ssim(scene, scene) == pytest.approx(1.0)
    assert ssim(scene, scene) > ssim(soft, scene) > ssim(softer, scene)
    assert ssim(soft, scene, srgb=True) < 1.0
    with pytest.raises(InvalidInputError, match="11"):
        ssim(scene[:, :8], scene[:, :8])


def test_noise_gain_sees_through_shading() -> None:
    rng = np.random.default_rng(2)
    shading = np.linspace(0.2, 0.5, 64)[None, :] * np.linspace(1.0, 1.3, 64)[:, None]
    noise = rng.normal(0.0, 0.01, (64, 64))

    assert flat_noise(shading + noise) == pytest.approx(0.01, rel=0.05)
    assert noise_gain(shading + 2.5 * noise, shading + noise) == pytest.approx(2.5, rel=0.02)
    with pytest.raises(InvalidInputError, match="no noise"):
        noise_gain(noise, np.zeros((64, 64)))
    with pytest.raises(InvalidInputError, match="8 x 8"):
        flat_noise(np.zeros((4, 40)))
