"""A whole photo: cells, borders, windows, workers, uncertainty."""

import logging
from dataclasses import dataclass
from functools import cache, partial

import numba
import numpy as np
import pytest
from scipy import ndimage

from lab.correction.filter_flow import EfficientFilterFlow
from lab.kernels import gaussian
from lensmodel.core.errors import CancelledError, InvalidInputError
from lensmodel.core.types import (
    CHANNELS,
    BayerPattern,
    Channel,
    FieldPosition,
    Frame,
    Kernel,
    NoiseModel,
    Planes,
)
from lensmodel.correction import Bounds, Corrected, correct_planes, whole_photo
from lensmodel.correction.cell import cells
from lensmodel.correction.deconvolver import Sensor, Solution
from lensmodel.correction.expected_gain import plan
from lensmodel.correction.posterior import PsfPosterior

FRAME = Frame(152, 208)  # two cells by two
LARGE = Frame(200, 260)  # two by three
BASE = (NoiseModel(1 / 50_000, 1e-6),) * 3
HIGH = (NoiseModel(1 / 2_500, 9e-6),) * 3
DARK = (NoiseModel(1 / 40, 1e-3),) * 3
BAYER = ((0, 1), (1, 2))


@dataclass(frozen=True)
class Soft:
    """A lens whose blur grows from the centre to the corner."""

    centre: float = 0.9
    corner: float = 1.7

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        width = self.centre + (self.corner - self.centre) * position.r**2
        return gaussian(size, np.eye(2) * width**2)


def scene(seed: int = 0, frame: Frame = FRAME) -> Planes:
    rng = np.random.default_rng(seed)
    rows, cols = frame.height + 60, frame.width + 60
    planes = np.full((3, rows, cols), 0.3, dtype=np.float32)
    for _ in range(700 * frame.height * frame.width // 52_000):  # as dense on either frame
        side = int(min(4 + rng.pareto(1.2) * 4, 60))
        top, left = int(rng.integers(-side, rows)), int(rng.integers(-side, cols))
        colour = rng.uniform(0.03, 0.7) * rng.uniform(0.7, 1.0, 3)
        planes[:, max(top, 0) : max(top + side, 0), max(left, 0) : max(left + side, 0)] = colour[
            :, None, None
        ]
    return planes


def photo(lens: Soft, noise: tuple[NoiseModel, ...], frame: Frame = FRAME) -> tuple[Planes, Planes]:
    """Return what a camera sees and the sharp frame; light from outside the frame is in it."""
    seen, sharp = _photo(lens, noise, frame)
    return seen.copy(), sharp.copy()  # a test may change them


@cache
def _photo(lens: Soft, noise: tuple[NoiseModel, ...], frame: Frame) -> tuple[Planes, Planes]:
    rng, sharp = np.random.default_rng(1), scene(frame=frame)
    seen = []
    for plane, channel, model in zip(sharp, CHANNELS, noise, strict=True):
        flow = EfficientFilterFlow.of_field(lens, frame, channel, pitch=64, size=17)
        cut = 30 - flow.reach
        light = flow.forward(np.ascontiguousarray(plane[cut:-cut, cut:-cut]))
        seen.append(light + rng.standard_normal(light.shape) * np.sqrt(model.variance(light)))
    return np.stack(seen).astype(np.float32), sharp[:, 30:-30, 30:-30]


@cache
def whole(
    lens: Soft, noise: tuple[NoiseModel, ...], method: str = "standard", frame: Frame = FRAME
) -> Planes:
    """The whole photo corrected with the lens that took it, by one worker."""
    seen = photo(lens, noise, frame)[0]
    return correct_planes(seen, lens, frame, noise=noise, method=method, workers=1).planes


@cache
def misled(error: float) -> Planes:
    """A photo corrected with kernels that are far too wide, their relative error stated or not."""
    seen = photo(Soft(0.7, 1.0), BASE)[0]
    return correct_planes(seen, Soft(1.3, 1.8), FRAME, noise=BASE, psf_error=error).planes


def demosaiced(seen: Planes) -> Planes:
    """What each colour's pixels of a mosaic measured, and the mean of neighbours between them."""
    sites = np.tile(BAYER, (seen.shape[1] // 2, seen.shape[2] // 2))
    known = np.stack([sites == c for c in range(3)]).astype(np.float32)
    taps = np.array([[[1.0, 2.0, 1.0], [2.0, 4.0, 2.0], [1.0, 2.0, 1.0]]])
    filled = ndimage.convolve(known * seen, taps) / ndimage.convolve(known, taps)
    return np.where(known > 0, seen, filled).astype(np.float32)


def rmse(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a.astype(np.float64) - b) ** 2)))


