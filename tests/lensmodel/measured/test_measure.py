"""PSFs measured on photos made for it: small frames, one kernel all over, so that the truth is plain."""

from __future__ import annotations

import io
import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage, signal, stats

from lab import targets
from lab.kernels import distance, gaussian
from lensmodel import measured as measure
from lensmodel import simulate
from lensmodel.core.errors import InvalidInputError, NotEnoughEvidenceError
from lensmodel.core.psf import as_kernel, centred
from lensmodel.core.types import Frame, Kernel, LensSettings, NoiseModel, StepHook, ignore_step
from lensmodel.measured.edges import SlantedEdges
from lensmodel.measured.measurer import Found, Measurer, Prepared, solve
from lensmodel.measured.pair import AperturePair, diffraction_otf
from lensmodel.measured.points import Points, find_lights, isolated_lights
from lensmodel.measured.registration import homography_of, match
from lensmodel.measured.target import PAPERS, Target, TargetPage
from lensmodel.model import LensModel
from lensmodel.photo import LinearPhoto
from lensmodel.photo.values import Encoding, PhotoInfo, PhotoMetadata

SHAPE = (360, 540)
PAIR_SHAPE = (288, 432)  # of less a pair is as good: it needs no lights and no page
NOISE = NoiseModel(1 / 40000, (4 / 40000) ** 2)


def board_scene(square_px: float, shape: tuple[int, int], setup: targets.Setup) -> np.ndarray:
    """Draw a checkerboard, turned by five degrees more than the setup says, as slanted charts are."""
    rows, cols = targets.fine_grid(shape)
    up, right = targets.seen(rows, cols, shape, setup)
    angle = math.radians(5.0)
    a = (up * math.cos(angle) - right * math.sin(angle)) / square_px
    b = (up * math.sin(angle) + right * math.cos(angle)) / square_px
    dark = (np.floor(a) + np.floor(b)) % 2 > 0
    light = np.where(dark, np.float32(0.12), np.float32(0.8))
    plane = np.maximum(targets.to_pixels(light), 0.0) * targets.falloff(shape, setup)
    return plane.astype(np.float32)


