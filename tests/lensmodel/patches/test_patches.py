from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from scipy import ndimage

from lensmodel.core.errors import NoUsablePatchesError
from lensmodel.core.types import FieldPosition, Frame, NoiseModel, Plane, ignore_step
from lensmodel.patches import Patch, Selection, r_map, select, selectors, windows
from lensmodel.patches.select import EVIDENCE_FLOOR, Reason, part_of, require_enough
from lensmodel.patches.windows import Windows, details_of, windows_of

NOISE = NoiseModel.white(0.003)


def dead_leaves(height: int, width: int, seed: int = 0) -> Plane:
    """Discs of many sizes that hide each other: sharp edges in every direction."""
    rng = np.random.default_rng(seed)
    plane = np.full((height, width), 0.4, dtype=np.float32)
    rows, cols = np.mgrid[:height, :width]
    for _ in range(height * width // 600):
        radius = 4.0 * (1.0 - rng.random()) ** -0.7
        if radius > 120.0:
            continue
        row, col = rng.random(2) * (height, width)
        r0, r1 = max(int(row - radius - 1), 0), int(row + radius + 2)
        c0, c1 = max(int(col - radius - 1), 0), int(col + radius + 2)
        inside = np.hypot(rows[r0:r1, c0:c1] - row, cols[r0:r1, c0:c1] - col) <= radius
        plane[r0:r1, c0:c1][inside] = rng.uniform(0.08, 0.8)
    return plane


def photo_of(scene: Plane, seed: int = 1, blur_px: float = 0.8) -> Plane:
    rng = np.random.default_rng(seed)
    blurred = ndimage.gaussian_filter(scene, blur_px)
    return (blurred + rng.normal(0.0, 0.003, scene.shape)).astype(np.float32)


@pytest.fixture(scope="module")
def scene() -> Plane:
    return dead_leaves(1000, 1500)


@pytest.fixture(scope="module")
def photo(scene: Plane) -> Plane:
    return photo_of(scene)


@pytest.fixture(scope="module")
def selection(photo: Plane) -> Selection:
    return chosen(photo, count=36)


@pytest.fixture(scope="module")
def part(photo: Plane) -> Plane:
    """A third of the photo, for what does not hang on its size."""
    return photo[:480, :640].copy()


def chosen(plane: Plane, **options: int) -> Selection:
    return select(plane, NOISE, **options)


def windows_in(plane: Plane, side: int = 32, sigma: float = 0.003) -> Windows:
    return windows_of(plane, NoiseModel.white(sigma), side, 1.0, ignore_step)


# ---- the r-map


def test_r_is_that_of_the_formula_at_a_step_and_low_on_narrow_stripes_and_flat_planes() -> None:
    step, stripes = np.zeros((2, 101, 101), dtype=np.float32)
    step[:, 50:] = 1.0
    stripes[:, (np.arange(101) // 3) % 2 == 0] = 1.0

    # Within the window every row adds the whole step of 1, all in one direction.
    assert r_map(step)[50, 50] == pytest.approx(25.0 / (25.0 + 0.5), rel=1e-3)
    assert r_map(stripes)[50, 50] < 0.1
    assert r_map(np.full((60, 60), 0.5, dtype=np.float32)).max() < 1e-4


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_r_map_turns_with_the_plane(turns: int) -> None:
    plane = dead_leaves(90, 90, seed=7)

    np.testing.assert_allclose(r_map(np.rot90(plane, turns).copy()), np.rot90(r_map(plane), turns), atol=2e-4)


def test_a_photo_of_1500_by_1000_gives_two_to_four_patches_a_cell_that_lie_together(
    selection: Selection,
) -> None:
    numbers = [patch.cell for patch in selection.patches]

    assert len(numbers) == 36
    assert numbers == sorted(numbers)
    assert set(numbers) == set(range(max(numbers) + 1))
    assert set(Counter(numbers).values()) <= {2, 3, 4}
    for patch in selection.patches:
        assert patch.size == 192
        middle = Frame(1000, 1500).position(patch.row + 95.5, patch.col + 95.5)
        assert (patch.position.r, patch.position.phi) == pytest.approx((middle.r, middle.phi))
        first = next(p for p in selection.patches if p.cell == patch.cell)
        turn = (patch.position.phi - first.position.phi + math.pi) % (2 * math.pi) - math.pi
        assert abs(patch.position.r - first.position.r) <= 0.12
        assert apart(patch, first) < patch.size or abs(turn) <= math.radians(24.0)
    assert all(apart(a, b) >= 96 for a, b in itertools.combinations(selection.patches, 2))


def apart(a: Patch, b: Patch) -> int:
    return max(abs(a.row - b.row), abs(a.col - b.col))


def test_every_corner_gets_its_share(selection: Selection) -> None:
    outer = [p.position.phi for p in selection.patches if p.position.r > 0.55]
    quadrants = Counter(int(phi // (math.pi / 2)) for phi in outer)

    assert min(quadrants[q] for q in (-2, -1, 0, 1)) >= 2


def test_a_small_photo_gets_smaller_patches() -> None:
    small = photo_of(dead_leaves(320, 400))
    patches = chosen(small, count=12).patches

    assert len(patches) >= 8
    assert {p.size for p in patches} == {128}


def test_a_memory_mapped_plane_gives_the_same_and_progress_is_reported_to_the_end(
    tmp_path: Path, part: Plane
) -> None:
    steps: list[tuple[int, int]] = []
    np.save(tmp_path / "plane.npy", part)
    mapped = np.load(tmp_path / "plane.npy", mmap_mode="r")
    found = select(mapped, NOISE, count=24, on_step=lambda *step: steps.append(step))

    assert found.patches == chosen(part, count=24).patches
    assert steps[-1][0] == steps[-1][1]
    assert steps == sorted(steps)


@pytest.mark.parametrize("selector", list(selectors))
def test_scores_lie_in_zero_to_one_and_jpeg_counts_for_less(part: Plane, selector: str) -> None:
    raw, jpeg = (
        [p.score for p in select(part, NOISE, count=12, selector=selector, jpeg=jpeg).patches]
        for jpeg in (False, True)
    )

    assert len(set(raw)) > 1
    assert all(0.0 < score <= 1.0 for score in raw)
    assert jpeg == pytest.approx([0.3 * score for score in raw])


# ---- what is rejected


def test_strips_leave_no_trace_in_the_windows(photo: Plane, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = windows_in(photo[:300, :400])
    monkeypatch.setattr(windows, "_STRIP_PIXELS", 32 * 400)
    cut = windows_in(photo[:300, :400])

    for name in ("directions", "eigenvalues", "level", "r_mean"):
        np.testing.assert_allclose(getattr(cut, name), getattr(whole, name), rtol=1e-5)


def test_every_window_is_chosen_or_has_a_reason(selection: Selection) -> None:
    assert {r.reason for r in selection.rejected} <= set(get_args(Reason))
    places = [(r.row, r.col) for r in selection.rejected] + [(p.row, p.col) for p in selection.patches]
    assert len(places) == len(set(places)) == 17 * 28


def test_clipped_flat_and_dark_parts_are_rejected_with_their_reason(scene: Plane) -> None:
    spoilt = scene.copy()
    spoilt[:300, :400] = np.where(spoilt[:300, :400] > 0.5, 1.2, spoilt[:300, :400])
    spoilt[-300:, -400:] = 0.5
    plane = photo_of(spoilt)
    plane[:300, -400:] *= 0.01
    rejected = chosen(np.minimum(plane, 1.0)).rejected
    corners = [r for r in rejected if not (100 <= r.row <= 700 or 100 <= r.col <= 1200)]
    reason = {(r.row < 100, r.col < 100): r.reason for r in corners}

    assert (reason[True, True], reason[False, False], reason[True, False]) == ("clipped", "flat", "dark")


@pytest.mark.parametrize("said", ["one-directional", "flat 108", "50 x 40 px, a patch needs 64"])
def test_a_photo_without_a_usable_window_is_refused_with_the_reason(
    scene: Plane, part: Plane, said: str
) -> None:
    rng = np.random.default_rng(3)
    stripes = np.repeat(np.cumsum(rng.normal(0, 1, 60)), 12)[None, :].repeat(480, 0)
    plane = {
        "one-directional": photo_of((0.5 + 0.3 * np.tanh(stripes / 3)).astype(np.float32)),
        "flat 108": rng.normal(0.4, 0.003, (400, 500)).astype(np.float32),
    }.get(said, np.zeros((40, 50), dtype=np.float32))

    with pytest.raises(NoUsablePatchesError, match=said):
        chosen(plane)


# ---- evidence


def vignetted_sky(height: int, width: int, sigma: float, grain_px: float = 0.0) -> Plane:
    """Bright sky that falls off towards the corners, with noise; coarse where a camera denoised it."""
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    noise = np.random.default_rng(3).normal(0.0, 1.0, (height, width))
    if grain_px:
        noise = ndimage.gaussian_filter(noise, grain_px)
    return (0.6 * (1.0 - 0.3 * (x * x + y * y)) + 0.05 * y + sigma * noise / noise.std()).astype(np.float32)


def test_a_slope_is_no_contrast() -> None:
    sky = vignetted_sky(512, 768, 0.003)

    assert np.square(sky.std() / 0.003) > 100.0
    assert windows_in(sky, 48).contrast.max() < 4.0


RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("make", "sigma", "least", "most"),
    [
        (lambda _: vignetted_sky(192, 192, 0.002), 0.002, 0.0, 0.05),
        (lambda _: vignetted_sky(192, 192, 0.01), 0.01, 0.0, 0.05),
        # the capacity of white signal, P / N = 4: log2(1 + 3) bits at every frequency; so dark that the gain
        # of pixels plays no part
        (lambda _: 0.001 + 0.04 * RNG.normal(size=(192, 192)), 0.02, 1.95, 2.05),
        # a soft corner is evidence by its lowest frequencies
        (lambda scene: photo_of(scene[184:408, 184:408], blur_px=2.5)[16:208, 16:208], 0.003, 0.5, 9.0),
        # structure below the uniformity of sensors is none
        (lambda scene: 0.5 + 0.004 * (scene[:192, :192] - 0.4), 1e-6, 0.0, EVIDENCE_FLOOR),
    ],
)
def test_evidence_is_what_stands_out_of_noise_and_slopes(
    scene: Plane, make: Callable[[Plane], Plane], sigma: float, least: float, most: float
) -> None:
    patch = make(scene)
    (bits,) = details_of(patch, windows_in(patch, 48, sigma), 1.0).evidence

    assert least <= bits < most


def test_patches_avoid_a_sky_whose_noise_the_camera_smoothed(photo: Plane) -> None:
    plane = photo.copy()
    plane[:500] = vignetted_sky(500, 1500, 0.004, grain_px=2.0)
    single = NoiseModel.white(0.0006)  # from pixel to pixel it is as low as that

    careless = select(plane, single, count=36)
    careful = select(plane, single, count=36, coarse_noise=NoiseModel.white(0.02))

    assert any(patch.row + patch.size < 480 for patch in careless.patches)
    assert all(patch.row + patch.size > 480 for patch in careful.patches)


def placed(*places: tuple[int, int]) -> list[Patch]:
    frame = Frame(1000, 1500)
    return [Patch(row, col, 100, frame.position(row + 50, col + 50), 0.5, 0) for row, col in places]


APART_IN_THREE_PARTS = [(450, 700), (450, 800), (100, 100), (100, 300), (800, 1300), (700, 1200)]
SHARING_PIXELS = [(450 + 20 * (k % 2), 200 + 20 * k) for k in range(10)]
IN_ONE_QUARTER = [(120 + 110 * i, 220 + 110 * j) for i in range(2) for j in range(3)]


@pytest.mark.parametrize(
    ("patches", "said"), [(SHARING_PIXELS, "counts from 6 places"), (IN_ONE_QUARTER, "in 1 of 9 parts")]
)
def test_patches_are_enough_that_lie_apart_in_three_parts(patches: list[tuple[int, int]], said: str) -> None:
    require_enough(placed(*APART_IN_THREE_PARTS))
    with pytest.raises(NoUsablePatchesError, match=said):
        require_enough(placed(*patches))


def test_every_part_of_the_picture_has_a_number_of_its_own() -> None:
    places = [FieldPosition(r, 0.5 + k * math.pi / 2) for r in (0.5, 0.9) for k in range(4)]

    assert sorted(part_of(p) for p in [FieldPosition(0.1, 1.0), *places]) == list(range(9))
