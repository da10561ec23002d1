"""The audit leaves sound corrections alone and holds each kind of fault back where it is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from lab.kernels import gaussian
from lensmodel.core.files import from_json, to_json
from lensmodel.core.types import NoiseModel, Plane, Planes
from lensmodel.correction.audit import LIMITS, Audit, held_back
from lensmodel.correction.blur import UniformBlur, Window
from lensmodel.correction.deconvolver import Sensor

SIDE = 160
WHOLE = (slice(0, SIDE), slice(0, SIDE))
NOISE = NoiseModel(1 / 20_000, 0.001**2)
KERNEL = gaussian(11, np.eye(2) * 1.2)


def scene(seed: int = 0, side: int = SIDE) -> Planes:
    """Discs of different light and colour in front of each other, edges a pixel wide."""
    rng = np.random.default_rng(seed)
    rows, cols = np.indices((side, side)).astype(np.float32)
    light = np.full((3, side, side), 0.3, dtype=np.float32)
    for _ in range(side):
        y, x = rng.uniform(-5, side + 5, 2)
        radius = rng.uniform(3, 30)
        # a disc is painted where it is: over the whole frame that took most of the time of these tests
        box = tuple(slice(max(int(at - radius) - 1, 0), int(at + radius) + 2) for at in (y, x))
        inside = np.clip(radius - np.hypot(rows[box] - y, cols[box] - x) + 0.5, 0.0, 1.0)
        colour = rng.uniform(0.1, 0.7) * rng.uniform(0.7, 1.0, 3)
        part = light[:, *box]
        part += inside * (colour[:, None, None].astype(np.float32) - part)
    return ndimage.gaussian_filter(light, (0, 0.6, 0.6))


def photo_of(light: Planes, seed: int = 1) -> Planes:
    rng = np.random.default_rng(seed)
    blur = UniformBlur(KERNEL)
    blurred = np.stack([blur.forward(np.pad(plane, blur.reach, mode="edge")) for plane in light])
    return (blurred + rng.standard_normal(light.shape) * np.sqrt(NOISE.variance(blurred))).astype(np.float32)


def kept(
    photo: Planes,
    made: Planes,
    kernel: NDArray[np.float64] | None = KERNEL,
    *,
    error: float = 0.0,
    measured: NDArray[np.bool_] | None = None,
    inner: Window = WHOLE,
) -> tuple[Plane, dict[str, float]]:
    blurs = None if kernel is None else [UniformBlur(kernel)] * 3
    sensors = [Sensor(NOISE, 1.0, measured)] * 3
    _, keep, audit = held_back(photo, made.astype(np.float32), blurs, sensors, [error] * 3, inner)
    return keep, dict(audit.checks)


def share_of(check: str, made: Planes, photo: Planes | None = None, *kernel: Any, **known: Any) -> float:
    return kept(PHOTO if photo is None else photo, made, *kernel, **known)[1][check]


LIGHT = scene()
PHOTO = photo_of(LIGHT)
SOUND = LIGHT + np.float32(0.002) * np.random.default_rng(2).standard_normal(LIGHT.shape).astype(np.float32)


def test_a_photo_that_was_not_changed_is_kept_to_the_last_bit() -> None:
    planes, _, audit = held_back(PHOTO, PHOTO.copy(), None, [Sensor(NOISE, 1.0)] * 3, [0.0] * 3, WHOLE)

    assert np.array_equal(planes, PHOTO)
    assert audit.held_back == 0.0
    assert set(audit.checks.values()) == {0.0}


def test_the_true_scene_is_kept() -> None:
    assert kept(PHOTO, SOUND)[0].mean() > 0.99


@settings(max_examples=15)
@given(seed=st.integers(0, 2**16))
def test_what_is_kept_is_a_share(seed: int) -> None:
    rng = np.random.default_rng(seed)
    before, after = (rng.uniform(-1.0, 2.0, (3, 40, 37)).astype(np.float32) for _ in range(2))

    keep, checks = kept(before, after, None)

    assert (keep.shape, keep.dtype) == ((40, 37), np.float32)
    assert 0.0 <= keep.min() <= keep.max() <= 1.0
    assert set(checks) == set(LIMITS) - {"re-blur"}  # no PSF is known


def test_a_single_dot_is_isolated_and_taken_away_there_alone() -> None:
    dotted = SOUND.copy()
    dotted[1, 80, 80] += 0.5

    planes, keep, _ = held_back(PHOTO, dotted, None, [Sensor(NOISE, 1.0)] * 3, [0.0] * 3, WHOLE)

    assert keep[80, 80] < 0.2
    assert abs(planes[1, 80, 80] - PHOTO[1, 80, 80]) < 0.15
    apart = np.ones((SIDE, SIDE), dtype=bool)
    apart[60:101, 60:101] = False
    assert np.array_equal(keep[apart], kept(PHOTO, SOUND, None)[0][apart])


def even_grain() -> NDArray[np.float32]:
    grain = np.random.default_rng(5).standard_normal((3, SIDE, SIDE)) * NOISE.sigma_at(0.3)
    return grain.astype(np.float32)


@pytest.mark.parametrize("period", [2.0, 2.5, 3.0])
def test_fine_lines_on_even_ground_are_too_much_power(period: float) -> None:
    flat = np.float32(0.3) + even_grain()
    lines = (0.05 * np.cos(2 * np.pi / period * np.arange(SIDE)[None, :])).astype(np.float32)

    for made, low, high in ((flat + lines, 0.5, 1.0), (flat + lines.T, 0.5, 1.0), (flat, 0.0, 0.0)):
        assert low <= share_of("spectrum", made, flat, None) <= high


def test_noise_made_ten_times_as_strong_is_too_much_power() -> None:
    flat, grain = np.float32(0.3), even_grain()

    assert share_of("spectrum", flat + 10 * grain, flat + grain, None) > 0.5


def test_lines_that_the_photo_shows_too_may_gain_contrast() -> None:
    lines = (0.05 * np.cos(np.pi * np.arange(SIDE)[None, :])).astype(np.float32)

    assert share_of("spectrum", SOUND + np.float32(2.0) * lines, PHOTO + lines, None) < 0.01


def test_erased_texture_does_not_blur_to_the_photo() -> None:
    rng = np.random.default_rng(3)
    texture = ndimage.gaussian_filter(rng.standard_normal((3, SIDE, SIDE)), (0, 1.5, 1.5))
    photo = photo_of(LIGHT + np.float32(0.3) * texture.astype(np.float32))

    assert share_of("re-blur", SOUND, photo) > 0.5
    assert share_of("re-blur", SOUND) < 0.01


def test_an_uncertain_kernel_may_leave_more() -> None:
    far_too_much = LIGHT + 4.0 * (LIGHT - PHOTO)

    sure, unsure = (share_of("re-blur", far_too_much, error=error) for error in (0.0, 1.0))

    assert sure > 0.2
    assert unsure < 0.2 * sure


def test_a_correction_that_explains_the_photo_better_than_the_photo_itself_is_kept() -> None:
    assert share_of("re-blur", LIGHT, kernel=gaussian(31, np.eye(2) * 25.0)) == 0.0


def test_only_measured_pixels_are_blurred_to() -> None:
    known = np.indices((SIDE, SIDE))[1] < SIDE // 2
    photo = np.where(known, PHOTO, np.float32(0.9))

    assert share_of("re-blur", LIGHT, photo, measured=known) == 0.0
    assert share_of("re-blur", LIGHT, photo) > 0.5


def test_light_beyond_saturation_is_judged_as_it_is_written() -> None:
    photo, glowing = SOUND.copy(), SOUND.copy()
    photo[:, 70:90, 70:90] = 1.0
    glowing[:, 70:90, 70:90] = 1.0 + 5.0 * np.random.default_rng(7).random((3, 20, 20))

    assert kept(photo, glowing, None)[0].mean() > 0.99


def test_the_map_is_smooth() -> None:
    spoiled = SOUND.copy()
    spoiled[:, 50:110, 50:110] = np.random.default_rng(8).random((3, 60, 60))

    keep, _ = kept(PHOTO, spoiled)

    assert keep.min() == 0.0
    assert max(abs(np.diff(keep, axis=axis)).max() for axis in (0, 1)) < 0.35


def test_the_inner_part_is_judged_with_what_is_around() -> None:
    spoiled = SOUND.copy()
    spoiled[0, 60:100, 60:100] *= 0.3
    inner = (slice(30, 120), slice(40, 130))

    keep = kept(PHOTO, spoiled, inner=inner)[0]

    assert keep.shape == (90, 90)
    assert np.array_equal(keep, kept(PHOTO, spoiled)[0][inner])


def test_the_audit_of_a_photo_is_the_mean_over_its_tiles() -> None:
    clean, bad = Audit(0.0, {"re-blur": 0.0, "spectrum": 0.0}), Audit(0.5, {"re-blur": 0.5, "spectrum": 0.0})

    report = Audit.mean([clean, bad])

    assert report == Audit(0.25, {"re-blur": 0.25})
    assert Audit.mean([]) == Audit()
    assert from_json(Audit, to_json(report)) == report
