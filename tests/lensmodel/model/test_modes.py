"""What is made of the neighbours of a question, and how likely patches are behind it."""

from __future__ import annotations

import json
import math
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lensmodel.core.errors import UnknownMethodError
from lensmodel.core.psf import PsfSample, as_kernel, centred, distance, gaussian
from lensmodel.core.spectrum import PatchSpectrum, binned_spectrum
from lensmodel.core.types import FieldPosition, Kernel, LensSettings, NoiseModel
from lensmodel.model import LensModel, LensProfile, ModelSettings, load_profile, save_profile
from lensmodel.model.wavefront.likelihood import surprise

SIZE = 13
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


def seen(place: FieldPosition, rng: np.random.Generator, photo: str = "a") -> PsfSample:
    """The kernel of a place with noise in it."""
    spoilt = truth(place) + 0.01 * rng.normal(size=(SIZE, SIZE))
    return PsfSample(centred(as_kernel(np.maximum(spoilt, 0.0))), place, SETTINGS, photo=photo)


def places(count: int, seed: int, outmost: float = 0.9) -> list[FieldPosition]:
    rng = np.random.default_rng(seed)
    r = outmost * np.sqrt(rng.random(count))
    return [FieldPosition(float(a), float(p)) for a, p in zip(r, rng.uniform(-3, 3, count), strict=True)]


@pytest.fixture(scope="module")
def noisy() -> list[PsfSample]:
    rng = np.random.default_rng(0)
    return [seen(place, rng, f"p{i % 2}") for i, place in enumerate(places(40, 1))]


@pytest.mark.parametrize(
    ("mode", "why"),
    [("guess", "not known"), ("likeliest", "gone"), ("evidence", "gone"), ("mixed", "gone")],
)
def test_unknown_modes_are_refused_with_the_known_ones(mode: str, why: str) -> None:
    known = "both, kernels, wavefront, paper"
    with pytest.raises(UnknownMethodError, match=f"{why}; choose one of {known}"):
        ModelSettings(mode=mode)


@pytest.mark.parametrize(
    ("mode", "method"), [("likeliest", "abramson"), ("mixed", "blended"), ("evidence", "combined")]
)
def test_a_profile_of_a_former_mode_opens_in_the_usual_one(
    mode: str, method: str, noisy: list[PsfSample], tmp_path: Path
) -> None:
    model = LensModel.fit(noisy)
    save_profile(tmp_path / "new.lensprofile", LensProfile(model))
    with (
        zipfile.ZipFile(tmp_path / "new.lensprofile") as new,
        zipfile.ZipFile(tmp_path / "old.lensprofile", "w") as old,
    ):
        for name in new.namelist():
            data = new.read(name)
            if name == "profile.json":
                document = json.loads(data)
                document["model"] |= {"mode": mode, "method": method}
                data = json.dumps(document).encode()
            old.writestr(name, data)
        old.writestr("evidence/0.npz", b"of an earlier version")

    back = load_profile(tmp_path / "old.lensprofile").model

    assert (back.settings.mode, back.settings.method) == ("both", "combined")
    place = FieldPosition(0.5, 1.0)
    one, other = (m.query(place, SETTINGS, SIZE).kernel for m in (model, back))
    assert np.abs(one - other).max() < 1e-6


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

    assert (answer.answered_by, answer.wavefront_share, model.flags()) == ("paper", 0.0, ())
    assert distance(answer.kernel, wanted).rel_l2 < 0.02
