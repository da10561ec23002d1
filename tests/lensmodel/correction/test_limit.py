"""The limit: light within the photo's range, widened by what blur hides; colours from nearby."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from lab.kernels import gaussian
from lensmodel.core.types import NoiseModel, Planes
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.limit import extremes, limited, widening

BLUR = UniformBlur(gaussian(15, np.eye(2) * 1.5**2))
SENSOR = Sensor(NoiseModel(1e-6, 1e-8), clip=1.0)
SURE, UNSURE = 0.05, 0.3


def held(photo: Planes, made: Planes, error: float, halo: float | None = None) -> Planes:
    return limited(photo, made, [BLUR] * 3, [SENSOR] * 3, [error] * 3, halo)


def held_pixel(
    photo: Planes,
    at: tuple[int, int],
    made: tuple[float, float, float],
    error: float,
    halo: float | None = None,
) -> np.ndarray:
    """What is left of one pixel that a correction made."""
    planes = photo.copy()
    planes[:, *at] = made
    return held(photo, planes, error, halo)[:, *at]


def grey(plane: np.ndarray) -> Planes:
    return np.stack([plane] * 3).astype(np.float32)


def even(*colour: float, side: int = 16) -> Planes:
    return np.full((side, side, 3), colour, dtype=np.float32).transpose(2, 0, 1).copy()


def nearby(photo: Planes) -> tuple[Planes, Planes]:
    """The least and the greatest value within two pixels."""
    window = (1, 5, 5)
    return tuple(f(photo, window, mode="nearest") for f in (ndimage.minimum_filter, ndimage.maximum_filter))


def blurred(plane: np.ndarray) -> Planes:
    return grey(ndimage.gaussian_filter(plane, 1.5, mode="nearest"))


def step() -> np.ndarray:
    plane = np.full((48, 64), 0.1)
    plane[:, 32:] = 0.6
    return plane


def overshoot(made: Planes) -> float:
    """How far a plane leaves the levels of `step`, as a share of it as seen."""
    low, high = np.array([0.1, 0.6]) ** (1 / 2.2)
    shown = np.maximum(made[1, 12:-12, 12:-12], 0.0) ** (1 / 2.2)
    return float(max(shown.max() - high, low - shown.min()) / (high - low))


@settings(max_examples=20)
@given(seed=st.integers(0, 2**16))
def test_a_photo_that_was_not_changed_stays_as_it_is(seed: int) -> None:
    photo = np.random.default_rng(seed).uniform(0.0, 1.2, (3, 20, 23)).astype(np.float32)

    np.testing.assert_allclose(held(photo, photo, UNSURE), photo, atol=1e-6)


def test_what_was_made_is_not_changed_in_place() -> None:
    photo = blurred(step())
    made = photo + np.float32(3.0) * (photo - ndimage.gaussian_filter(photo, (0, 2, 2)))
    before = made.copy()

    assert not np.array_equal(held(photo, made, UNSURE), made)
    np.testing.assert_array_equal(made, before)


@pytest.mark.parametrize("error", [0.1, UNSURE])
def test_an_edge_behind_an_unsure_kernel_gets_no_halo(error: float) -> None:
    photo = blurred(step())
    made = photo + np.float32(2.0) * (photo - ndimage.gaussian_filter(photo, (0, 2, 2)))

    assert overshoot(made) > 0.25
    assert overshoot(held(photo, made, error)) < 0.09


def test_the_edge_itself_gets_as_steep_as_it_was_made() -> None:
    photo, made = blurred(step()), grey(step())

    np.testing.assert_allclose(held(photo, made, UNSURE), made, atol=0.01)


@pytest.mark.parametrize("bright", [0.5, 0.02])
def test_a_line_that_blur_made_faint_comes_back_where_the_kernel_is_sure(bright: float) -> None:
    plane = np.full((48, 64), 0.15)
    plane[:, 32] = bright
    photo, made = blurred(plane), grey(plane)

    result = held(photo, made, SURE)

    assert abs(result[1, 24, 32] - 0.15) > 0.7 * abs(bright - 0.15)
    assert abs(held(photo, made, 0.5)[1, 24, 32] - 0.15) < 0.7 * abs(bright - 0.15)


def test_beside_clipped_light_nothing_leaves_the_range_nearby() -> None:
    plane = np.full((48, 64), 0.2)
    plane[20:26, 30:36] = 6.0
    photo = np.minimum(blurred(plane), 1.0)
    made = photo + np.random.default_rng(0).normal(0.0, 0.1, photo.shape).astype(np.float32)
    made[:, 23, 40] = (0.9, 0.0, 0.9)

    result = held(photo, made, UNSURE)

    near = ndimage.binary_dilation(photo[0] >= 1.0, iterations=3)
    low, high = nearby(photo)
    assert (result >= low - 1e-5)[:, near].all()
    assert (result <= high + 1e-5)[:, near & (photo[0] < 1.0)].all()


def white_sun(colours: tuple[float, float, float]) -> Planes:
    """A disc deeper than the blur, so many times as bright as saturation, on dim ground, as recorded."""
    rows, cols = np.indices((96, 96))
    disc = (np.hypot(rows - 48, cols - 48) < 22).astype(np.float64)
    light = np.stack([0.05 + level * disc for level in colours])
    return np.minimum(ndimage.gaussian_filter(light, (0, 1.5, 1.5)), 1.0).astype(np.float32)


@pytest.mark.parametrize("error", [0.0, UNSURE])
def test_around_a_white_area_no_pixel_gets_brighter_or_darker_than_all_nearby(error: float) -> None:
    photo = white_sun((8.0, 8.0, 8.0))
    ring = (photo[1] < 1.0) & (photo[1] > 0.5)
    darker, brighter = (np.where(ring, np.float32(level), photo).astype(np.float32) for level in (0.0, 1.0))

    assert (held(photo, darker, error) >= nearby(photo)[0] - 1e-5).all()
    assert (held(photo, brighter, error) <= photo + 1e-5).all()


def test_paint_of_which_one_colour_clips_may_get_darker_lines_than_white_may() -> None:
    for colours, paint in (((1.5, 0.6, 0.6), True), ((1.5, 1.5, 1.5), False)):
        photo = white_sun(colours)
        line = np.zeros(photo.shape[1:], dtype=bool)
        line[48, 70 if paint else 73] = True  # where light falls off beside the disc
        change = np.where(line, np.float32(0.0), photo).astype(np.float32)

        result = held(photo, change, SURE)[:, line]

        least, floor = (ndimage.minimum_filter(photo, (1, side, side))[:, line] for side in (5, 7))
        assert (result[1] < least[1] - 0.001).any() == paint
        assert (result.sum(axis=0) > floor.sum(axis=0) - 0.001).all()
        # paint is held by the hues within 2 pixels: its green gives red a little light
        assert (result > (0.89 * floor if paint else floor - 0.001)).all()


def test_white_of_which_one_colour_is_only_nearly_clipped_stays_white() -> None:
    photo = white_sun((8.0, 8.0, 8.0))
    photo[0, 48, 60:66] = 0.9
    made = photo.copy()
    made[:, 48, 60:66] = np.array([[-1.0], [-1.5], [-2.0]])

    np.testing.assert_allclose(held(photo, made, SURE)[:, 48, 60:66], photo[:, 48, 60:66], atol=1e-6)


def test_beside_a_lamp_that_blur_kept_below_clipping_no_pixel_gets_darker_than_all_nearby() -> None:
    plane = np.full((48, 64), 0.1)
    plane[24, 32] = 6.0
    photo, made = blurred(plane), grey(plane)
    assert photo.max() < 1.0
    made[:, 24, 38] = 0.01

    assert (held(photo, made, SURE)[:, 24, 38] > 0.095).all()


@pytest.mark.parametrize("halo", [0.0, 0.5])
def test_a_halo_that_was_chosen_bounds_every_colour(halo: float) -> None:
    rng = np.random.default_rng(1)
    photo, made = (rng.uniform(low, high, (3, 30, 40)).astype(np.float32) for low, high in ((0, 1), (-1, 2)))
    low, high = nearby(photo)

    result = held(photo, made, SURE, halo)

    assert (result >= low - halo * (high - low) - 1e-6).all()
    assert (result <= high + halo * (high - low) + 1e-6).all()


@pytest.mark.parametrize(("error", "purer", "grey"), [(SURE, 0.04, 0.05), (UNSURE, 0.01, 0.02)])
@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), purity=st.floats(0.0, 0.5))
def test_no_hue_leaves_those_nearby_and_the_light_stays(
    error: float, purer: float, grey: float, seed: int, purity: float
) -> None:
    rng = np.random.default_rng(seed)
    level = rng.uniform(0.2, 0.6, (1, 20, 24)).repeat(3, axis=0)
    photo = (level * (1.0 + purity * rng.uniform(-1.0, 1.0, level.shape))).astype(np.float32)
    made = (photo * rng.uniform(0.3, 2.0, photo.shape)).astype(np.float32)

    result = held(photo, made, error, np.inf)

    np.testing.assert_allclose(result.sum(axis=0), made.sum(axis=0), rtol=1e-4)

    def differences(planes: Planes, floor: np.ndarray) -> Planes:
        shares = (planes + floor / 3) / (planes.sum(axis=0) + floor)
        return np.asarray(shares - np.roll(shares, -1, axis=0))

    brightest = ndimage.maximum_filter(photo.sum(axis=0), 5, mode="nearest")
    lent, own, after = (
        differences(planes, share * brightest)
        for planes, share in ((photo, 0.05), (photo, grey), (result, grey))
    )
    low, high = nearby(lent)
    low, high = np.minimum(low, own), np.maximum(high, own)
    assert (after >= low - purer - 0.002).all()
    assert (after <= high + purer + 0.002).all()


def test_a_dark_speck_lends_no_colour_to_the_light_beside_it() -> None:
    photo = even(0.3, 0.3, 0.3)
    photo[:, 8, 10] = (0.001, 0.001, 0.008)

    result = held_pixel(photo, (8, 8), (0.15, 0.15, 0.6), SURE, np.inf)

    np.testing.assert_allclose(result / result.sum(), 1.0 / 3.0, atol=0.12)  # the speck's is .8
    assert result.sum() == pytest.approx(0.9, rel=1e-3)


def test_noise_of_a_colour_that_is_nearly_absent_stays_small() -> None:
    """Yellow petals: their blue has next to no light, and a speck of it shows."""
    photo = even(0.25, 0.6, 0.001, side=24)

    assert held_pixel(photo, (12, 12), (0.25, 0.6, 0.04), UNSURE)[2] < 0.005


def test_a_pixel_inside_white_gets_no_darker_however_near_its_rim() -> None:
    photo = even(0.05, 0.05, 0.05, side=48)
    photo[:, 20:25, 20:25] = 1.0
    photo[:, 21, 22] = 0.985  # sensors do not clip at one level

    assert held_pixel(photo, (21, 22), (0.7, 1.0, 1.0), UNSURE)[0] >= 0.985


def test_a_black_letter_on_white_gets_no_green() -> None:
    photo = even(0.8, 0.8, 0.8, side=24)
    photo[:, 8:16, 10:13] = 0.03
    photo[1, 11, 10], photo[0, 13, 12] = 0.045, 0.04

    r, g, b = held_pixel(photo, (12, 11), (0.0001, 0.03, 0.0005), UNSURE)

    assert g - min(r, b) < 0.01


def test_a_colour_may_get_purer_where_the_kernel_is_sure() -> None:
    photo, purer = even(0.3, 0.3, 0.3), (0.315, 0.3, 0.285)

    sure, unsure = (held_pixel(photo, (8, 8), purer, error, np.inf) for error in (SURE, UNSURE))

    np.testing.assert_allclose(sure, purer, atol=1e-4)
    assert unsure[0] - unsure[2] < 0.011  # .01 of the light's .9, and a little for the grey that is added


def test_two_hues_of_the_surroundings_do_not_allow_a_third() -> None:
    """Brown beside grey: each colour's share of purple is within the range of theirs, purple is not."""
    photo = even(0.33, 0.20, 0.09)
    photo[:, :, 8:] = 0.4

    r, g, b = held_pixel(photo, (8, 8), (0.5, 0.25, 0.45), SURE, np.inf)

    assert g > min(r, b) - 0.05 * (r + g + b)


def test_white_that_is_no_longer_clipped_takes_the_hue_around_it() -> None:
    photo = even(0.5, 0.3, 0.1, side=20)
    photo[:, 9:11, 9:11] = 1.0

    r, g, b = held_pixel(photo, (9, 9), (0.5, 0.6, 0.9), SURE)

    assert r > g > b


def test_room_is_the_less_the_less_sure_the_kernel() -> None:
    rooms = np.array([widening(error) for error in (0.05, 0.1, 0.24, 0.5)])

    assert (np.diff(rooms, axis=0) <= 0.0).all()
    assert rooms[2][0] == pytest.approx(1.0)
    assert rooms[-1][1] == pytest.approx(0.06)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**16), reach=st.integers(1, 7))
def test_extremes_are_those_of_rank_filters(seed: int, reach: int) -> None:
    plane = np.random.default_rng(seed).random((31, 26), dtype=np.float32)

    low, high = extremes(plane, plane, reach)

    side = 2 * reach + 1
    np.testing.assert_array_equal(low, ndimage.minimum_filter(plane, side, mode="nearest"))
    np.testing.assert_array_equal(high, ndimage.maximum_filter(plane, side, mode="nearest"))
