"""Facts of the regression on families of kernels whose truth is known in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lensmodel.core.errors import InvalidInputError, NoSamplesError, UnknownMethodError
from lensmodel.core.psf import PsfSample, centroid, delta, distance, gaussian, second_moments
from lensmodel.core.types import FieldPosition, Kernel, LensSettings
from lensmodel.model import LensModel, ModelSettings
from lensmodel.model import variables as va
from lensmodel.model.answer import MODES
from lensmodel.model.local_frame import LocalKernels
from lensmodel.model.neighbours import Answers, Neighbourhood
from lensmodel.model.variables import point
from lensmodel.model.widths import WidthField

SIZE = 21
GREEN = LensSettings(aperture=2.0)


def ring_kernel(position: FieldPosition, size: int = SIZE) -> Kernel:
    """Gaussian, wide along v and growing outwards: the same on a ring, turned with phi."""
    c, s = math.cos(position.phi), math.sin(position.phi)
    u, v = np.array([-s, c]), np.array([-c, -s])  # (row, col)
    along, across = 0.8 + 1.2 * position.r**2, 1.0 + 2.0 * position.r**2
    return gaussian(size, along**2 * np.outer(u, u) + across**2 * np.outer(v, v))


def places(count: int, seed: int) -> list[FieldPosition]:
    rng = np.random.default_rng(seed)
    r = np.sqrt(rng.uniform(0.0, 0.9, count))
    return [
        FieldPosition(float(a), float(p))
        for a, p in zip(r, rng.uniform(-math.pi, math.pi, count), strict=True)
    ]


def photo(name: str, seed: int, count: int = 24, settings: LensSettings = GREEN) -> list[PsfSample]:
    return [PsfSample(ring_kernel(p), p, settings, photo=name) for p in places(count, seed)]


def photos(count: int) -> list[PsfSample]:
    return [sample for i in range(count) for sample in photo(f"p{i}", i)]


def difference(a: Kernel, b: Kernel) -> float:
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


@pytest.mark.parametrize("mode", MODES)
class TestEveryMode:
    def test_answers_a_centred_kernel_of_sum_one(self, mode: str) -> None:
        model = LensModel.fit(photos(1), ModelSettings(mode=mode))

        kernel = model.query(FieldPosition(0.6, 1.0), GREEN, 33).kernel

        assert kernel.shape == (33, 33)
        assert kernel.min() >= 0.0
        assert kernel.sum() == pytest.approx(1.0)
        assert np.hypot(*centroid(kernel)) < 2e-3

    def test_returns_the_one_psf_of_a_constant_round_family(self, mode: str) -> None:
        same = gaussian(SIZE, np.eye(2) * 1.5)
        model = LensModel.fit(
            [PsfSample(same, p, GREEN, photo="a") for p in places(24, 3)], ModelSettings(mode=mode)
        )

        answer = model.query(FieldPosition(0.5, -2.0), GREEN, SIZE)

        assert difference(answer.kernel, same) < 5e-3

    def test_does_not_depend_on_the_order_of_samples(self, mode: str) -> None:
        samples, where = photos(2), FieldPosition(0.7, 0.4)
        forward = LensModel.fit(samples, ModelSettings(mode=mode)).query(where, GREEN, SIZE)
        backward = LensModel.fit(samples[::-1], ModelSettings(mode=mode)).query(where, GREEN, SIZE)

        assert difference(forward.kernel, backward.kernel) < 1e-5


def test_follows_the_ring_family() -> None:
    model = LensModel.fit(photos(3))
    errors = [distance(model.query(p, GREEN, SIZE).kernel, ring_kernel(p)).rel_l2 for p in places(12, 99)]

    assert float(np.median(errors)) < 0.08


def seen_from(kernel: Kernel, own: float, here: float) -> Kernel:
    """Kernel of a place at angle `own` as its neighbour on the ring at angle `here` has it."""
    where = FieldPosition(0.5, own)
    points = va.point(where, GREEN)[None]
    local = LocalKernels.of([PsfSample(kernel, where, GREEN)], points, WidthField())
    only = Answers(np.zeros(1, dtype=np.intp), np.ones(1), np.array([0, 1]))
    return np.asarray(local.kernels(only, np.array([here]), np.ones((1, 2)), kernel.shape[0])[0])


def test_kernel_seen_from_its_own_place_is_itself() -> None:
    kernel = gaussian(31, [[2.0, 0.6], [0.6, 1.0]])
    for phi in (0.0, 0.3, 1.2, -2.8):
        assert difference(seen_from(kernel, phi, phi), kernel) < 1e-6


def test_kernel_turns_with_its_place() -> None:
    across, along = gaussian(31, [[4.0, 0.0], [0.0, 1.0]]), gaussian(31, [[1.0, 0.0], [0.0, 4.0]])

    assert difference(seen_from(across, 0.4, 0.4 + math.pi / 2), along) < 1e-3


@pytest.mark.parametrize("turn", [0.0, 0.4, math.pi / 4])
def test_delta_comes_back_nearly_as_a_delta(turn: float) -> None:
    found = seen_from(delta(31), 0.5, 0.5 + turn)

    assert found[15, 15] > 0.88
    assert difference(found, delta(31)) < 0.12


def test_long_axis_turns_with_the_place() -> None:
    model = LensModel.fit(photos(3), ModelSettings(phi=10.0))
    for phi in (-2.5, -0.7, 0.3, 1.9):
        moments = second_moments(model.query(FieldPosition(0.8, phi), GREEN, SIZE).kernel)
        row, col = np.linalg.eigh(moments)[1][:, 1]
        # v at phi points to (row, col) = (-cos phi, -sin phi)
        aligned = abs(-row * math.cos(phi) - col * math.sin(phi))
        assert math.degrees(math.acos(min(aligned, 1.0))) < 2.0


def test_angles_on_both_sides_of_pi_are_neighbours() -> None:
    model = LensModel.fit(photos(2))
    above = model.query(FieldPosition(0.6, math.pi - 1e-6), GREEN, SIZE).kernel
    below = model.query(FieldPosition(0.6, -math.pi + 1e-6), GREEN, SIZE).kernel

    assert difference(above, below) < 1e-4


def test_samples_added_one_by_one_answer_as_all_at_once() -> None:
    fixed = ModelSettings(r=0.1, phi=0.4, mode="paper")
    samples = photos(4)
    grown = LensModel.fit(samples[:40], fixed)
    for sample in samples[40:]:
        grown = grown.added([sample])
    at_once = LensModel.fit(samples, fixed)

    for where in places(5, 7):
        a, b = grown.query(where, GREEN, SIZE), at_once.query(where, GREEN, SIZE)
        assert difference(a.kernel, b.kernel) < 1e-6
        assert a.effective_samples == pytest.approx(b.effective_samples, rel=1e-6)


def test_older_model_is_untouched_by_samples_added_later() -> None:
    old = LensModel.fit(photos(2), ModelSettings(mode="paper"))
    before = old.query(FieldPosition(0.5, 0.5), GREEN, SIZE).kernel
    narrow, wide = delta(SIZE), gaussian(SIZE, np.eye(2) * 6)
    left = old.added([PsfSample(narrow, FieldPosition(0.5, 0.5), GREEN, photo="left")])
    right = old.added([PsfSample(wide, FieldPosition(0.5, 0.5), GREEN, photo="right")])

    assert np.array_equal(old.query(FieldPosition(0.5, 0.5), GREEN, SIZE).kernel, before)
    assert left.samples[-1].photo == "left"
    assert left.query(FieldPosition(0.5, 0.5), GREEN, SIZE).kernel.max() > (
        right.query(FieldPosition(0.5, 0.5), GREEN, SIZE).kernel.max()
    )


def test_unknown_aperture_takes_no_part_in_distances() -> None:
    unknown = [PsfSample(s.kernel, s.position, LensSettings(), photo=s.photo) for s in photos(2)]
    model, where = LensModel.fit(unknown), FieldPosition(0.5, 1.0)

    at_two = model.query(where, LensSettings(aperture=2.0), SIZE)
    at_eight = model.query(where, LensSettings(aperture=8.0), SIZE)

    assert np.array_equal(at_two.kernel, at_eight.kernel)
    assert not at_eight.extrapolated


def test_aperture_far_from_every_photo_is_called_extrapolated() -> None:
    answer = LensModel.fit(photos(2)).query(FieldPosition(0.5, 1.0), LensSettings(aperture=8.0), SIZE)

    assert answer.extrapolated
    assert "aperture_stops" in answer.beyond


def test_colours_hardly_mix() -> None:
    narrow, wide = gaussian(SIZE, np.eye(2) * 0.8), gaussian(SIZE, np.eye(2) * 5.0)
    samples = [PsfSample(narrow, p, GREEN, photo="a") for p in places(20, 1)]
    samples += [PsfSample(wide, p, GREEN.with_channel("r"), photo="a") for p in places(20, 2)]
    model = LensModel.fit(samples, ModelSettings(mode="paper"))

    assert difference(model.query(FieldPosition(0.5, 0.0), GREEN, SIZE).kernel, narrow) < 0.05


def test_samples_answer_by_their_weight() -> None:
    where = FieldPosition(0.5, 0.0)
    loud = PsfSample(gaussian(SIZE, np.eye(2)), where, GREEN, weight=1.0, photo="a")
    quiet = PsfSample(gaussian(SIZE, np.eye(2) * 4), where, GREEN, weight=0.01, photo="b")
    model = LensModel.fit([loud, quiet])

    assert difference(model.query(where, GREEN, SIZE).kernel, loud.kernel) < 0.02


def test_widths_are_carried_into_the_corner() -> None:
    model = LensModel.fit([s for i in range(4) for s in photo(f"p{i}", i) if s.position.r < 0.85])
    where = FieldPosition(1.0, 0.3)
    plain = LensModel.fit(model.samples, ModelSettings(mode="paper"))

    carried = distance(model.query(where, GREEN, SIZE).kernel, ring_kernel(where)).rel_l2
    faded = distance(plain.query(where, GREEN, SIZE).kernel, ring_kernel(where)).rel_l2

    assert carried < 0.06
    assert carried < 0.5 * faded


def test_width_field_finds_widths_along_both_axes() -> None:
    field = WidthField.fit(photos(4))
    inner, outer = field.over(np.array([point(FieldPosition(r, 0.7), GREEN) for r in (0.2, 0.9)]))

    assert outer[0] / inner[0] == pytest.approx((0.8 + 1.2 * 0.81) / (0.8 + 1.2 * 0.04), rel=0.05)
    assert outer[1] / inner[1] == pytest.approx((1.0 + 2.0 * 0.81) / (1.0 + 2.0 * 0.04), rel=0.05)


def test_no_samples_is_said_as_such() -> None:
    with pytest.raises(NoSamplesError, match="calibrate"):
        LensModel.fit([])


def test_unknown_mode_is_refused_with_the_known_ones() -> None:
    with pytest.raises(UnknownMethodError, match="paper"):
        ModelSettings(mode="magic")


@pytest.mark.parametrize("bad", [{"r": 0.0}, {"phi": math.nan}])
def test_settings_outside_their_range_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(InvalidInputError):
        ModelSettings(**bad)  # type: ignore[arg-type] # wrong on purpose


@pytest.mark.parametrize("size", [0, 4, -3])
def test_even_sizes_are_refused(size: int) -> None:
    with pytest.raises(InvalidInputError, match="odd"):
        LensModel.fit(photos(1)).query(FieldPosition(0.0, 0.0), GREEN, size)


@pytest.mark.parametrize("known", [True, False])
def test_tree_finds_what_a_direct_search_finds(known: bool) -> None:
    points = np.random.default_rng(0).random((700, 7))
    points[::7, 5] = np.nan
    scale = np.array([0.1, 0.2, 0.2, 0.3, 0.4, 0.2, 0.3])
    asked = np.array([0.4, 0.5, 0.5, 0.5, 0.6, 0.5, 0.5 if known else np.nan])
    gap = np.nan_to_num((points - asked) / scale, nan=0.0)
    direct = np.flatnonzero((gap**2).sum(axis=1) <= 1.5**2)

    inside = Neighbourhood(points, np.ones(700), scale).within(asked, 1.5)

    assert 0 < len(direct) < len(inside) < 700
    assert np.isin(direct, inside).all()
