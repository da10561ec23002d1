"""Pictures as shown, shifts of them, PSNR, and the local frame of a place."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from lab.images import best_shift, fidelity, psnr_of, shifted, to_srgb
from lab.model_benchmark import pixel_to_local
from lab.scenes import dead_leaves
from lensmodel.core.types import CORNER_ZONE_R, FieldPosition, Frame


def test_psnr_and_the_curve_of_srgb_have_their_known_values() -> None:
    assert psnr_of(0.1**2) == pytest.approx(20.0)
    np.testing.assert_allclose(
        to_srgb(np.array([-1.0, 0.0, 0.0031308, 0.214041, 1.0, 2.0])), [0, 0, 0.04045, 0.5, 1, 1], atol=1e-4
    )


@pytest.mark.parametrize("shift", [(0.3, -0.7), (1.6, 0.0), (-0.05, 2.2)])
def test_best_shift_undoes_a_shift(shift: tuple[float, float]) -> None:
    leaves = dead_leaves(120, 160, np.random.default_rng(1)).astype(np.float64)
    scene = ndimage.gaussian_filter(leaves, (0.0, 1.5, 1.5))
    found = best_shift(shifted(scene, *shift), scene)

    np.testing.assert_allclose(found, (-shift[0], -shift[1]), atol=0.01)
    assert best_shift(np.full((40, 40), 0.3), np.full((40, 40), 0.3)) == (0.0, 0.0)


def test_shift_moves_towards_growing_rows_and_columns() -> None:
    picture = np.zeros((40, 50))
    picture[20, 25] = 1.0

    assert np.unravel_index(shifted(picture, 3.0, -2.0).argmax(), picture.shape) == (23, 23)
    np.testing.assert_array_equal(shifted(picture, 0.0, 0.0), picture)


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


@given(st.floats(-10, 10))
def test_u_points_outwards_and_v_is_u_turned_towards_growing_phi(phi: float) -> None:
    frame = Frame(300, 400)
    near = np.array(frame.pixel(FieldPosition(0.3, phi)))
    far = np.array(frame.pixel(FieldPosition(0.3 + 1 / frame.half_diagonal, phi)))
    middle = np.array(frame.pixel(FieldPosition(0.0, 0.0)))
    beside = np.array(frame.pixel(FieldPosition(1 / frame.half_diagonal, phi + math.pi / 2)))

    assert pixel_to_local(*(far - near), phi) == pytest.approx((1.0, 0.0), abs=1e-9)
    assert pixel_to_local(*(beside - middle), phi) == pytest.approx((0.0, 1.0), abs=1e-9)
