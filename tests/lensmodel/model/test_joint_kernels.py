"""All patches of a lens solved together."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from lensmodel.core.psf import PsfSample, as_kernel, distance, gaussian, rms_width
from lensmodel.core.spectrum import RINGS, SECTORS, PatchSpectrum, bin_frequencies
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, Kernel, LensSettings, NoiseModel
from lensmodel.model import LensModel, LensProfile, ModelSettings, load_profile, save_profile
from lensmodel.model.modes import WAVEFRONT_SHARE, Mixture
from lensmodel.model.trust.expected_error import SampleEvidence, joint_error
from lensmodel.model.wavefront import from_kernels, joint_kernels, search
from lensmodel.model.wavefront.from_spectra import PatchView, PooledFit, fit_spectra
from lensmodel.model.wavefront.joint_kernels import MIN_PLACES, Pooled, _by_aperture, pool_samples
from lensmodel.model.wavefront.scene_view import Floats, SceneView
from lensmodel.model.wavefront.search import Group, pairs
from lensmodel.optics.aberration_prior import ABERRATIONS, corner_ratio, unlikeliness
from lensmodel.optics.transfer import (
    BINS,
    COLUMNS,
    FIRST_RING,
    Transfer,
    sums,
)
from lensmodel.optics.wavefront import Wavefront
from lensmodel.scene.prior import PATCHES
from lensmodel.simulate import SimulatedLens
from lensmodel.simulate.aberrations import Aberrations

PITCH = 4.5
SETTINGS = LensSettings(aperture=2.0)
WAVEFRONT = ModelSettings(mode="wavefront")
LENS = SimulatedLens(
    (
        Aberrations(
            f_number=2.0,
            spherical=2.5,
            defocus=-2.7,
            coma=4.0,
            astigmatism=2.0,
            field_curvature=-1.0,
            uniform_coma=(0.2, -0.1),
            vignetting=(1.15, 0.3),
        ),
    )
)
LOG_Q = math.log(0.54 * 2.0 / PITCH)


@cache
def phases(side: int) -> np.ndarray:
    """exp(-2 pi i f x) of each middle of a bin and each pixel, shape (BINS, side^2)."""
    modulus, angle = bin_frequencies()
    half = side // 2
    row, col = np.mgrid[-half : half + 1, -half : half + 1]
    return np.exp(
        -2j
        * np.pi
        * (modulus[:, None] * (np.sin(angle)[:, None] * row.ravel() + np.cos(angle)[:, None] * col.ravel()))
    )


def power_of(kernel: np.ndarray) -> np.ndarray:
    """|OTF|^2 at the middles of the bins by a direct sum, shape (BINS,)."""
    return np.abs(phases(kernel.shape[0]) @ kernel.ravel()) ** 2


@cache
def true_kernel(place: FieldPosition, channel: Channel) -> Kernel:
    return LENS.kernel(place, SETTINGS.with_channel(channel), 41)


@cache
def true_power(place: FieldPosition, channel: Channel) -> np.ndarray:
    return power_of(true_kernel(place, channel))


def seen_at(
    place: FieldPosition,
    rng: np.random.Generator,
    rough: float,
    blur: Kernel | None = None,
    filled: float = 0.0,
    beyond: Floats = PATCHES.with_power,
) -> dict[Channel, PatchSpectrum]:
    """Spectra of a scene that falls off by a power law, behind the lens or behind one kernel.

    `filled` is added to |OTF|^2, as a blur that changes within the patch fills its zeros; `beyond` is what
    the fit expects behind sharp lenses beyond their own |OTF|^2, which is exact here.
    """
    modulus, angle = bin_frequencies()
    slope, turned = rng.normal(2.1, 0.3), rng.uniform(0, math.pi)
    scene = 1e-2 * (modulus / 0.1) ** -slope * np.exp(0.3 * np.cos(2 * (angle - turned)))
    scene = scene * np.exp(rough * rng.standard_normal(BINS))
    found = {}
    for channel in CHANNELS:
        noise = 1e-7
        power = np.zeros((RINGS, SECTORS), np.float32)
        passed = true_power(place, channel) if blur is None else power_of(blur)
        seen = scene * np.exp(PATCHES.bias + beyond * passed**2) * (passed + filled)
        power[FIRST_RING:] = (seen + noise).reshape(-1, SECTORS)
        found[channel] = PatchSpectrum(power, noise)
    return found


def places(count: int, seed: int = 5) -> list[FieldPosition]:
    rng = np.random.default_rng(seed)
    return [
        FieldPosition(float(r), float(p))
        for r, p in zip(np.sqrt(rng.random(count)) * 0.95, rng.uniform(-3, 3, count), strict=True)
    ]


def view(place: FieldPosition, spectra: dict[Channel, PatchSpectrum], photo: str = "a") -> PatchView:
    return PatchView(place, SETTINGS, photo, SceneView.of({c: spectra[c] for c in ("g", "r", "b")}))


def true_front() -> Wavefront:
    optics, unit = LENS.at_focal(), 2 * math.exp(LOG_Q)
    terms = np.zeros(19)
    terms[0], terms[2], terms[3], terms[4] = optics.spherical, optics.coma, *optics.uniform_coma
    terms[6], terms[9] = optics.defocus, optics.field_curvature + optics.astigmatism / 2
    terms[13] = optics.astigmatism / 2
    return Wavefront(terms * unit, LOG_Q, (1.15, 0.3), 2.0, 31)


def errors_of(front: Wavefront) -> list[float]:
    found = []
    for r in (0.1, 0.5, 0.9):
        place = FieldPosition(r, 0.7)
        truth = LENS.kernel(place, SETTINGS, 41)
        kernel = front.kernel(place, SETTINGS, 41)
        found.append(min(distance(k, truth).rel_l2 for k in (kernel, kernel[::-1, ::-1])))
    return found


def test_power_is_that_of_the_simulated_lens() -> None:
    front = true_front()
    for place in (FieldPosition(0.1, 0.3), FieldPosition(0.6, -2.0), FieldPosition(0.9, 1.2)):
        x, y = place.r * math.cos(place.phi), place.r * math.sin(place.phi)
        found, _, _ = Transfer.of(math.exp(LOG_Q)).log_power(
            front.blur(place, SETTINGS)[:6], front.eye[0], (front.eye[1] * x, front.eye[1] * y)
        )
        truth = power_of(LENS.kernel(place, SETTINGS, 41))
        strong = truth > 0.05
        assert strong.sum() > 60
        assert np.abs(found - np.log(truth))[strong].max() < 0.3
        assert np.abs(found - np.log(truth))[strong].mean() < 0.06


def test_the_bias_has_the_symmetries_of_a_square_lattice() -> None:
    _, angle = bin_frequencies()
    by_ring = (PATCHES.bias + 0.4 * PATCHES.with_power).reshape(-1, SECTORS)
    folded = np.abs((angle[:SECTORS] + math.pi / 4) % (math.pi / 2) - math.pi / 4)

    for same in np.unique(folded.round(9)):
        alike = by_ring[:, np.isclose(folded, same)]
        assert alike.shape[1] == 4
        assert np.ptp(alike, axis=1).max() == 0.0


def test_zeros_that_are_filled_do_not_move_the_lens() -> None:
    rng = np.random.default_rng(3)
    seen = [view(p, seen_at(p, rng, 0.1, filled=rng.uniform(0.01, 0.04))) for p in places(32)]

    fitted = fit_spectra(seen, true_front(), rounds=12)

    assert max(errors_of(fitted.front)) < 0.1


def test_zeros_that_are_filled_do_not_move_the_lens_behind_exact_power() -> None:
    rng = np.random.default_rng(3)
    beyond = np.zeros(BINS)
    seen = [view(p, seen_at(p, rng, 0.1, filled=rng.uniform(0.01, 0.04), beyond=beyond)) for p in places(16)]

    fitted = fit_spectra(seen, true_front(), rounds=12)

    assert max(errors_of(fitted.front)) < 0.15


def test_derivatives_of_the_power_are_those_of_its_values() -> None:
    blur = np.array([0.6, 0.3, -0.2, -0.9, 0.4, 0.1])
    transfer, step = Transfer.of(0.4), 1e-2
    value, by_blur, by_eye = transfer.log_power(blur, 0.95, (0.1, -0.05))
    strong = value > -3.0
    for k in range(6):
        change = np.zeros(6)
        change[k] = step
        after = transfer.log_power(blur + change, 0.95, (0.1, -0.05))[0]
        before = transfer.log_power(blur - change, 0.95, (0.1, -0.05))[0]
        assert by_blur[strong, k] == pytest.approx((after - before)[strong] / (2 * step), abs=2e-2, rel=2e-2)
    # the edge of the second circle is one sample wide: its derivative is right on average
    wider = transfer.log_power(blur, 0.97, (0.1, -0.05))[0]
    narrower = transfer.log_power(blur, 0.93, (0.1, -0.05))[0]
    assert np.corrcoef(by_eye[strong, 0], (wider - narrower)[strong] / 0.04)[0, 1] > 0.95


@pytest.mark.parametrize("coarse", [False, True])
def test_compiled_sums_are_those_of_numpy(coarse: bool) -> None:
    compiled = pytest.importorskip("lensmodel.optics.compiled_transfer", reason="Numba is not installed")
    transfer = Transfer.of(0.4, coarse=coarse)
    turns = np.array([0.9, 0.4, -0.3, -1.1, 0.5, 0.1], dtype=np.float32)
    eye = np.array([0.95, 0.1, -0.05], dtype=np.float32)
    found = [np.zeros((transfer.pixel.size, COLUMNS), dtype=np.float32) for _ in range(2)]
    for loop, out in zip((sums, compiled.sums), found, strict=True):
        loop(*transfer.points, *transfer.shifts, turns, eye, np.float32(transfer.steep), out)

    assert np.abs(found[0] - found[1]).max() < 1e-4 * np.abs(found[0]).max()


def test_negative_of_a_wavefront_turns_its_kernels_and_keeps_their_power() -> None:
    front, place = true_front(), FieldPosition(0.9, 1.2)
    turned = replace(front, terms=-front.terms)
    here, there = front.kernel(place, SETTINGS, 31), turned.kernel(place, SETTINGS, 31)

    assert distance(there[::-1, ::-1], here).rel_l2 < 0.02
    assert distance(there, here).rel_l2 > 0.2
    assert power_of(there) == pytest.approx(power_of(here), abs=2e-3)


def test_generating_lens_scores_best() -> None:
    rng = np.random.default_rng(1)
    patches = [view(place, seen_at(place, rng, 0.0)) for place in places(16)]
    cost = fit_spectra(patches, true_front(), rounds=0).cost

    for index in (0, 2, 6, 9, 13):
        for change in (-0.25, 0.25):
            terms = true_front().terms.copy()
            terms[index] += change
            assert fit_spectra(patches, replace(true_front(), terms=terms), rounds=0).cost > cost


def test_fit_returns_to_the_lens_from_beside_it() -> None:
    rng = np.random.default_rng(2)
    patches = [view(place, seen_at(place, rng, 0.2)) for place in places(20)]
    terms = true_front().terms * 0.8
    terms[6] += 0.2

    found = fit_spectra(patches, replace(true_front(), terms=terms), rounds=20)

    assert max(errors_of(found.front)) < 0.25
    assert max(errors_of(found.front)) < max(errors_of(replace(true_front(), terms=terms)))
    assert found.trust.min() > 0.5


def test_a_patch_blurred_by_something_else_loses_its_trust() -> None:
    rng = np.random.default_rng(3)
    spots = places(16)
    spectra = [seen_at(place, rng, 0.1) for place in spots]
    row = np.arange(RINGS)[:, None]
    spoilt = {
        c: replace(s, power=(s.power * (1.0 + 200.0 * (row == 8))).astype(np.float32))
        for c, s in spectra[0].items()
    }

    found = fit_spectra(
        [view(p, s) for p, s in zip(spots, [spoilt, *spectra[1:]], strict=True)], true_front(), rounds=4
    )

    assert found.trust[0] < 0.85 * found.trust[1:].min()


def samples(count: int, photos: int = 1) -> list[PsfSample]:
    """Patches whose kernels are estimates: none is exact."""
    rng, astray, found = np.random.default_rng(4), np.random.default_rng(5), []
    for i, place in enumerate(places(count, 6)):
        spectra = seen_at(place, rng, 0.15)
        for channel in CHANNELS:
            settings = SETTINGS.with_channel(channel)
            width = rms_width(true_kernel(place, channel)) * astray.normal(1.0, 0.15)
            found.append(
                PsfSample(
                    gaussian(31, width**2 * np.eye(2)),
                    place,
                    settings,
                    0.5,
                    f"photo-{i % photos}",
                    PITCH,
                    spectrum=spectra[channel],
                )
            )
    return found


@pytest.fixture(scope="module")
def known() -> list[PsfSample]:
    return samples(MIN_PLACES + 2)


@pytest.fixture(scope="module")
def warm(known: list[PsfSample], searching_shortly: Callable[[], AbstractContextManager[None]]) -> LensModel:
    with searching_shortly():
        return LensModel.fit(known).warmed()


def gaussian_patch(width: float, rng: np.random.Generator, side: int = 192) -> PatchSpectrum:
    """Spectrum of noise of power 1/f^2 behind a Gaussian: made from pixels, not by the model's own rules."""
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None, :])
    frequency[0, 0] = np.inf
    passed = np.exp(-2.0 * np.pi**2 * width**2 * frequency**2) / frequency
    scene = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((side, side))) * passed, s=(side, side))
    patch = 0.5 + 0.12 * scene / scene.std() + rng.normal(0.0, 0.003, scene.shape)
    return PatchSpectrum.of(patch.astype(np.float32), NoiseModel.white(0.003), width)