def left(restored: Planes, seen: Planes, sharp: Planes, where: np.ndarray) -> float:
    """The share of a photo's error that a correction leaves there."""
    return rmse(restored[:, where], sharp[:, where]) / rmse(seen[:, where], sharp[:, where])


def test_cells_sum_to_one_at_every_pixel() -> None:
    total = np.zeros((FRAME.height, FRAME.width))
    for cell in cells(FRAME):
        total[cell.place] += np.outer(cell.rise, cell.run)

    np.testing.assert_allclose(total, 1.0, atol=1e-6)


def test_cells_of_a_large_frame_stay_within_their_bounds() -> None:
    sides = [len(cell.rise) for cell in cells(Frame(4000, 6000))]

    assert max(sides) <= 240
    assert min(sides) >= 150


@pytest.mark.parametrize("method", ["standard", "fast"])
@pytest.mark.parametrize("noise", [BASE, HIGH])
def test_correction_brings_the_photo_nearer_to_the_scene(method: str, noise: tuple[NoiseModel, ...]) -> None:
    seen, sharp = photo(Soft(), noise)

    share = {"standard": 0.75, "fast": 0.9}[method]  # one linear pass removes less
    assert rmse(whole(Soft(), noise, method), sharp) < share * rmse(seen, sharp)


@pytest.mark.parametrize("method", ["standard", "fast"])
def test_correction_is_never_worse_than_the_photo_at_extreme_noise(method: str) -> None:
    seen, sharp = photo(Soft(), DARK, LARGE)

    assert rmse(whole(Soft(), DARK, method, LARGE), sharp) < rmse(seen, sharp)


def test_correction_is_the_same_for_any_number_of_workers() -> None:
    seen, _ = photo(Soft(), BASE)

    three = correct_planes(seen, Soft(), FRAME, noise=BASE, workers=3).planes

    np.testing.assert_array_equal(whole(Soft(), BASE), three)


@pytest.mark.parametrize("cfa", [None, ((1, 0), (2, 1))])
def test_correction_of_a_window_shows_the_pixels_of_the_whole(cfa: BayerPattern | None) -> None:
    seen, _ = photo(Soft(), BASE)

    part, all_of_it = (
        correct_planes(seen, Soft(), FRAME, noise=BASE, cfa=cfa, roi=roi).planes
        for roi in ((37, 101, 64, 90), None)
    )

    np.testing.assert_array_equal(part, all_of_it[:, 37:101, 101:191])


def test_border_is_restored_like_the_inside_from_the_fourth_pixel_on() -> None:
    lens = Soft(1.2, 1.2)
    seen, sharp = photo(lens, BASE, LARGE)

    restored = whole(lens, BASE, frame=LARGE)

    depth = np.minimum.outer(*(np.minimum(np.arange(n), np.arange(n)[::-1]) for n in sharp.shape[1:]))
    edge, rim, inside = (
        left(restored, seen, sharp, where) for where in (depth < 3, (depth >= 4) & (depth < 14), depth >= 14)
    )
    # The outermost pixels share their light with a scene that nobody saw; they still must gain.
    assert edge < 0.85
    assert rim < 1.25 * inside


@pytest.mark.parametrize(("method", "bound"), [("fast", 1.06), ("standard", 1.15)])
def test_light_from_beyond_the_frame_leaves_no_ripples_at_the_border_of_a_soft_lens(
    method: str, bound: float
) -> None:
    lens = Soft(2.5, 2.5)
    seen, sharp = photo(lens, BASE)

    restored = whole(lens, BASE, method)

    inside = np.zeros((FRAME.height, FRAME.width), dtype=np.bool_)
    inside[16:-16, 16:-16] = True
    border, middle = (left(restored, seen, sharp, where) for where in (~inside, inside))
    assert border < bound * middle