def light_scene(spacing: int, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Draw points of light anywhere between pixels, of different brightness, over a dark sky.

    A point between pixels is the sinc that a point is to whoever sees no finer than pixels. Its lobes are
    negative here and gone behind a lens.
    """
    plane = np.full([n + 2 * targets.MARGIN for n in shape], 0.003)  # a night sky over a suburb
    steps = [range(targets.MARGIN + spacing // 2, n + targets.MARGIN - spacing // 4, spacing) for n in shape]
    t = np.arange(-24, 25)
    taper = np.cos(np.linspace(-np.pi / 2, np.pi / 2, 49)) ** 0.5
    for place in itertools.product(*steps):
        at = np.array(place) + rng.uniform(-0.15, 0.15, 2) * spacing
        flux = 0.25 * 10.0 ** rng.uniform(0.0, 0.7)
        pixels = [t + round(each) for each in at]
        rows, cols = (np.sinc(each - middle) * taper for each, middle in zip(pixels, at, strict=True))
        plane[np.ix_(*pixels)] += flux * np.outer(rows, cols)
    return plane.astype(np.float32)


def moved_scene(scene: np.ndarray, shift: tuple[float, float], turn_deg: float) -> np.ndarray:
    """What a tripod that gave way a little shows of a scene: moved by parts of a pixel, and turned."""
    angle = math.radians(turn_deg)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    middle = (np.array(scene.shape) - 1.0) / 2.0
    start = middle - turn @ (middle + np.array(shift))
    moved = ndimage.affine_transform(scene, turn, start, order=5, mode="mirror", output=np.float32)
    return np.maximum(moved, 0.0)


def grey_photo(aperture: float | None = 2.0) -> LinearPhoto:
    grey = np.full([n + 2 * targets.MARGIN for n in SHAPE], 0.4)
    return photo_of(grey, lopsided(), aperture=aperture)


def lopsided() -> Kernel:
    """A core with a flare to the lower right: flips and turns of it are told apart."""
    core = gaussian(21, np.array([[1.0, 0.35], [0.35, 0.6]]))
    flare = np.roll(gaussian(21, np.array([[3.0, 1.0], [1.0, 2.0]])), (2, 1), (0, 1))
    return centred(0.75 * core + 0.25 * flare)


def at_f8() -> Kernel:
    """The kernel of 21 pixels of 4.5 um of a lens that only diffracts."""
    f = np.fft.fftfreq(128)
    whole = np.fft.ifft2(diffraction_otf(f[:, None], f[None, :], 8.0, 4.5, "g")).real
    index = np.arange(-10, 11)
    return as_kernel(np.maximum(whole[np.ix_(index, index)], 0.0))


def photo_of(
    scene: NDArray[np.floating], kernel: Kernel, seed: int = 0, aperture: float | None = 2.0
) -> LinearPhoto:
    """One Bayer photo of a scene with its margin."""
    rng = np.random.default_rng(seed)
    inner = slice(targets.MARGIN, -targets.MARGIN)
    blurred = signal.fftconvolve(scene, kernel, mode="same")[inner, inner]
    noisy = blurred + rng.standard_normal(blurred.shape) * np.sqrt(NOISE.variance(blurred))
    plane = np.clip(noisy, 0.0, 1.0).astype(np.float32)
    height, width = plane.shape
    metadata = PhotoMetadata(aperture=aperture, focal_mm=50.0, pixel_pitch_um=4.5)
    return LinearPhoto(
        planes=np.stack([plane] * 3),
        frame=Frame(height, width),
        noise=(NOISE,) * 3,
        clip=(1.0, 1.0, 1.0),
        info=PhotoInfo("dng", width, height, metadata),
        encoding=Encoding(),
        sensor_noise=(NOISE,) * 3,
        cfa=((0, 1), (1, 2)),
    )


# --- the solver ---------------------------------------------------------------------------------


def test_the_solver_finds_a_kernel_from_half_of_the_pixels() -> None:
    rng = np.random.default_rng(0)
    kernel = lopsided()
    latent = rng.uniform(0.2, 0.8, (96, 96))
    observed = signal.fftconvolve(latent, kernel, mode="valid") + rng.normal(0, 2e-3, (76, 76))
    measured = np.indices(observed.shape).sum(axis=0) % 2 == 0
    solved = solve(observed + 0.1, latent, measured, np.full(observed.shape, 4e-6), 21)
    seen = distance(solved.kernel, kernel).rel_l2
    assert seen < 0.05
    assert 0.5 < solved.error / seen < 2.0
    assert solved.light == pytest.approx(1.0, abs=0.02)
    assert np.hypot(*solved.shift) < 0.05


def test_too_few_pixels_determine_no_kernel() -> None:
    plane = np.ones((20, 20))
    with pytest.raises(NotEnoughEvidenceError, match="400 pixels count, 441"):
        solve(plane, np.ones((40, 40)), plane > 0, plane, 21)


# --- the page -----------------------------------------------------------------------------------


def test_a_page_is_the_same_each_time_and_passes_through_samples_of_its_own() -> None:
    page, again, other = (TargetPage(detail) for detail in (300, 300, 301))
    rows, cols = np.meshgrid(np.arange(80.0, 110.0), np.arange(120.0, 160.0), indexing="ij")

    assert np.array_equal(page.samples, again.samples)
    assert not np.array_equal(page.samples, other.samples[: page.shape[0], : page.shape[1]])
    # what ink and paper cut off moves a few of them a little
    assert np.median(np.abs(page.at(rows, cols) - page.samples[80:110, 120:160])) < 0.02


@pytest.mark.parametrize("paper", ["a4", "letter", "tabloid"])
def test_a_target_is_written_to_print_in_the_middle_of_its_paper(tmp_path: Path, paper: str) -> None:
    path, page = tmp_path / "target.pdf", TargetPage(300)
    measure.print_target(path, page, paper=paper)
    data = path.read_bytes()
    box = re.search(rb"/MediaBox \[ 0 0 (\S+) (\S+) \]", data)
    assert box is not None
    assert [float(side) for side in box.groups()] == pytest.approx(
        [side / 25.4 * 72 for side in PAPERS[paper]], rel=0.01
    )
    title = f"lensmodel target, detail 300, {paper.upper()}"  # as printing names it
    assert title.encode("utf-16-be") in data
    start = data.index(b"stream\n", data.index(b"/DCTDecode")) + len(b"stream\n")
    with Image.open(io.BytesIO(data[start:])) as picture:
        greys = np.asarray(picture, dtype=float) / 255.0
    rows, cols = page.raster.shape
    top, left = round((greys.shape[0] - rows) / 2), round((greys.shape[1] - cols) / 2)
    assert min(top, left) == 0
    assert (max(top, left) > 0) is (paper != "a4")
    inner = greys[top : top + rows, left : left + cols]
    assert np.abs(inner - page.raster)[page.border * 2 : -page.border * 2].max() < 0.02


@pytest.mark.parametrize(
    ("name", "paper", "said"), [("a.gif", "a4", "pdf"), ("a.pdf", "legal", "a2, a3, a4, letter")]
)
def test_other_files_and_papers_are_refused(tmp_path: Path, name: str, paper: str, said: str) -> None:
    with pytest.raises(InvalidInputError, match=said):
        measure.print_target(tmp_path / name, TargetPage(300), paper=paper)


# --- registration -------------------------------------------------------------------------------


def test_a_homography_is_found_from_four_corners() -> None:
    truth = np.array([[1.1, 0.02, 5.0], [-0.03, 0.9, -7.0], [1e-5, 2e-5, 1.0]])
    points = np.array([[0.0, 0.0], [0.0, 500.0], [300.0, 500.0], [300.0, 0.0]])
    raised = np.column_stack([points, np.ones(4)]) @ truth.T
    assert homography_of(points, raised[:, :2] / raised[:, 2:]) == pytest.approx(truth, abs=1e-6)


def test_a_match_says_how_far_the_photo_lies_beyond() -> None:
    plane = np.random.default_rng(0).standard_normal((128, 128))
    seen, _ = match(np.roll(plane, (3, -5), (0, 1)), plane)
    assert seen == pytest.approx((3, -5), abs=0.1)


class Sure(Measurer):
    """Measures one kernel in the same place, with these errors."""

    name, floor, most, shows = "sure", 0.0, 0.5, "one kernel"

    def __init__(self, *errors: float) -> None:
        self.errors = errors

    def _prepare(self, photos: Sequence[LinearPhoto], size: int, on_step: StepHook) -> Prepared:
        kernel = gaussian(size, np.eye(2))
        return self.errors, lambda error, _: Found(kernel, error, (30.0, 30.0))


def test_a_psf_whose_error_is_not_known_is_left_out_and_the_others_stay() -> None:
    photo = photo_of(np.full((128, 128), 0.3), gaussian(5, np.eye(2)))
    found = Sure(math.nan, 0.1, 0.6).measure([photo], size=9, channels=("g",))

    assert [psf.error for psf in found] == [0.1]
    with pytest.raises(NotEnoughEvidenceError, match="photograph one kernel"):
        Sure(math.nan).measure([photo], size=9)


# --- the ways -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def target_photo() -> LinearPhoto:
    scene = 0.8 * targets.target_scene(TargetPage(500), SHAPE, targets.Setup(fill=0.97))[1]
    return photo_of(scene, lopsided())


def test_a_target_gives_the_kernel_as_it_is(target_photo: LinearPhoto) -> None:
    method = Target(across=2, down=1, side=88, details=(500,))
    steps: list[tuple[int, int]] = []
    found = method.measure([target_photo], size=21, channels=("g",), on_step=lambda *step: steps.append(step))
    assert found
    assert steps.count((0, 1)) > 50  # a page that is still looked for shows that, too
    for one in found:
        seen = distance(one.kernel, lopsided()).rel_l2
        assert seen < 0.06
        assert 0.5 < one.error / seen < 2.5
        assert distance(np.rot90(one.kernel, 2), lopsided()).rel_l2 > 3 * seen


@pytest.mark.slow  # of two pages
def test_a_target_is_told_from_another(target_photo: LinearPhoto) -> None:
    assert Target(side=88, details=(400, 500)).find(target_photo, ignore_step).page.detail == 500


def test_points_between_pixels_are_stacked_and_saturated_ones_refused() -> None:
    scene = light_scene(60, SHAPE, np.random.default_rng(3))
    photo = photo_of(scene, lopsided())
    found = Points(across=2, down=2).measure([photo], size=21, channels=("g",))
    errors = [distance(one.kernel, lopsided()).rel_l2 for one in found]
    assert len(found) == 4
    assert max(errors) < 0.06
    lit = Points(across=2, down=2).measure([photo_of(scene + 0.27, lopsided())], size=21, channels=("g",))
    # 100 times the light of the sky
    assert max(distance(one.kernel, lopsided()).rel_l2 for one in lit) < 0.15
    assert min(one.error for one in lit) > max(one.error for one in found)
    bright = photo_of(40.0 * scene, lopsided())
    with pytest.raises(NotEnoughEvidenceError, match="expose less"):
        Points().measure([bright], size=21)


def test_points_sharper_than_pixels_state_what_their_kernel_does_not_explain() -> None:
    def seen_by_pixels(off: float) -> NDArray[np.float64]:  # a Gaussian of .3 pixels, gathered by each pixel
        return np.diff(stats.norm.cdf(np.arange(-10.5, 11.0) - off, scale=0.3))

    rng = np.random.default_rng(0)
    scene = np.full([n + 2 * targets.MARGIN for n in SHAPE], 0.003)
    for row, col in itertools.product(*(range(targets.MARGIN + 30, side, 56) for side in SHAPE)):
        light = np.outer(*(seen_by_pixels(off) for off in rng.uniform(-0.5, 0.5, 2)))
        scene[row - 10 : row + 11, col - 10 : col + 11] += 0.5 * light
    found = Points(across=2, down=1).measure([photo_of(scene, np.ones((1, 1)))], size=21, channels=("g",))
    truth = np.outer(seen_by_pixels(0.0), seen_by_pixels(0.0))
    for one in found:
        seen = distance(one.kernel, truth).rel_l2
        assert 0.5 < one.error / seen < 2.0


def test_an_ordinary_photo_is_called_no_photo_of_points() -> None:
    scene = simulate.demo_scene("city")[1, : SHAPE[0] + 56, : SHAPE[1] + 56]
    with pytest.raises(NotEnoughEvidenceError, match="no photo of points") as refusal:
        Points().measure([photo_of(scene, lopsided())], size=21)
    assert "expose" not in str(refusal.value)


def test_lights_beside_others_are_left_out() -> None:
    plane = np.zeros((120, 160))
    for row, col in ((40, 40), (40, 48), (80, 120)):
        plane[row - 8 : row + 9, col - 8 : col + 9] += gaussian(17, np.eye(2))
    plane += np.random.default_rng(0).normal(0, 1e-4, plane.shape)
    lights = find_lights(plane)
    assert len(lights) == 3
    assert [(round(row), round(col)) for row, col, _ in isolated_lights(lights, 21)] == [(80, 120)]


def pair_of(texture: NDArray[np.floating] | float, *, moved: bool = True) -> list[LinearPhoto]:
    """One scene wide open and at f/8, the second from where a tripod gave way; noise of local contrast."""
    padded = [n + 2 * targets.MARGIN for n in PAIR_SHAPE]
    noise = texture * np.random.default_rng(5).standard_normal(padded)
    scene = signal.fftconvolve(np.clip(0.4 + noise, 0.05, 0.9), gaussian(9, np.eye(2) * 0.2), mode="same")
    closed = moved_scene(scene.astype(np.float32), (0.4, -0.7), 0.05) if moved else scene
    return [photo_of(scene, lopsided()), photo_of(closed, at_f8(), 1, 8.0)]


def error_of_pair(pair: list[LinearPhoto], side: int, on_step: StepHook = ignore_step) -> float:
    method = AperturePair(across=2, down=1, side=side)
    found = method.measure(pair, size=21, channels=("g",), on_step=on_step)
    return float(np.median([distance(one.kernel, lopsided()).rel_l2 for one in found]))


def test_a_pair_gives_the_kernel_of_the_open_photo() -> None:
    steps: list[tuple[int, int]] = []

    assert error_of_pair(pair_of(0.12), 104, lambda *step: steps.append(step)) < 0.08
    assert steps.count((0, 1)) > 50  # aligning them shows, too


def test_a_pair_is_not_misled_by_detail_that_passed_for_noise() -> None:
    # the left of the frame is quiet
    contrast = np.clip(np.linspace(-0.06, 0.3, PAIR_SHAPE[1] + 2 * targets.MARGIN), 0.0, 0.12)
    said = (NoiseModel(100 * NOISE.shot, 100 * NOISE.read),) * 3  # as where no place of a photo is flat
    pair = [replace(photo, noise=said, sensor_noise=said) for photo in pair_of(contrast, moved=False)]

    assert error_of_pair(pair, 104) < 0.1


@pytest.mark.parametrize(
    ("method", "photos", "size", "said"),
    [
        (AperturePair(), 2, 21, "two stops"),
        (AperturePair(), 1, 21, "takes 2 photos"),
        (AperturePair(), 2, 20, "an odd side .* got 20"),
        (Target(details=(500,)), 1, 21, "corner discs"),
        (SlantedEdges(), 1, 21, "no chart was found"),
        (Points(), 1, 21, "0 isolated points of light"),
    ],
)
def test_photos_that_show_nothing_of_a_method_are_refused(
    method: Measurer, photos: int, size: int, said: str
) -> None:
    with pytest.raises((InvalidInputError, NotEnoughEvidenceError), match=said):
        method.measure([grey_photo()] * photos, size=size)


@pytest.mark.parametrize("covariance", [[[3.0, 0.0], [0.0, 0.8]], [[1.9, 1.1], [1.1, 1.9]]])
def test_squares_give_the_kernel_along_and_between_their_edges(covariance: list[list[float]]) -> None:
    kernel = gaussian(21, np.array(covariance))
    photo = photo_of(board_scene(110.0, SHAPE, targets.Setup(distortion=0.0)), kernel)
    found = SlantedEdges().measure([photo], size=21, channels=("g",))
    assert found
    seen = np.median([distance(one.kernel, kernel).rel_l2 for one in found])
    assert seen < 0.1
    assert all(distance(one.kernel, np.rot90(kernel)).rel_l2 > 0.3 for one in found)


def test_squares_give_red_its_own_kernel_where_demosaicing_gave_it_the_sharpness_of_green() -> None:
    soft, sharp = gaussian(21, np.diag([3.0, 1.6])), gaussian(21, np.diag([0.6, 0.6]))
    scene = board_scene(110.0, SHAPE, targets.Setup(distortion=0.0))
    photo = photo_of(scene, sharp)
    photo.planes[0, ::2, ::2] = photo_of(scene, soft, 1).planes[0, ::2, ::2]
    found = SlantedEdges().measure([photo], size=21, channels=("r",))
    assert found
    assert np.median([distance(one.kernel, soft).rel_l2 for one in found]) < 0.15


# --- samples and models -------------------------------------------------------------------------


def test_measured_samples_join_blind_ones() -> None:
    (old,), new = (
        Sure(0.04).measure(
            [grey_photo()], size=11, channels=("g",), settings=LensSettings(2.0), photo_id=name
        )
        for name in ("old", "new")
    )
    assert new[0].estimator == "measured-sure/1"
    assert new[0].measured
    model = LensModel.fit([replace(old, estimator="blind/1")])
    assert [s.photo for s in model.added(new).samples] == ["old", "new"]


def test_a_measurement_needs_an_aperture() -> None:
    with pytest.raises(Exception, match="aperture"):
        Target().measure([grey_photo(aperture=None)])