@pytest.mark.parametrize(
    ("width", "seed"),
    [(1.0, 0), *(pytest.param(width, seed, marks=pytest.mark.slow) for width, seed in ((1.3, 2), (1.8, 3)))],
)
def test_plain_gaussian_comes_back_as_one_by_default(width: float, seed: int, short_search: None) -> None:
    rng, truth = np.random.default_rng(seed), gaussian(31, width**2 * np.eye(2))
    known = []
    for r, phi in zip(np.sqrt(rng.random(12)) * 0.95, rng.uniform(-3, 3, 12), strict=True):
        spectrum, place = gaussian_patch(width, rng), FieldPosition(float(r), float(phi))
        known.append(PsfSample(truth, place, SETTINGS, 0.5, "photo", PITCH, spectrum=spectrum))

    answer = LensModel.fit(known).warmed().query(FieldPosition(0.5, 0.4), SETTINGS, 31)

    assert distance(answer.kernel, truth).rel_l2 < 0.05
    assert answer.answered_by == "regression"


@pytest.mark.slow
def test_blur_that_kernels_agree_on_all_over_the_field_is_left_to_them() -> None:
    blur, rng = gaussian(41, 1.3**2 * np.eye(2)), np.random.default_rng(4)
    known = [
        PsfSample(gaussian(31, 1.3**2 * np.eye(2)), place, settings, 0.5, "photo", PITCH, spectrum=seen[c])
        for place in places(MIN_PLACES + 2, 6)
        for seen in [seen_at(place, rng, 0.15, blur)]
        for c in CHANNELS
        for settings in [SETTINGS.with_channel(c)]
    ]

    answer = LensModel.fit(known).warmed().query(FieldPosition(0.5, 0.4), SETTINGS, 31)

    # with much spherical aberration a wavefront comes near to a Gaussian, and is not asked
    assert (answer.answered_by, answer.reason) == (
        "regression",
        "kernels agree with each other all over the field",
    )
    assert distance(answer.kernel, gaussian(31, 1.3**2 * np.eye(2))).rel_l2 < 0.05