def test_result_hardly_depends_on_the_size_of_the_cells() -> None:
    lens = Soft(1.0, 1.0)
    seen, _ = photo(lens, BASE)

    small = correct_planes(seen, lens, FRAME, noise=BASE, method="paper", pitch=90).planes
    large = correct_planes(seen, lens, FRAME, noise=BASE, method="paper", pitch=200).planes

    assert np.abs(small - large)[:, 8:-8, 8:-8].max() < 1e-3


@pytest.mark.parametrize("noise", [BASE, HIGH])
def test_smooth_scene_under_a_wide_blur_does_not_gain_noise(noise: tuple[NoiseModel, ...]) -> None:
    rows, cols = np.indices((LARGE.height, LARGE.width))
    sharp = np.stack([0.3 + 0.2 * np.sin(rows / 60.0 + c) * np.cos(cols / 70.0) for c in range(3)])
    rng = np.random.default_rng(3)
    seen = sharp + rng.standard_normal(sharp.shape) * np.sqrt(noise[0].variance(sharp))
    seen = seen.astype(np.float32)

    restored = correct_planes(seen, Soft(3.0, 3.0), LARGE, noise=noise).planes

    assert rmse(restored, sharp) < rmse(seen, sharp)


@pytest.mark.parametrize("strength", [0.0, 0.5])
def test_strength_is_the_share_of_the_way(strength: float) -> None:
    seen, _ = photo(Soft(), BASE)

    made = correct_planes(seen, Soft(), FRAME, noise=BASE, method="fast", strength=strength).planes

    np.testing.assert_allclose(made, seen + strength * (whole(Soft(), BASE, "fast") - seen), atol=1e-5)


def test_wrong_kernel_with_its_error_stated_does_less_harm() -> None:
    _, sharp = photo(Soft(0.7, 1.0), BASE)

    assert rmse(misled(0.6), sharp) < rmse(misled(0.0), sharp)


def test_much_of_a_wrong_kernel_is_held_back() -> None:
    seen, _ = photo(Soft(), BASE)

    assert correct_planes(seen, Soft(2.2, 3.0), FRAME, noise=BASE).audit.held_back > 0.1


def test_result_stays_within_the_range_of_the_photo_where_no_halo_is_allowed() -> None:
    seen, _ = photo(Soft(), BASE)
    low, high = (f(seen, (1, 5, 5), mode="nearest") for f in (ndimage.minimum_filter, ndimage.maximum_filter))

    held = correct_planes(seen, Soft(), FRAME, noise=BASE, bounds=Bounds(halo=0.0)).planes
    free = whole(Soft(), BASE)

    assert np.all(held >= low - 1e-6)
    assert np.all(held <= high + 1e-6)
    assert np.mean((free < low) | (free > high)) > 0.02


def test_kernels_that_are_off_leave_no_dark_lines_beside_edges() -> None:
    seen, sharp = photo(Soft(0.7, 1.0), BASE)
    darkest = ndimage.minimum_filter(sharp, (1, 5, 5))

    def line(made: Planes) -> float:
        return float(np.quantile(darkest - made, 0.999))

    free = Bounds(halo=np.inf)
    unbound = correct_planes(seen, Soft(1.3, 1.8), FRAME, noise=BASE, psf_error=0.6, bounds=free).planes
    assert line(misled(0.6)) < 0.5 * line(unbound)


