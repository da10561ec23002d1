"""What is made of the neighbours of a question: kernels averaged, evidence pooled, one wavefront."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lensmodel.core.errors import UnknownMethodError
from lensmodel.core.evidence import PatchEvidence, solve_kernel
from lensmodel.core.psf import PsfSample, as_kernel, centred, distance, gaussian
from lensmodel.core.spectrum import PatchSpectrum, binned_spectrum
from lensmodel.core.types import FieldPosition, Kernel, LensSettings, NoiseModel
from lensmodel.model import LensModel, LensProfile, ModelSettings, load_profile, save_profile
from lensmodel.model.wavefront.likelihood import likeliest, surprise

SIZE, SIDE = 13, 128
SETTINGS = LensSettings(aperture=2.0)


def truth(place: FieldPosition) -> Kernel:
    """Wide along v, with a tail outwards, both growing with r."""
    c, s = math.cos(place.phi), math.sin(place.phi)
    u, v = np.array([-s, c]), np.array([-c, -s])  # (row, col)
    wide = 1.0 + 0.5 * place.r**2
    core = np.array(gaussian(SIZE, 0.8**2 * np.outer(u, u) + wide**2 * np.outer(v, v)))
    t = np.arange(SIZE) - SIZE // 2
    drow, dcol = np.meshgrid(t, t, indexing="ij")
    away = 4.0 * place.r
    tail = np.exp(-0.5 * ((drow - away * u[0]) ** 2 + (dcol - away * u[1]) ** 2) / 0.9**2)
    return centred(as_kernel(core + 0.5 * tail / tail.sum()))


def scene(rng: np.random.Generator) -> np.ndarray:
    blocks = np.kron(rng.random((SIDE // 4, SIDE // 4)), np.ones((4, 4)))
    whole = blocks + 0.2 * rng.random((SIDE, SIDE))
    return np.asarray(whole - whole.mean())


def seen(place: FieldPosition, rng: np.random.Generator, sigma: float, photo: str = "a") -> PsfSample:
    """A patch whose scene is known: its statistics, and the kernel that they give alone."""
    spread = np.zeros((SIDE, SIDE))
    spread[:SIZE, :SIZE] = truth(place)
    spread = np.roll(spread, (-(SIZE // 2),) * 2, axis=(0, 1))
    x = np.fft.fft2(scene(rng))
    y = np.fft.ifft2(x * np.fft.fft2(spread)).real + rng.normal(0.0, sigma, (SIDE, SIDE))
    own = np.roll(np.fft.ifft2(np.abs(x) ** 2).real, (SIZE - 1,) * 2, axis=(0, 1))
    cross = np.roll(np.fft.ifft2(np.fft.fft2(y) * np.conj(x)).real, (SIZE // 2,) * 2, axis=(0, 1))
    noise = NoiseModel.white(sigma)
    power, floor = binned_spectrum(y.astype(np.float32), noise)
    evidence = PatchEvidence(
        own[: 2 * SIZE - 1, : 2 * SIZE - 1].astype(np.float32),
        cross[:SIZE, :SIZE].astype(np.float32),
        SIDE * SIDE,
        sigma,
        power,
        floor,
    )
    return PsfSample(
        solve_kernel([evidence], [1.0], SIZE),
        place,
        SETTINGS,
        photo=photo,
        evidence=evidence,
        spectrum=PatchSpectrum(power, floor),
    )


def places(count: int, seed: int, outmost: float = 0.9) -> list[FieldPosition]:
    rng = np.random.default_rng(seed)
    r = outmost * np.sqrt(rng.random(count))
    return [FieldPosition(float(a), float(p)) for a, p in zip(r, rng.uniform(-3, 3, count), strict=True)]


@pytest.fixture(scope="module")
def noisy() -> list[PsfSample]:
    rng = np.random.default_rng(0)
    return [seen(place, rng, 0.5, f"p{i % 2}") for i, place in enumerate(places(40, 1))]


def wide(mode: str) -> ModelSettings:
    """Bandwidths at which many patches count."""
    return ModelSettings(mode=mode, r=0.15, phi=3.0)


def errors(model: LensModel) -> float:
    asked = places(5, 2, 0.8)
    return float(np.mean([distance(model.query(p, SETTINGS, SIZE).kernel, truth(p)).rel_l2 for p in asked]))


def test_pooled_evidence_is_nearer_to_the_truth_than_averaged_kernels(noisy: list[PsfSample]) -> None:
    alone = float(np.mean([distance(s.kernel, truth(s.position)).rel_l2 for s in noisy]))
    averaged = errors(LensModel.fit(noisy, wide("kernels")))
    pooled = errors(LensModel.fit(noisy, wide("evidence")))

    assert pooled < 0.85 * averaged < 0.85 * 0.5 * alone


def test_order_of_samples_does_not_matter_to_pooled_evidence(noisy: list[PsfSample]) -> None:
    place = FieldPosition(0.5, 1.0)
    shuffled = [noisy[i] for i in np.random.default_rng(1).permutation(len(noisy))]

    one = LensModel.fit(noisy, wide("evidence")).query(place, SETTINGS, SIZE).kernel
    other = LensModel.fit(shuffled, wide("evidence")).query(place, SETTINGS, SIZE).kernel

    assert np.abs(one - other).max() < 1e-4 * one.max()


def test_evidence_added_later_counts_as_if_it_had_been_there() -> None:
    rng = np.random.default_rng(5)
    samples = [seen(place, rng, 0.2) for place in places(42, 4)]
    place = FieldPosition(0.4, -1.0)
    settings = replace(wide("evidence"), robust=False, mirror=0.0)

    grown = LensModel.fit(samples[:40], settings).added(samples[40:])
    whole = LensModel.fit(samples, settings)

    # widths and bandwidths of settings are those of the first forty: the kernels are alike, not equal
    apart = distance(grown.query(place, SETTINGS, SIZE).kernel, whole.query(place, SETTINGS, SIZE).kernel)
    assert apart.rel_l2 < 0.05
    assert len(grown.weights(place, SETTINGS)[0]) == len(whole.weights(place, SETTINGS)[0])


def test_evidence_turns_with_its_place() -> None:
    rng, turn = np.random.default_rng(3), math.pi / 2
    there = [FieldPosition(0.6 + 0.01 * i, 0.0) for i in range(3)]
    model = LensModel.fit([seen(p, rng, 0.01) for p in there], ModelSettings(mode="evidence"))
    place = FieldPosition(0.61, turn)

    answer = model.query(place, SETTINGS, SIZE)

    assert answer.mode == "evidence"
    assert distance(answer.kernel, truth(place)).rel_l2 < 0.05
    assert distance(answer.kernel[::-1, ::-1], truth(place)).rel_l2 > 0.2


def test_without_evidence_kernels_are_averaged(noisy: list[PsfSample]) -> None:
    bare = [replace(s, evidence=None) for s in noisy]
    place = FieldPosition(0.5, 1.0)

    averaged = LensModel.fit(bare, wide("kernels")).query(place, SETTINGS, SIZE).kernel
    pooled = LensModel.fit(bare, wide("evidence")).query(place, SETTINGS, SIZE).kernel

    assert np.array_equal(averaged, pooled)


def test_evidence_travels_with_the_profile(noisy: list[PsfSample], tmp_path: Path) -> None:
    model, place = LensModel.fit(noisy, wide("evidence")), FieldPosition(0.5, 1.0)
    save_profile(tmp_path / "a.lensprofile", LensProfile(model))

    back = load_profile(tmp_path / "a.lensprofile").model

    assert back.settings.mode == "evidence"
    one, other = (m.query(place, SETTINGS, SIZE).kernel for m in (model, back))
    assert np.abs(one - other).max() < 1e-5


def test_unknown_modes_are_refused_with_the_known_ones() -> None:
    with pytest.raises(UnknownMethodError, match="evidence"):
        ModelSettings(mode="guess")


def patch_behind(kernel: Kernel, rng: np.random.Generator) -> PsfSample:
    """A patch with the spectrum of a scene that falls off by a power law, behind a kernel."""
    side = 192
    down, right = np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side), indexing="ij")
    fall = np.maximum(np.hypot(down, right), 0.5 / side) ** -1.05
    spread = np.zeros((side, side))
    spread[: kernel.shape[0], : kernel.shape[0]] = kernel
    white = np.fft.fft2(rng.normal(size=(side, side)))
    y = np.fft.ifft2(white * fall * np.fft.fft2(spread)).real
    y = 0.4 + 0.1 * y / y.std() + rng.normal(0.0, 1e-3, y.shape)
    power, floor = binned_spectrum(y.astype(np.float32), NoiseModel.white(1e-3))
    return PsfSample(kernel, FieldPosition(0.5, 0.0), SETTINGS, spectrum=PatchSpectrum(power, floor))


def test_true_kernel_makes_patches_likelier_than_others() -> None:
    rng = np.random.default_rng(7)
    right = gaussian(SIZE, [[1.6**2, 0.0], [0.0, 0.9**2]])
    patches = [patch_behind(right, rng) for _ in range(6)]

    def cost(kernel: Kernel) -> float:
        return sum(surprise(patch, kernel) for patch in patches)

    wrong = ([[0.9**2, 0.0], [0.0, 1.6**2]], [[2.4**2, 0.0], [0.0, 1.4**2]], [[0.6**2, 0.0], [0.0, 0.4**2]])
    assert all(cost(right) < cost(gaussian(SIZE, covariance)) for covariance in wrong)


def test_likeliest_predictor_wins_and_none_sees_what_it_is_judged_by() -> None:
    rng = np.random.default_rng(8)
    right = gaussian(SIZE, [[1.5**2, 0.0], [0.0, 1.0]])
    patches = [replace(patch_behind(right, rng), photo=f"p{i % 4}") for i in range(8)]
    shown: list[set[str]] = []

    def learn(seen: list[PsfSample]) -> dict[str, object]:
        shown.append({s.photo for s in seen})
        return {"narrow": lambda _: gaussian(SIZE, 0.3 * np.eye(2)), "right": lambda _: right}

    assert likeliest(patches, learn) == "right"  # type: ignore[arg-type] # lambdas of one sample
    assert len(shown) == 3
    assert all(len(photos) < 4 for photos in shown)


def test_patches_that_share_one_kernel_choose_no_mode(noisy: list[PsfSample]) -> None:
    twins = [replace(s, photo="one", kernel=gaussian(SIZE, np.eye(2))) for s in noisy[:3]]

    model = LensModel.fit(twins, wide("likeliest")).warmed()

    assert model.query(FieldPosition(0.5, 1.0), SETTINGS, SIZE).mode == "kernels"


def test_likeliest_mode_is_found_by_warming_and_kept_by_what_was_learned(noisy: list[PsfSample]) -> None:
    # spectra of so small patches tell little: kernels are what is judged by here
    samples = [replace(s, spectrum=None, kernel=truth(s.position)) for s in noisy[:10]]
    samples = [replace(s, evidence=None) for s in samples]
    model = LensModel.fit(samples, wide("likeliest"))

    warmed = model.warmed()
    place = FieldPosition(0.5, 1.0)

    assert model.query(place, SETTINGS, SIZE).mode == "kernels"
    found = warmed.query(place, SETTINGS, SIZE).mode
    assert found in {"mixed", "kernels"}
    again = LensModel.restored(samples, warmed.learned(), wide("likeliest"))
    assert again.query(place, SETTINGS, SIZE).mode == found


def test_the_papers_way_is_its_equations_and_nothing_else(noisy: list[PsfSample]) -> None:
    # all on one meridian, where turning into local frames changes nothing; one kernel is far off
    line = [replace(s, position=FieldPosition(0.02 * i, 1.0)) for i, s in enumerate(noisy)]
    odd = replace(line[7], kernel=centred(as_kernel(np.eye(SIZE))), weight=0.3)
    samples = [*line[:7], odd, *line[8:]]
    model = LensModel.fit(samples, ModelSettings(mode="paper"))
    asked = FieldPosition(0.31, 1.0)

    radii = np.array([s.position.r for s in samples])
    d = 2  # r and phi: no setting varies
    h = radii.std() * (4.0 / ((d + 2) * len(radii))) ** (1.0 / (d + 4))
    votes = np.array([s.weight for s in samples]) * np.exp(-0.5 * ((radii - asked.r) / h) ** 2)
    wanted = np.average([s.kernel for s in samples], axis=0, weights=votes)

    answer = model.warmed().query(asked, SETTINGS, SIZE)

    assert (answer.mode, answer.wavefront_share, model.flags()) == ("paper", 0.0, ())
    assert distance(answer.kernel, wanted).rel_l2 < 0.02