@pytest.mark.slow
def test_a_double_image_which_no_wavefront_makes_is_left_to_the_kernels() -> None:
    def twice(size: int) -> Kernel:
        light = np.zeros((size, size))
        light[size // 2, [size // 2 - 3, size // 2 + 3]] = 0.5
        return as_kernel(ndimage.gaussian_filter(light, 0.6))

    rng = np.random.default_rng(4)
    known = [
        PsfSample(twice(31), place, settings, 0.5, "photo", PITCH, spectrum=seen[c])
        for place in places(MIN_PLACES + 2, 6)
        for seen in [seen_at(place, rng, 0.15, twice(41))]
        for c in CHANNELS
        for settings in [SETTINGS.with_channel(c)]
    ]

    answer = LensModel.fit(known).warmed().query(FieldPosition(0.5, 0.4), SETTINGS, 31)

    assert (answer.answered_by, answer.reason) == ("regression", "no wavefront agrees with all patches")


def test_corner_ratio_is_that_of_the_spots_of_a_curved_field() -> None:
    terms = np.zeros(19)
    terms[6], terms[9] = 0.5, 1.2  # a disc of radius 2 (focus + curvature r^2), squared width radius^2 / 4

    expected = 0.5 * math.log((1.7**2 + 0.15) / (0.5**2 + 0.15))
    assert corner_ratio(terms)[0] == pytest.approx(expected, abs=0.02)


def test_what_speaks_against_a_lens_changes_as_its_slope_says() -> None:
    lens = np.concatenate([true_front().terms, [1.1, 0.2]])
    _, curvature, slope = unlikeliness(lens)
    for index in range(lens.size):
        step = np.zeros(lens.size)
        step[index] = 1e-4
        apart = unlikeliness(lens + step)[0] - unlikeliness(lens - step)[0]
        assert slope[index] == pytest.approx(apart / 4e-4, rel=1e-4, abs=1e-5)
    assert np.linalg.eigvalsh(curvature).min() > 0.0


def test_few_patches_are_not_pooled(known: list[PsfSample]) -> None:
    assert pool_samples(known[: len(CHANNELS) * (MIN_PLACES - 1)]) is None
    assert pool_samples([replace(s, spectrum=None) for s in known]) is None


@pytest.mark.slow
def test_pooled_lens_is_nearer_to_the_truth_than_its_samples_and_kept_by_profiles(tmp_path: Path) -> None:
    known = samples(24, photos=2)
    model = LensModel.fit(known).warmed()
    plain = LensModel.fit([replace(s, spectrum=None) for s in known]).warmed()

    asked, place = places(12, 9), FieldPosition(0.85, 0.4)
    errors, of_kernels = (
        [
            distance(kernel, LENS.kernel(p, SETTINGS, 31)).rel_l2
            for p, kernel in zip(asked, m.kernels(asked, SETTINGS, 31), strict=True)
        ]
        for m in (model, plain)
    )
    assert np.mean(errors) < 0.9 * np.mean(of_kernels), (np.mean(errors), np.mean(of_kernels))
    assert model.query(place, SETTINGS, 31).wavefront_share > 0.3

    save_profile(tmp_path / "a.lensprofile", LensProfile(model))
    back = load_profile(tmp_path / "a.lensprofile").model
    assert back.warm
    assert np.allclose(
        back.query(place, SETTINGS, 31).kernel, model.query(place, SETTINGS, 31).kernel, atol=1e-6
    )
    assert all(s.spectrum is not None for s in back.samples)


def test_a_wavefront_takes_part_only_where_its_diffraction_is_known(warm: LensModel) -> None:
    place, physics = FieldPosition(0.0, 0.0), warm.physical
    assert physics is not None
    unknown = replace(warm._fit, physical=replace(physics, diffraction_known=False))

    assert warm.query(place, SETTINGS, 31).wavefront_share == WAVEFRONT_SHARE
    answer = LensModel(warm.samples, warm.settings, unknown).query(place, SETTINGS, 31)
    assert (answer.wavefront_share, answer.answered_by) == (0.0, "regression")
    assert answer.reason == "aperture or pixel pitch unknown"


def test_a_lens_that_grows_is_fitted_from_where_its_last_fit_ended(
    warm: LensModel, known: list[PsfSample]
) -> None:
    assert warm.physical is not None
    more = [replace(s, photo="another") for s in known]
    learned = warm.learned()

    grown, anew = warm.added(more), LensModel.fit([*known, *more]).begun_with(learned)

    for model in (grown, anew):
        assert not model.warm
        (former,) = model._fit.former
        np.testing.assert_array_equal(former.terms, warm.physical.front.terms)
        assert former.eye == warm.physical.front.eye
    assert grown.added(more)._fit.former == grown._fit.former  # fitted only at the end of many photos


def test_damaged_memories_of_an_earlier_fit_are_no_beginnings(
    warm: LensModel, known: list[PsfSample]
) -> None:
    learned, rng = warm.learned(), np.random.default_rng(0)
    damaged = [b"", learned[: len(learned) // 2], LensModel.fit(known).learned()]
    for at in rng.integers(0, len(learned), 20):
        changed = bytearray(learned)
        changed[at] ^= 0xFF
        damaged.append(bytes(changed))

    for data in damaged:
        former = LensModel.fit(known).begun_with(data)._fit.former
        assert all(np.isfinite(front.terms).all() for front in former)
    assert LensModel.fit(known).begun_with(damaged[1])._fit.former == ()
    assert LensModel.fit(known).begun_with(damaged[2])._fit.former == ()


def test_without_an_earlier_fit_single_photos_are_fitted_first(
    known: list[PsfSample], monkeypatch: pytest.MonkeyPatch, short_search: None
) -> None:
    begun: list[int] = []

    def searched(
        groups: list[Group], _parts: object, begins: list[Wavefront], former: list[Wavefront], _hook: object
    ) -> list[PooledFit]:
        begun.append(len(former))
        return [PooledFit(begins[0], 0.0, np.eye(21), np.ones(len(groups)))]

    monkeypatch.setattr(joint_kernels, "_MOST_SINGLE", 2)
    monkeypatch.setattr(joint_kernels, "fit_wavefront", lambda _: true_front())
    monkeypatch.setattr(joint_kernels, "starts", lambda *_: [])
    monkeypatch.setattr(joint_kernels, "search", searched)
    monkeypatch.setattr(joint_kernels, "held_out", lambda *_: 0.0)
    two = [*known, *(replace(s, photo="another") for s in known)]

    found = pool_samples(two)
    assert found is not None
    assert begun == [0, 0, 2]  # each photo alone, then both beginning with them

    pool_samples(two, known=[found.front])
    assert begun[3:] == [1]


def test_kernels_and_wavefront_answer_together_where_diffraction_is_known(warm: LensModel) -> None:
    place = FieldPosition(0.7, 0.4)
    kernels, wavefront = (
        warm.opinion(mode).kernels([place], SETTINGS, 31) for mode in ("kernels", "wavefront")
    )

    answer = warm.query(place, SETTINGS, 31)

    assert (answer.answered_by, answer.wavefront_share) == ("wavefront and regression", WAVEFRONT_SHARE)
    turned = warm.physical.turned  # no tail tells on which side of these kernels it lies
    either = (1.0 - turned) * wavefront[0] + turned * wavefront[0][::-1, ::-1]
    expected = (1.0 - WAVEFRONT_SHARE) * kernels[0] + WAVEFRONT_SHARE * either
    np.testing.assert_allclose(answer.kernel, expected, atol=1e-9)


def test_measured_kernels_leave_a_wavefront_no_say(known: list[PsfSample], warm: LensModel) -> None:
    measured = [replace(s, error=0.05) for s in known]
    learned = replace(LensModel.fit(measured)._fit, physical=warm._fit.physical)
    model = LensModel(tuple(measured), ModelSettings(), learned)
    plain = LensModel.fit(measured, ModelSettings(mode="kernels"))

    answer, other = (m.query(FieldPosition(0.7, 0.4), SETTINGS, 31) for m in (model, plain))

    assert answer.wavefront_share == 0.0
    assert (answer.answered_by, answer.reason) == ("regression", "kernels were measured")
    assert np.array_equal(answer.kernel, other.kernel)
    assert answer.predicted_error == pytest.approx(other.predicted_error)


def test_the_error_to_expect_grows_with_what_kernels_and_wavefront_differ_by() -> None:
    evidence = SampleEvidence(0.01, 0.16, 2.0, 0.3, extrapolated=False, usual=0.1)

    def error(apart: float, r: float = 0.5) -> float:
        one = np.ones(1)
        shares = WAVEFRONT_SHARE * one
        mixture = Mixture(one[:, None, None], 0.1 * one, 0.1, shares, 0.1 * one, apart * one, 0.0 * one)
        return joint_error(evidence, mixture, r)

    assert error(0.05) < error(0.2) < error(0.8)
    assert error(0.2, 0.1) < error(0.2, 0.9)
    assert 0.05 < error(0.2) < 0.5


def test_unknown_pitch_is_taken_as_a_usual_one_not_as_wide_kernels_suggest(
    known: list[PsfSample], short_search: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    for rounds in ("_COARSE_ROUNDS", "_MEDIUM_ROUNDS", "_FINE_ROUNDS"):
        monkeypatch.setattr(search, rounds, 1)  # the pitch is chosen before the first of them,
    monkeypatch.setattr(from_kernels, "_FINE_ROUNDS", 2)  # and kernels have had their say after two
    unknown = [replace(s, kernel=gaussian(31, 4.0 * np.eye(2)), pixel_pitch_um=None) for s in known]
    found = pool_samples(unknown)

    assert found is not None
    assert not found.diffraction_known
    assert found.front.log_q == pytest.approx(LOG_Q)


@pytest.mark.slow
def test_a_wavefront_that_was_fitted_without_a_pitch_takes_no_part(
    known: list[PsfSample], short_search: None
) -> None:
    unknown = LensModel.fit([replace(s, pixel_pitch_um=None) for s in known]).warmed()

    assert unknown.physical is not None
    assert unknown.query(FieldPosition(0.0, 0.0), SETTINGS, 31).reason == "aperture or pixel pitch unknown"


def test_error_is_told_even_where_the_cat_s_eye_is_hardly_known() -> None:
    front, unknown = true_front(), np.zeros((21, 21))
    unknown[19:, 19:] = np.diag([1.0, 9.0])  # many a drawn pupil would let no light pass at the corner
    fitted = Pooled(PooledFit(front, 0.0, unknown, np.ones(1)), 0.0, {"a": 1.0}, diffraction_known=True)
    samples = [
        PsfSample(gaussian(31, 1.0), FieldPosition(1.0, phi), SETTINGS, photo="a") for phi in (0.0, 2.0)
    ]

    found = fitted.errors(samples)

    known = Pooled(
        PooledFit(front, 0.0, np.zeros((21, 21)), np.ones(1)), 0.0, {}, diffraction_known=True
    ).errors(samples)
    assert found.min() > known.max()


def test_focus_that_balances_spherical_aberration_is_expected() -> None:
    noise = PatchSpectrum(np.full((RINGS, SECTORS), 1e-7, np.float32), 1e-7)
    nothing = view(FieldPosition(0.5, 0.0), dict.fromkeys(CHANNELS, noise))
    alone, both = (replace(true_front(), terms=np.zeros(19)) for _ in range(2))
    alone.terms[0] = both.terms[0] = 1.0
    both.terms[6] = ABERRATIONS.balance

    costs = [fit_spectra([nothing], front, rounds=0).cost for front in (alone, both)]

    assert costs[0] - costs[1] > 3.0


def test_wavefront_is_never_surer_than_the_kernels_nor_than_it_agrees_with_them(
    known: list[PsfSample], warm: LensModel
) -> None:
    wide = [replace(s, kernel=gaussian(31, 2.0**2 * np.eye(2)), error=0.3) for s in known]
    place = FieldPosition(0.2, 0.4)
    plain, cold = LensModel.fit(wide), LensModel.fit(wide, WAVEFRONT)
    alone = LensModel(tuple(wide), WAVEFRONT, replace(cold._fit, physical=warm._fit.physical))

    answer, other = alone.query(place, SETTINGS, 31), plain.query(place, SETTINGS, 31)

    assert answer.wavefront_share == 1.0
    apart = distance(answer.kernel, other.kernel).rel_l2
    assert apart > 0.3
    assert answer.predicted_error >= min(apart, 1.0) - 1e-6
    assert answer.predicted_error >= other.predicted_error


def test_photos_stopped_down_do_not_take_the_places_of_others() -> None:
    def taken(aperture: float | None, count: int) -> list[PsfSample]:
        settings = LensSettings(aperture)
        return [PsfSample(gaussian(9, np.eye(2)), place, settings) for place in places(count)]

    wide, nearly, narrow, unknown = taken(2.0, 6), taken(2.8, 3), taken(4.0, 30), taken(None, 2)
    together = [*narrow, *wide, *nearly, *unknown]

    assert _by_aperture(together, 2.0) == ([*wide, *nearly, *unknown], narrow)
    assert _by_aperture([*wide, *narrow], 2.0) == ([*wide, *narrow], [])  # too few would be left
    assert _by_aperture(together, None) == (together, [])


def test_photos_are_paired_whatever_their_order_and_few_are_not() -> None:
    samples = [
        PsfSample(gaussian(9, np.eye(2)), FieldPosition(0.1 * i, 1.0), LensSettings(2.0), photo=photo)
        for i, photo in enumerate("edcbaabcde")
    ]

    found = [{s.photo for s in part} for part in pairs(samples)]

    assert found == [{s.photo for s in part} for part in pairs(samples[::-1])] == [{"a", "b"}, {"c", "d"}]
    assert [len(part) for part in pairs(samples)] == [4, 4]
    assert pairs([s for s in samples if s.photo in "ab"]) == []
