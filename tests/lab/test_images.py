"""Pictures as shown, shifts of them, and PSNR."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from lab.images import best_shift, fidelity, psnr_of, shifted, to_srgb
from lab.scenes import dead_leaves
from lensmodel.core.types import CORNER_ZONE_R, Frame


def test_psnr_is_that_of_the_mean_square() -> None:
    assert psnr_of(0.1**2) == pytest.approx(20.0)


def test_srgb_curve_has_its_known_values_and_clips() -> None:
    np.testing.assert_allclose(
        to_srgb(np.array([-1.0, 0.0, 0.0031308, 0.214041, 1.0, 2.0])), [0, 0, 0.04045, 0.5, 1, 1], atol=1e-4
    )


@cache
def smooth_scene() -> NDArray[np.float64]:
    scene = dead_leaves(120, 160, np.random.default_rng(1))
    return np.stack([ndimage.gaussian_filter(p.astype(np.float64), 1.5) for p in scene])


@pytest.mark.parametrize("shift", [(0.3, -0.7), (1.6, 0.0), (-0.05, 2.2)])
def test_best_shift_undoes_a_shift(shift: tuple[float, float]) -> None:
    scene = smooth_scene()
    moved = shifted(scene, *shift)
    found = best_shift(moved, scene)

    np.testing.assert_allclose(found, (-shift[0], -shift[1]), atol=0.01)


def test_shift_moves_towards_growing_rows_and_columns() -> None:
    picture = np.zeros((40, 50))
    picture[20, 25] = 1.0

    assert np.unravel_index(shifted(picture, 3.0, -2.0).argmax(), picture.shape) == (23, 23)
    np.testing.assert_array_equal(shifted(picture, 0.0, 0.0), picture)


def test_best_shift_of_a_flat_picture_is_none() -> None:
    assert best_shift(np.full((40, 40), 0.3), np.full((40, 40), 0.3)) == (0.0, 0.0)


def test_registered_psnr_forgives_a_smooth_distortion_but_no_blur() -> None:
    rng = np.random.default_rng(0)
    sharp = ndimage.gaussian_filter(rng.random((256, 384)), 1.0)
    rows, cols = np.mgrid[0:256, 0:384].astype(float)
    bent = ndimage.map_coordinates(sharp, [rows + 0.004 * (cols - 192), cols], order=3, mode="mirror")
    soft = ndimage.gaussian_filter(sharp, 1.0)
    frame = Frame(256, 384)

    shift = best_shift(bent, sharp)
    corner = frame.polar(rows, cols)[0] > CORNER_ZONE_R
    plain = psnr_of(np.square(shifted(bent, *shift)[corner] - sharp[corner]).mean())
    registered, blurred = (fidelity(p, sharp, frame, srgb=False)["corner"] for p in (bent, soft))

    assert registered > plain + 6.0
    assert blurred < registered - 3.0