@pytest.mark.parametrize("mosaic", [False, True])
def test_flat_areas_keep_their_grain_unless_it_is_to_be_taken_away(mosaic: bool) -> None:
    rng = np.random.default_rng(1)
    level = np.array([0.3, 0.4, 0.2])[:, None, None] * np.ones((1, LARGE.height, LARGE.width))
    level[:, :, :40:8] *= 0.4  # something to correct beside the flat area, within each of its cells
    level[:, :, 120:160:8] *= 0.4
    level[:, :, 232::8] *= 0.4
    seen = level + rng.standard_normal((3, LARGE.height, LARGE.width)) * np.sqrt(HIGH[0].variance(level))
    seen = seen.astype(np.float32)
    cfa, seen = (BAYER, demosaiced(seen)) if mosaic else (None, seen)

    def grain(denoise: float) -> float:
        made = correct_planes(seen, Soft(), LARGE, noise=HIGH, cfa=cfa, bounds=Bounds(denoise=denoise)).planes
        flat = np.r_[54:106, 174:218]  # out of the blur's reach
        luma = [np.tensordot([0.25, 0.6, 0.15], planes, 1)[20:-20, flat] for planes in (made, seen)]
        return float(luma[0].var() / luma[1].var())

    assert 0.7 < grain(0.0) < 1.0
    assert grain(1.0) < 0.3


def test_forecast_of_a_blur_turns_with_it() -> None:
    plane = np.random.default_rng(0).random((3, 72, 72), dtype=np.float32)
    sensors = [Sensor(NoiseModel.white(0.01))] * 3

    posteriors = [PsfPosterior.of_error(gaussian(15, np.diag(w)), 0.2) for w in ((0.1, 6.0), (6.0, 0.1))]
    lying, standing = (plan("mid", plane, [one] * 3, [(0.0, 0.0)] * 3, sensors) for one in posteriors)

    assert lying.forecast.before == pytest.approx(standing.forecast.before, rel=1e-5)
    assert lying.forecast.after == pytest.approx(standing.forecast.after, rel=1e-5)
    assert lying.shares == standing.shares


def test_less_of_a_kernel_is_used_the_less_sure_it_is() -> None:
    plane = np.random.default_rng(0).random((3, 72, 72), dtype=np.float32)
    sensors = [Sensor(NoiseModel.white(0.003))] * 3
    kernel = gaussian(15, 1.4**2 * np.eye(2))

    plans = [
        plan("mid", plane, [PsfPosterior.of_error(kernel, error)] * 3, [(0.0, 0.0)] * 3, sensors)
        for error in (0.0, 0.3, 0.6, 1.0)
    ]

    shares, gains = [p.shares[1] for p in plans], [p.forecast.gain_db for p in plans]
    assert shares[0] == 1.0
    assert shares == sorted(shares, reverse=True)
    assert shares[-1] < 0.7
    assert gains == sorted(gains, reverse=True)


def test_zone_report_expects_less_gain_from_a_noisier_photo() -> None:
    seen, _ = photo(Soft(), BASE)

    clean, noisy = (
        correct_planes(seen, Soft(), FRAME, noise=noise, method="fast", psf_error=0.1, pitch=45).zones
        for noise in (BASE, HIGH)
    )

    assert set(clean) == {"center", "mid", "corner"}
    for zone, report in clean.items():
        assert report.expected_gain_db > noisy[zone].expected_gain_db > 0
        assert report.psf_error == pytest.approx(0.1)


def test_steps_count_the_cells_and_can_cancel() -> None:
    seen, _ = photo(Soft(), BASE)

    def stop(done: int, total: int) -> None:
        assert total == len(cells(FRAME))
        if done == 2:
            raise CancelledError("enough")

    with pytest.raises(CancelledError):
        correct_planes(seen, Soft(), FRAME, noise=BASE, method="fast", workers=2, on_step=stop)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"strength": 1.5}, "strength"),
        ({"workers": 0}, "workers"),
        ({"roi": (0, 0, 300, 10)}, "does not lie"),
        ({"noise": BASE[:2]}, "one entry per channel"),
        ({"psf_error": -0.1}, "psf_error"),
        ({"frame": Frame(10, 10)}, "as the frame says"),
    ],
)
def test_correction_refuses_what_makes_no_sense(change: dict, text: str) -> None:
    seen = np.full((3, FRAME.height, FRAME.width), 0.2, dtype=np.float32)

    with pytest.raises(InvalidInputError, match=text):
        correct_planes(seen, Soft(), **({"frame": FRAME, "noise": BASE} | change))


