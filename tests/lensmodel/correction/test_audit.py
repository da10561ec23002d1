"""The audit leaves sound corrections alone and holds each kind of fault back where it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.codec import from_json, to_json
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import as_kernel, gaussian
from lensmodel.core.types import FieldPosition, NoiseModel, Planes
from lensmodel.correction.audit import (
    CHECKS,
    AuditReport,
    Evidence,
    audit_photo,
    audit_tile,
    held_back,
    nearby,
    pooled,
)
from lensmodel.correction.audit.reblur import reblurred
from lensmodel.correction.audit.tolerances import LIMITS
from lensmodel.correction.audit.whole_photo import TILE, Window
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
    blurred = np.stack([reblurred(plane, UniformBlur(KERNEL)) for plane in light])
    return (blurred + rng.standard_normal(light.shape) * np.sqrt(NOISE.variance(blurred))).astype(np.float32)


def evidence(kernel: NDArray[np.float64] | None = KERNEL) -> Evidence:
    blurs = None if kernel is None else [UniformBlur(kernel)] * 3
    return Evidence([NOISE] * 3, blurs=blurs)


def everywhere(place: FieldPosition, window: Window) -> Evidence:
    return evidence()


LIGHT = scene()
PHOTO = photo_of(LIGHT)
SOUND = LIGHT + np.float32(0.002) * np.random.default_rng(2).standard_normal(LIGHT.shape).astype(np.float32)


# --- what is sound ------------------------------------------------------------------------------


def test_a_photo_that_was_not_changed_is_kept_to_the_last_bit() -> None:
    planes, audit = held_back(PHOTO, PHOTO.copy(), evidence(None))

    assert np.array_equal(planes, PHOTO)
    assert audit.held_back == 0.0
    assert audit.reasons == ()


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
    assert [finding.check for finding in audit.findings] == list(CHECKS)


def test_every_check_has_a_limit() -> None:
    assert set(LIMITS) == set(CHECKS)


# --- each fault ---------------------------------------------------------------------------------


def share_of(check: str, corrected: Planes, known: Evidence | None = None) -> float:
    audit = audit_tile(PHOTO, corrected.astype(np.float32), known or evidence())
    return next(finding.held_back for finding in audit.findings if finding.check == check)


def test_light_below_nothing_is_too_dark() -> None:
    sharpened = PHOTO + 8.0 * (PHOTO - ndimage.gaussian_filter(PHOTO, (0, 2, 2)))

    assert share_of("too dark", sharpened) > 10 * share_of("too dark", SOUND) + 0.1


def test_lights_out_of_nowhere_are_too_bright() -> None:
    spots = SOUND.copy()
    spots[:, 20:140:6, 20:140:6] += 0.6

    assert share_of("too bright", spots) > 0.05
    assert share_of("too bright", SOUND) == 0.0


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


def test_a_colour_that_is_gone_is_a_foreign_hue() -> None:
    cyan = SOUND.copy()
    cyan[0, 60:100, 60:100] = 0.0

    assert share_of("hue, area", cyan) > 0.1
    assert share_of("hue, area", SOUND) < 0.005


def test_a_single_colourful_pixel_is_a_spot_of_hue() -> None:
    grey = np.full((3, SIDE, SIDE), 0.4, dtype=np.float32)
    spotted = grey.copy()
    spotted[:, 80, 80] = (0.6, 0.0, 0.0)

    audit = audit_tile(grey, spotted, evidence(None))

    assert next(f.worst for f in audit.findings if f.check == "hue, spots") > 1.5
    assert audit.keep[80, 80] < 0.1


def test_a_colour_that_falls_beside_white_is_a_spot_of_hue() -> None:
    white = np.ones((3, SIDE, SIDE), dtype=np.float32)
    yellow = white.copy()
    yellow[2, 40:44, 50] = 0.6
    grey, dim = 0.5 * white, 0.5 * yellow

    beside_white, elsewhere = (
        audit_tile(before, after, evidence(None)).keep[41, 50]
        for before, after in ((white, yellow), (grey, dim))
    )

    assert beside_white < 0.1
    assert elsewhere == 1.0


@pytest.mark.parametrize("period", [2.0, 2.5, 3.0])
def test_fine_lines_are_a_comb(period: float) -> None:
    lines = 0.03 * np.cos(2 * np.pi / period * np.arange(SIDE)[None, :])

    assert share_of("comb", SOUND + lines) > 0.5
    assert share_of("comb", SOUND + lines.T) > 0.5
    assert share_of("comb", SOUND) < 0.01


def test_lines_that_the_photo_shows_too_are_no_comb() -> None:
    lines = (0.03 * np.cos(np.pi * np.arange(SIDE)[None, :])).astype(np.float32)

    audit = audit_tile(PHOTO + lines, SOUND + np.float32(2.0) * lines, evidence(None))

    assert next(f.held_back for f in audit.findings if f.check == "comb") < 0.01


def test_erased_texture_does_not_blur_to_the_photo() -> None:
    rng = np.random.default_rng(3)
    texture = ndimage.gaussian_filter(rng.standard_normal((3, SIDE, SIDE)), (0, 1.5, 1.5))
    photo = photo_of(LIGHT + np.float32(0.3) * texture.astype(np.float32))

    audit = audit_tile(photo, SOUND, evidence())

    assert next(f.held_back for f in audit.findings if f.check == "re-blur") > 0.5
    assert share_of("re-blur", SOUND) < 0.01


def test_an_uncertain_kernel_may_leave_more() -> None:
    wide = evidence(gaussian(11, np.eye(2) * 3.0))

    sure = share_of("re-blur", LIGHT, wide)
    unsure = share_of("re-blur", LIGHT, replace(wide, psf_errors=(1.0, 1.0, 1.0)))

    assert sure > 0.2
    assert unsure < 0.2 * sure


def test_only_measured_pixels_are_blurred_to() -> None:
    rows, cols = np.indices((SIDE, SIDE))
    known = (rows + cols) % 2 == 0
    photo = np.where(known, PHOTO, np.float32(0.9))
    masked = Evidence([NOISE] * 3, blurs=[UniformBlur(KERNEL)] * 3, measured=[known] * 3)

    def share(facts: Evidence) -> float:
        audit = audit_tile(photo, LIGHT, facts)
        return next(f.held_back for f in audit.findings if f.check == "re-blur")

    assert share(masked) == 0.0
    assert share(evidence()) > 0.9


def test_noise_made_ten_times_as_strong_is_grain() -> None:
    flat = np.full((3, SIDE, SIDE), 0.3, dtype=np.float32)
    rng = np.random.default_rng(5)
    grain = rng.standard_normal(flat.shape) * NOISE.sigma_at(0.3)

    audit = audit_tile(
        (flat + grain).astype(np.float32), (flat + 10 * grain).astype(np.float32), evidence(None)
    )

    assert next(f.held_back for f in audit.findings if f.check == "grain") > 0.5


def test_waves_beside_an_edge_are_ringing() -> None:
    step = np.where(np.arange(SIDE) < SIDE // 2, 0.2, 0.7) * np.ones((3, SIDE, 1))
    photo = ndimage.gaussian_filter(step, (0, 1, 1)).astype(np.float32)
    away = np.abs(np.arange(SIDE) - SIDE // 2 + 0.5)
    waves = 0.6 * np.cos(2 * np.pi * away / 5.0) * np.exp(-away / 12.0)

    def share(planes: NDArray[np.float64]) -> float:
        audit = audit_tile(photo, planes.astype(np.float32), evidence(None))
        return next(f.held_back for f in audit.findings if f.check == "ringing")

    assert share(step + waves) > 0.05
    assert share(step) == 0.0


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


def test_tiles_of_a_photo_show_no_seam() -> None:
    side = 2 * TILE
    light = scene(4, side)
    photo = photo_of(light)
    lines = (0.04 * np.cos(np.pi * np.arange(side))).astype(np.float32)
    spoiled = light + lines * (np.arange(side)[:, None] > TILE - 40)

    audit = audit_photo(photo, spoiled, everywhere)
    whole = audit_tile(photo, spoiled, evidence())

    assert 0.2 < whole.held_back < 0.9
    assert abs(audit.keep - whole.keep).max() < 0.05
    assert np.allclose(
        audit.mixed(photo, spoiled), photo + audit.keep * (spoiled - photo), rtol=0.0, atol=1e-6
    )


def test_a_report_names_zone_check_and_place() -> None:
    side = 2 * TILE
    light = scene(4, side)
    photo = photo_of(light)
    spoiled = light.copy()
    spoiled[0, 4:40, 4:40] *= 0.2

    report = audit_photo(photo, spoiled, everywhere).report

    assert {name: zone.tiles for name, zone in report.zones.items()} == {"mid": 4}
    assert report.worst[0].row < 48
    assert report.worst[0].col < 48
    assert {place.check for place in report.worst} & {"hue, spots", "hue, area", "re-blur", "too dark"}
    assert 0.0 < report.held_back < 0.2
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


@settings(max_examples=30)
@given(seed=st.integers(0, 2**16), side=st.sampled_from([3, 5, 7, 9, 15]))
def test_extremes_and_means_are_those_of_rank_filters(seed: int, side: int) -> None:
    planes = np.random.default_rng(seed).random((2, 31, 26), dtype=np.float32)
    size = (1, side, side)

    assert np.array_equal(nearby.lowest(planes, side), ndimage.minimum_filter(planes, size, mode="nearest"))
    assert np.array_equal(nearby.highest(planes, side), ndimage.maximum_filter(planes, size, mode="nearest"))
    assert np.allclose(
        nearby.mean(planes, side), ndimage.uniform_filter(planes, size, mode="nearest"), atol=1e-5
    )


def test_neighbours_leave_the_pixel_itself_out() -> None:
    plane = np.random.default_rng(0).random((20, 23), dtype=np.float32)
    ring = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=bool)

    low, high = nearby.neighbours(plane)

    assert np.array_equal(low, ndimage.minimum_filter(plane, footprint=ring, mode="nearest"))
    assert np.array_equal(high, ndimage.maximum_filter(plane, footprint=ring, mode="nearest"))


def test_blurring_again_goes_where_the_kernel_says() -> None:
    kernel = np.zeros((5, 5))
    kernel[2, 4] = kernel[2, 2] = 0.5  # half of the light two columns to the right; its mean is one
    point = np.zeros((16, 16), dtype=np.float32)
    point[8, 8] = 1.0
    blur = UniformBlur(as_kernel(kernel))

    inner = (slice(blur.reach, -blur.reach),) * 2
    assert np.allclose(reblurred(point, blur)[inner], blur.forward(point), atol=1e-6)


def test_planes_of_different_sizes_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="one size"):
        audit_tile(PHOTO, PHOTO[:, :-1], evidence())
    with pytest.raises(InvalidInputError, match="one size"):
        audit_photo(PHOTO, PHOTO[:, :-1], everywhere)


def test_evidence_is_for_three_channels() -> None:
    with pytest.raises(InvalidInputError, match="per channel"):
        Evidence([NOISE] * 2)
