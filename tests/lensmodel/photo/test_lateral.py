from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from scipy import ndimage

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import Frame, Planes
from lensmodel.photo import lateral
from lensmodel.photo.lateral import IDENTITY, LateralColour, estimate_lateral, resample

FRAME = Frame(640, 900)


@cache
def scene(seed: int = 0) -> np.ndarray:
    """Return a smooth random texture with features of a few pixels."""
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((FRAME.height, FRAME.width))
    plane = ndimage.gaussian_filter(noise, 1.6) + 2.0 * ndimage.gaussian_filter(noise, 5.0)
    return np.clip(0.4 + 0.5 * plane, 0.02, 0.9).astype(np.float32)


def displaced(plane: np.ndarray, terms: tuple[float, float, float, float]) -> np.ndarray:
    """Return the plane as a lens with this lateral colour shows it, by inverting the polynomial."""
    a, b, c, v = terms
    true_r = np.linspace(0.0, 1.1, 4001)
    seen_r = true_r * (v + true_r * (c + true_r * (b + true_r * a)))
    row_c, col_c = FRAME.center
    rows, cols = np.indices(plane.shape) - np.array([row_c, col_c])[:, None, None]
    r = np.hypot(rows, cols) / FRAME.half_diagonal
    ratio = np.interp(r, seen_r, true_r) / np.maximum(r, 1e-9)
    return ndimage.map_coordinates(
        plane, [rows * ratio + row_c, cols * ratio + col_c], order=5, mode="mirror"
    ).astype(np.float32)


RED = (0.0, 0.0, -0.0012, 1.0028)
BLUE = (0.0, 0.001, 0.0, 0.9985)


@cache
def fringed() -> Planes:
    sharp = scene()
    return np.stack([displaced(sharp, RED) * 0.6, sharp, displaced(sharp, BLUE) * 0.8])


def photo(noise: float = 0.0) -> Planes:
    planes, rng = fringed(), np.random.default_rng(7)
    return (planes + noise * rng.standard_normal(planes.shape)).astype(np.float32)


def worst(found: LateralColour, truth: LateralColour) -> float:
    radii = np.linspace(0.0, 1.0, 41)
    return max(
        abs(found.displacement(r, channel) - truth.displacement(r, channel))
        for r in radii
        for channel in ("r", "b")
    )


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_displacement_curve_is_recovered_to_a_twentieth_of_a_pixel(noise: float) -> None:
    found = estimate_lateral(photo(noise), FRAME)

    assert worst(found, LateralColour(RED, BLUE, FRAME.half_diagonal)) < 0.05
    assert min(found.red_points, found.blue_points) >= 30


def test_aligned_planes_have_no_lateral_colour() -> None:
    sharp, rng = scene(3), np.random.default_rng(1)
    planes = np.stack([sharp * s + 0.005 * rng.standard_normal(sharp.shape) for s in (0.5, 1.0, 0.7)])

    found = estimate_lateral(planes.astype(np.float32), FRAME)

    assert worst(found, LateralColour(IDENTITY, IDENTITY, FRAME.half_diagonal)) < 0.02


def test_flat_planes_claim_nothing() -> None:
    found = estimate_lateral(np.full((3, FRAME.height, FRAME.width), 0.3, dtype=np.float32), FRAME)

    assert (found.red, found.blue, found.red_points) == (IDENTITY, IDENTITY, 0)


def test_a_channel_that_clips_below_the_others_is_judged_by_its_own_level() -> None:
    planes = photo()
    planes[0] = np.minimum(planes[0], 0.15)  # most of red

    assert estimate_lateral(planes, FRAME, clip=(1.0, 1.0, 1.0)).red_points > 0
    assert estimate_lateral(planes, FRAME, clip=(0.15, 1.0, 1.0)).red_points == 0


def test_resampling_moves_red_and_blue_onto_green() -> None:
    planes = photo()

    aligned = resample(planes, FRAME, LateralColour(RED, BLUE, FRAME.half_diagonal))

    inside = np.s_[20:-20, 20:-20]
    for index, gain in ((0, 0.6), (2, 0.8)):
        error = aligned[index][inside] / gain - planes[1][inside]
        assert 20 * np.log10(1 / float(np.sqrt(np.mean(error**2)))) > 45
    np.testing.assert_array_equal(aligned[1], planes[1])


def test_displacement_is_outwards_where_v_is_above_one() -> None:
    lateral = LateralColour((0.0, 0.0, 0.0, 1.001), (0.0, 0.0, 0.0, 0.999), 1000.0)

    assert lateral.displacement(1.0, "r") == pytest.approx(1.0)
    assert lateral.displacement(0.5, "b") == pytest.approx(-0.5)
    assert lateral.displacement(0.5, "g") == 0.0


def test_absurd_scale_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="near 1"):
        LateralColour((0.0, 0.0, 0.0, 2.0), IDENTITY, 100.0)


@pytest.mark.parametrize("pixels", [lambda r: 50.0 * r, lambda r: -40.0 * r, lambda r: 7.0 + 0.0 * r])
@pytest.mark.parametrize("side", [150, 200])
def test_what_a_small_photo_cannot_tell_is_bounded(pixels: Callable, side: int) -> None:
    rng, frame = np.random.default_rng(0), Frame(side, side + 40)
    r = rng.uniform(0.02, 0.15, 40)  # corners near the centre only, and matched wrongly
    red = lateral._fit(r, pixels(r) + rng.normal(0.0, 0.3, r.size), frame.half_diagonal)

    assert np.abs(np.subtract(red, IDENTITY)).max() == pytest.approx(0.1)
    LateralColour(red, IDENTITY, frame.half_diagonal)