@pytest.mark.parametrize("change", [{"halo": -0.1}, {"denoise": 1.5}])
def test_bounds_refuse_what_makes_no_sense(change: dict) -> None:
    with pytest.raises(InvalidInputError, match=next(iter(change))):
        Bounds(**change)


def test_lateral_colour_is_removed_in_the_same_step() -> None:
    @dataclass(frozen=True)
    class Shift:
        def displacement(self, r: float, channel: Channel) -> float:
            return {"r": 1.5, "g": 0.0, "b": -1.5}[channel] * r

    lens, lateral = Soft(1.0, 1.0), Shift()
    sharp, middle = scene(), np.array(FRAME.center)[:, None, None]
    places = np.indices((FRAME.height, FRAME.width)) - middle
    seen = []
    for plane, channel in zip(sharp, CHANNELS, strict=True):
        soft = ndimage.gaussian_filter(plane.astype(np.float64), 1.0)
        # A point at p lands at p size: the pixel p shows what lies at p / size.
        size = 1.0 + lateral.displacement(1.0, channel) / FRAME.half_diagonal
        seen.append(ndimage.map_coordinates(soft, places / size + middle + 30, order=3))
    photo_planes = np.stack(seen).astype(np.float32)
    truth = sharp[:, 30:-30, 30:-30]

    plain = correct_planes(photo_planes, lens, FRAME, noise=BASE)
    aligned = correct_planes(photo_planes, lens, FRAME, noise=BASE, lateral=lateral)

    assert isinstance(aligned, Corrected)
    assert rmse(aligned.planes, truth) < 0.7 * rmse(plain.planes, truth)


def test_layers_are_what_each_would_be_alone_to_the_last_bit() -> None:
    lens, roi = Soft(), (20, 80, 40, 50)
    seen, _ = photo(lens, BASE)
    wishes = (Bounds(texture=0.0), Bounds(denoise=1.0), Bounds(halo=0.0))

    together = correct_planes(seen, lens, FRAME, noise=BASE, layers=wishes, roi=roi, workers=2)

    alone = [correct_planes(seen, lens, FRAME, noise=BASE, bounds=wish, roi=roi).planes for wish in wishes]
    np.testing.assert_array_equal(
        together.planes, correct_planes(seen, lens, FRAME, noise=BASE, roi=roi).planes
    )
    for layer, wanted in zip(together.layers, alone, strict=True):
        np.testing.assert_array_equal(layer, wanted)
    assert not any(np.array_equal(together.planes, layer) for layer in together.layers)


def test_mosaic_is_restored_better_than_what_demosaicing_made_of_it() -> None:
    lens = Soft(1.0, 1.0)
    seen, sharp = photo(lens, BASE)
    planes = demosaiced(seen)

    joint = correct_planes(planes, lens, FRAME, noise=BASE, cfa=BAYER).planes
    apart = correct_planes(planes, lens, FRAME, noise=BASE).planes

    assert rmse(joint, sharp) < 0.9 * rmse(apart, sharp)
    assert rmse(joint, sharp) < 0.8 * rmse(planes, sharp)


def test_cells_follow_a_kernel_that_changes_within_them() -> None:
    lens = Soft(0.7, 2.2)
    seen, sharp = photo(lens, BASE, LARGE)

    class Steps:
        """The same lens, but with one kernel in each cell: those of its neighbours are its own."""

        def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
            nearest = min(places, key=lambda place: abs(place.r - position.r) + abs(place.phi - position.phi))
            return lens.kernel_at(nearest, channel, size)

    # A window in one cell, whose neighbours Steps hides by answering for that cell alone.
    roi = (0, 0, 80, 100)
    places = [cells(LARGE, 100)[0].position]
    following = correct_planes(seen, lens, LARGE, noise=BASE, pitch=100, roi=roi).planes
    fixed = correct_planes(seen, Steps(), LARGE, noise=BASE, pitch=100, roi=roi).planes

    truth = sharp[:, :80, :100]
    assert rmse(following, truth) < rmse(fixed, truth)


