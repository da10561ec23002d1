"""The audit leaves sound corrections alone and holds each kind of fault back where it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from lab.kernels import gaussian
from lensmodel.core.codec import from_json, to_json
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import NoiseModel, Planes
from lensmodel.correction.audit import (
    CHECKS,
    AuditReport,
    Evidence,
    audit_tile,
    held_back,
    pooled,
)
from lensmodel.correction.blur import UniformBlur

SIDE = 160
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


def evidence(kernel: NDArray[np.float64] | None = KERNEL) -> Evidence:
    blurs = None if kernel is None else [UniformBlur(kernel)] * 3
    return Evidence([NOISE] * 3, blurs=blurs)


LIGHT = scene()
PHOTO = photo_of(LIGHT)
SOUND = LIGHT + np.float32(0.002) * np.random.default_rng(2).standard_normal(LIGHT.shape).astype(np.float32)


# --- what is sound ------------------------------------------------------------------------------


def test_a_photo_that_was_not_changed_is_kept_to_the_last_bit() -> None:
    planes, audit = held_back(PHOTO, PHOTO.copy(), evidence(None))

    assert np.array_equal(planes, PHOTO)
    assert audit.held_back == 0.0
    assert set(audit.checks.values()) == {0.0}


def test_the_true_scene_is_kept() -> None:
    audit = audit_tile(PHOTO, SOUND, evidence())

    assert audit.held_back < 0.01


@settings(max_examples=15)
@given(seed=st.integers(0, 2**16))
def test_what_is_kept_is_a_share(seed: int) -> None:
    rng = np.random.default_rng(seed)
    before, after = (rng.uniform(-1.0, 2.0, (3, 40, 37)).astype(np.float32) for _ in range(2))

    audit = audit_tile(before, after, evidence(None))

    assert audit.keep.shape == (40, 37)
    assert audit.keep.dtype == np.float32
    assert audit.keep.min() >= 0.0
    assert audit.keep.max() <= 1.0
    assert set(audit.checks) == set(CHECKS) - {"re-blur"}  # no PSF is known


# --- each fault ---------------------------------------------------------------------------------


def share_of(check: str, corrected: Planes, known: Evidence | None = None) -> float:
    audit = audit_tile(PHOTO, corrected.astype(np.float32), known or evidence())
    return audit.checks[check]


def test_a_single_dot_is_isolated_and_taken_away_there_alone() -> None:
    dotted = SOUND.copy()
    dotted[1, 80, 80] += 0.5

    planes, audit = held_back(PHOTO, dotted, evidence(None))

    assert audit.keep[80, 80] < 0.2
    assert abs(planes[1, 80, 80] - PHOTO[1, 80, 80]) < 0.15
    apart = np.ones((SIDE, SIDE), dtype=bool)
    apart[60:101, 60:101] = False
    clean = audit_tile(PHOTO, SOUND, evidence(None))
    assert np.array_equal(audit.keep[apart], clean.keep[apart])


@pytest.mark.parametrize("period", [2.0, 2.5, 3.0])
def test_fine_lines_on_even_ground_are_too_much_power(period: float) -> None:
    flat = np.full((3, SIDE, SIDE), 0.3, dtype=np.float32)
    flat += np.float32(NOISE.sigma_at(0.3)) * np.random.default_rng(5).standard_normal(flat.shape)
    flat = flat.astype(np.float32)
    lines = (0.05 * np.cos(2 * np.pi / period * np.arange(SIDE)[None, :])).astype(np.float32)

    for made, low, high in ((flat + lines, 0.5, 1.0), (flat + lines.T, 0.5, 1.0), (flat, 0.0, 0.0)):
        audit = audit_tile(flat, made, evidence(None))
        assert low <= audit.checks["spectrum"] <= high


def test_lines_that_the_photo_shows_too_may_gain_contrast() -> None:
    lines = (0.05 * np.cos(np.pi * np.arange(SIDE)[None, :])).astype(np.float32)

    audit = audit_tile(PHOTO + lines, SOUND + np.float32(2.0) * lines, evidence(None))

    assert audit.checks["spectrum"] < 0.01


def test_erased_texture_does_not_blur_to_the_photo() -> None:
    rng = np.random.default_rng(3)
    texture = ndimage.gaussian_filter(rng.standard_normal((3, SIDE, SIDE)), (0, 1.5, 1.5))
    photo = photo_of(LIGHT + np.float32(0.3) * texture.astype(np.float32))

    audit = audit_tile(photo, SOUND, evidence())

    assert audit.checks["re-blur"] > 0.5
    assert share_of("re-blur", SOUND) < 0.01


def test_an_uncertain_kernel_may_leave_more() -> None:
    far_too_much = LIGHT + 4.0 * (LIGHT - PHOTO)

    sure = share_of("re-blur", far_too_much)
    unsure = share_of("re-blur", far_too_much, replace(evidence(), psf_errors=(1.0, 1.0, 1.0)))

    assert sure > 0.2
    assert unsure < 0.2 * sure


def test_a_correction_that_explains_the_photo_better_than_the_photo_itself_is_kept() -> None:
    too_wide = evidence(gaussian(31, np.eye(2) * 25.0))

    assert share_of("re-blur", LIGHT, too_wide) == 0.0
    assert share_of("re-blur", LIGHT + 4.0 * (LIGHT - PHOTO), evidence()) > 0.2


def test_only_measured_pixels_are_blurred_to() -> None:
    known = np.indices((SIDE, SIDE))[1] < SIDE // 2
    photo = np.where(known, PHOTO, np.float32(0.9))
    masked = Evidence([NOISE] * 3, blurs=[UniformBlur(KERNEL)] * 3, measured=[known] * 3)

    def share(facts: Evidence) -> float:
        audit = audit_tile(photo, LIGHT, facts)
        return audit.checks["re-blur"]

    assert share(masked) == 0.0
    assert share(evidence()) > 0.5


def test_noise_made_ten_times_as_strong_is_too_much_power() -> None:
    flat = np.full((3, SIDE, SIDE), 0.3, dtype=np.float32)
    rng = np.random.default_rng(5)
    grain = rng.standard_normal(flat.shape) * NOISE.sigma_at(0.3)

    audit = audit_tile(
        (flat + grain).astype(np.float32), (flat + 10 * grain).astype(np.float32), evidence(None)
    )

    assert audit.checks["spectrum"] > 0.5


def test_light_beyond_saturation_is_judged_as_it_is_written() -> None:
    photo, glowing = SOUND.copy(), SOUND.copy()
    photo[:, 70:90, 70:90] = 1.0
    glowing[:, 70:90, 70:90] = 1.0 + 5.0 * np.random.default_rng(7).random((3, 20, 20))

    assert audit_tile(photo, glowing, evidence(None)).held_back < 0.01


# --- the map ------------------------------------------------------------------------------------


def test_the_map_is_smooth() -> None:
    spoiled = SOUND.copy()
    spoiled[:, 50:110, 50:110] = np.random.default_rng(8).random((3, 60, 60))

    keep = audit_tile(PHOTO, spoiled, evidence()).keep

    assert keep.min() == 0.0
    assert max(abs(np.diff(keep, axis=axis)).max() for axis in (0, 1)) < 0.35


def test_the_inner_part_is_judged_with_what_is_around() -> None:
    spoiled = SOUND.copy()
    spoiled[0, 60:100, 60:100] *= 0.3
    inner = (slice(30, 120), slice(40, 130))

    planes, audit = held_back(PHOTO, spoiled, evidence(), inner=inner)

    whole = audit_tile(PHOTO, spoiled, evidence())
    assert planes.shape == (3, 90, 90)
    assert np.array_equal(audit.keep, whole.keep[inner])


def test_a_report_names_zone_check_and_tile() -> None:
    spoiled = scene(4)
    photo = photo_of(spoiled)
    spoiled[0, 4:40, 4:40] *= 0.2

    report = pooled([("mid", (0, 0), audit_tile(photo, spoiled, evidence()))])

    assert {name: zone.tiles for name, zone in report.zones.items()} == {"mid": 1}
    assert {tile.row for tile in report.tiles} == {0}
    assert "re-blur" in report.zones["mid"].checks
    assert 0.0 < report.held_back < 0.6
    assert from_json(AuditReport, to_json(report)) == report


def test_zones_are_means_over_their_tiles() -> None:
    clean = audit_tile(PHOTO, PHOTO, evidence(None)).without_map()
    bad = audit_tile(PHOTO, np.random.default_rng(1).random(PHOTO.shape, dtype=np.float32), evidence())

    report = pooled([("center", (0, 0), clean), ("center", (0, 160), bad.without_map())])

    assert report.zones["center"].tiles == 2
    assert report.zones["center"].tiles_held == 1
    assert report.zones["center"].held_back == pytest.approx(bad.held_back / 2)
    assert report.held_back == pytest.approx(bad.held_back / 2)
    assert clean.keep.size == 0


# --- tools --------------------------------------------------------------------------------------


def test_planes_of_different_sizes_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="one size"):
        audit_tile(PHOTO, PHOTO[:, :-1], evidence())


def test_evidence_is_for_three_channels() -> None:
    with pytest.raises(InvalidInputError, match="per channel"):
        Evidence([NOISE] * 2)
