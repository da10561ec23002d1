from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from lensmodel.neural.features import (
    OCTANTS,
    from_octant_image,
    octant_of,
    relative_octant,
    to_octant_image,
    to_octant_place,
)
from lensmodel.neural.statistics import LENGTH, WINDOW, group, patch_statistics, to_octant

COLOURS = np.tile(np.array([[0, 1], [1, 2]], np.int8), (WINDOW // 2, WINDOW // 2))
PLACES = np.array(
    [(0.7, 0.3), (-0.7, 0.3), (0.7, -0.3), (-0.7, -0.3), (0.3, 0.7), (-0.3, 0.7), (0.3, -0.7), (-0.3, -0.7)]
)


def mosaic(seed: int = 0, blur: float = 1.5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = ndimage.gaussian_filter(rng.random((WINDOW, WINDOW)), 2.0) > 0.5
    return (0.1 + 0.7 * ndimage.gaussian_filter(coarse.astype(float), blur)).astype(np.float32)


@pytest.mark.parametrize("octant", range(OCTANTS))
def test_statistics_turn_with_the_picture(octant: int) -> None:
    xy = PLACES[[int(octant_of(place)) for place in PLACES].index(octant)]
    picture = mosaic()
    turned = to_octant(patch_statistics(picture, COLOURS, 1e-3, 1e-5)[None], xy[None])[0]
    again = patch_statistics(
        np.ascontiguousarray(to_octant_image(octant, picture)),
        np.ascontiguousarray(to_octant_image(octant, COLOURS)),
        1e-3,
        1e-5,
    )
    np.testing.assert_allclose(turned, again, atol=2e-4)


@pytest.mark.parametrize("octant", range(OCTANTS))
def test_pictures_and_places_turn_alike(octant: int) -> None:
    picture = np.zeros((5, 5))
    picture[1, 4] = 1.0  # two to the right, one up
    row, col = np.unravel_index(to_octant_image(octant, picture).argmax(), (5, 5))
    assert (col - 2, 2 - row) == tuple(to_octant_place(np.array(octant), np.array([2.0, 1.0])))
    np.testing.assert_array_equal(from_octant_image(octant, to_octant_image(octant, picture)), picture)


def test_relation_of_octants_is_the_same_after_any_symmetry() -> None:
    for symmetry in range(OCTANTS):
        moved = octant_of(to_octant_place(np.array(symmetry), PLACES))
        before = relative_octant(octant_of(PLACES)[:, None], octant_of(PLACES)[None])
        np.testing.assert_array_equal(relative_octant(moved[:, None], moved[None]), before)


def test_blur_shows_in_every_ring_of_the_spectrum_and_in_the_edges() -> None:
    sharp, soft = (patch_statistics(mosaic(blur=b), COLOURS, 1e-4, 0.0) for b in (0.6, 2.0))
    spectra = (sharp - soft)[group("green")].reshape(-1, 8).mean(1)
    assert (spectra[4:9] > 0.5).all()
    near = (soft - sharp)[group("cubed_even")].reshape(-1, 8).mean(1)
    assert near[1] > 0.1  # gradients two pixels apart belong to one edge now


def test_one_sided_blur_shows_in_odd_statistics_and_its_mirror_in_their_opposite() -> None:
    tail = np.zeros((1, 15), np.float32)
    tail[0, 7:] = np.exp(-np.arange(8) / 2.5)
    picture = ndimage.convolve(mosaic(blur=0.4), tail / tail.sum())
    right = patch_statistics(picture, COLOURS, 1e-4, 0.0)[group("cubed_odd")].reshape(-1, 8)[:, 0]
    left = patch_statistics(np.ascontiguousarray(picture[:, ::-1]), COLOURS, 1e-4, 0.0)[group("cubed_odd")]
    assert abs(right[:4]).max() > 0.02
    np.testing.assert_allclose(left.reshape(-1, 8)[:, 0], -right, atol=0.05)


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_a_flat_patch_has_finite_statistics(value: float) -> None:
    flat = np.full((WINDOW, WINDOW), value, np.float32)
    statistics = patch_statistics(flat, COLOURS, 0.0, 0.0)
    assert statistics.shape == (LENGTH,)
    assert np.isfinite(statistics).all()