@pytest.mark.parametrize(("error", "share"), [(0.0, 0.8), (0.25, 0.8), (0.5, 0.5)])
def test_of_a_processed_photo_the_less_is_made_the_less_sure_the_kernel_is(
    error: float, share: float
) -> None:
    seen, _ = photo(Soft(), BASE)

    full, part = (
        correct_planes(seen, Soft(), FRAME, noise=BASE, method="fast", psf_error=error, processed=processed)
        for processed in (False, True)
    )

    np.testing.assert_allclose(part.planes - seen, share * (full.planes - seen), atol=1e-5)
    assert np.abs(full.planes - seen).max() > 0.05
    assert full.zones["mid"].expected_gain_db >= part.zones["mid"].expected_gain_db


@pytest.mark.parametrize("cfa", [None, BAYER])
def test_one_pass_takes_larger_cells_on_a_mosaic_too(cfa: BayerPattern | None) -> None:
    frame = Frame(16, 6000)
    seen = np.full((3, frame.height, frame.width), 0.3, dtype=np.float32)
    steps: list[tuple[int, int]] = []

    correct_planes(
        seen, Soft(), frame, noise=BASE, method="fast", roi=(0, 0, 16, 900), cfa=cfa,
        on_step=lambda *step: steps.append(step),
    )  # fmt: skip

    assert steps[-1] == (3, 3)


def test_a_cell_of_which_next_to_nothing_is_left_to_correct_stays_as_it_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(0)
    seen = ndimage.gaussian_filter(rng.random((3, FRAME.height, FRAME.width), np.float32), (0, 1.5, 1.5))

    def hardly(method: object, tile: np.ndarray, *rest: object) -> Solution:
        del method, rest
        return Solution(tile + np.float32(1e-4) * rng.standard_normal(tile.shape, dtype=np.float32))

    monkeypatch.setattr("lensmodel.correction.cell.restore_planes", hardly)

    made = correct_planes(seen, Soft(), FRAME, noise=BASE, bounds=Bounds(texture=0.0))

    np.testing.assert_allclose(made.planes, seen, rtol=1e-6)  # faded cells add up to rounding
    assert made.nothing_to_correct
    assert all(zone.expected_gain_db == 0.0 for zone in made.zones.values())


@pytest.mark.parametrize("worth", [True, False])
def test_a_photo_that_gains_too_little_is_found_by_some_cells_and_stays_as_it_was(worth: bool) -> None:
    frame = Frame(720, 960)
    seen, _ = photo(Soft(), BASE, frame)
    steps: list[int] = []

    correct = partial(correct_planes, seen, Soft(), frame, noise=BASE, method="fast", pitch=64)

    made = correct(least_gain_db=0.3 if worth else 99.0, on_step=lambda done, _: steps.append(done))

    gained = correct().expected_gain_db
    assert made.expected_gain_db == pytest.approx(gained, rel=0.2)
    assert made.nothing_to_correct == (not worth)
    assert bool(steps) == worth
    assert np.array_equal(made.planes, seen) == (not worth)


def test_more_cells_are_tried_where_few_do_not_decide() -> None:
    frame = Frame(720, 1024)
    seen, _ = photo(Soft(), BASE, frame)
    correct = partial(correct_planes, seen, Soft(), frame, noise=BASE, method="fast", pitch=64)

    few, gained = (correct(least_gain_db=least).expected_gain_db for least in (99.0, None))
    assert few > gained + 0.05

    assert correct(least_gain_db=0.5 * (few + gained)).nothing_to_correct
    assert not correct(least_gain_db=gained - 0.05).nothing_to_correct


def test_compiling_is_told_once_and_loading_is_not(caplog: pytest.LogCaptureFixture) -> None:
    numba.njit(lambda x: x - 1)(1)  # what listens already has told its line now
    caplog.set_level(logging.INFO, whole_photo.first_use.name)
    caplog.clear()
    whole_photo.tell_of_compiling.cache_clear()  # another test may have asked for it
    whole_photo.tell_of_compiling()
    assert caplog.messages == []

    for number in (1, 1.0):  # compiled for each type anew
        numba.njit(lambda x: x + 1)(number)

    assert len(caplog.messages) == 1
    assert "once on this machine" in caplog.messages[0]
