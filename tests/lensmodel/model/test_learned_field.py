"""Attention over encoded patches: what holds whatever the network has learned.

A small network stands in for the trained one: its weights fall with the distance, its kernels are Gaussians
whose width patches tell, and it is the surer the more patches there are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lab.kernels import distance, gaussian
from lensmodel.core.psf import TOKEN_LENGTH, EncodedPatch, PsfSample, delta, rms_width
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings
from lensmodel.lens import Lens
from lensmodel.model import LensModel
from lensmodel.model.learned_field import NEAREST
from lensmodel.neural.network import FieldAnswer, FieldNetwork

F2 = LensSettings(aperture=2.0)
SIDE = 75
T = np.arange(SIDE) - SIDE // 2


@dataclass(frozen=True)
class Told:
    """Tokens and places of a memory."""

    tokens: NDArray[np.float32]
    xy: NDArray[np.float64]


class SmallNetwork:
    """Weights exp(-|x - x_i|^2 / 0.1), a Gaussian of the mean width that tokens tell."""

    def __init__(self, name: str = "small") -> None:
        self.name, self.encoded, self.remembered = name, 0, 0

    def encode(self, statistics: NDArray[Any], xy: NDArray[Any], conditions: object) -> NDArray[np.float32]:
        del xy, conditions
        self.encoded += len(statistics)
        return np.repeat(statistics[:, :1], TOKEN_LENGTH, axis=1).astype(np.float32)

    def memory(self, tokens: NDArray[Any], xy: NDArray[Any], conditions: Sequence[object]) -> Told:
        assert len(tokens) == len(xy) == len(conditions) <= NEAREST
        self.remembered += 1
        return Told(tokens, xy)

    def query(self, memory: Told, xy: NDArray[Any], conditions: object) -> FieldAnswer:
        del conditions
        weights = np.exp(-10.0 * ((memory.xy - xy) ** 2).sum(axis=1)) + 1e-9
        weights /= weights.sum()
        width = float(weights @ memory.tokens[:, 0])
        kernel = np.exp(-0.5 * (T[:, None] ** 2 + T[None] ** 2) / width**2)
        error = 0.05 + 0.3 * float(np.sqrt(weights @ weights))
        kernels = np.stack([kernel / kernel.sum()] * 3)
        return FieldAnswer(kernels, np.full(3, error), np.full((3, 8), 0.1), weights)


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Iterator[SmallNetwork]:
    small = SmallNetwork()
    monkeypatch.setattr(FieldNetwork, "load", lambda: small)
    return small


def photo(name: str, seed: int, width: float = 2.0, count: int = 48, **more: Any) -> list[PsfSample]:
    """Samples of one photo: its patches, three channels of each."""
    rng, samples = np.random.default_rng(seed), []
    for r, phi in zip(np.sqrt(rng.random(count)), rng.uniform(-3.1, 3.1, count), strict=True):
        patch = EncodedPatch(np.full(9, width, np.float16), np.full(TOKEN_LENGTH, width, np.float16))
        for channel in CHANNELS:
            kernel, place = gaussian(15, width**2 * np.eye(2)), FieldPosition(float(r), float(phi))
            told = {"photo": name, "estimator": "default/small", "encoded": patch, "error": 0.3} | more
            samples.append(PsfSample(kernel, place, F2.with_channel(channel), **told))
    return samples


PLACES = [FieldPosition(0.0, 0.0), FieldPosition(0.4, 1.0), FieldPosition(0.9, -2.0)]


def test_answers_with_a_kernel_its_error_and_what_it_rests_on(network: SmallNetwork) -> None:
    model = LensModel.fit([*photo("a", 1), *photo("b", 2)])
    answer = model.query(PLACES[1], F2, 31)

    assert answer.kernel.shape == (31, 31)
    assert answer.kernel.sum() == pytest.approx(1.0)
    assert rms_width(answer.kernel) == pytest.approx(2.0, rel=0.05)
    assert (answer.weights, answer.photos) == ("small", 2)
    assert 1.0 < answer.effective_samples < 96.0
    assert answer.ring_error is not None
    assert answer.ring_error.shape == (8,)
    assert not answer.extrapolated
    assert model.query(PLACES[1], LensSettings(aperture=11.0)).extrapolated


def test_photos_added_one_by_one_answer_as_all_at_once_in_any_order(network: SmallNetwork) -> None:
    photos = [photo(f"p{k}", k, width=1.5 + 0.2 * k, count=96) for k in range(5)]  # more than are attended to
    at_once = LensModel.fit([s for own in photos for s in own])
    grown = LensModel.fit(photos[3])
    for k in (0, 4, 2, 1):
        grown = grown.added(photos[k])

    for place in PLACES:
        a, b = at_once.query(place, F2, 31), grown.query(place, F2, 31)
        assert distance(a.kernel, b.kernel).rel_l2 < 1e-6
        assert a.predicted_error == pytest.approx(b.predicted_error, rel=1e-6)
        assert a.photos == b.photos == 5


def test_a_new_photo_encodes_no_other_one_anew(network: SmallNetwork) -> None:
    LensModel.fit(photo("a", 1)).added(photo("b", 2)).query(PLACES[0], F2)

    assert network.encoded == 0


def test_tokens_of_other_weights_are_made_anew_of_the_statistics(network: SmallNetwork) -> None:
    stale = photo("a", 1, estimator="default/older")

    answer = LensModel.fit(stale).query(PLACES[0], F2)

    assert network.encoded == 48
    assert rms_width(answer.kernel) == pytest.approx(2.0, rel=0.05)


def test_keys_are_computed_once_for_each_neighbourhood(network: SmallNetwork) -> None:
    model = LensModel.fit([s for k in range(8) for s in photo(f"p{k}", k, count=96)])

    for _ in range(2):
        for r in np.linspace(0.5, 0.52, 40):
            model.query(FieldPosition(float(r), 0.3), F2)

    assert network.remembered <= 2


def test_the_samples_that_are_attended_to_are_near_and_of_all_photos(network: SmallNetwork) -> None:
    model = LensModel.fit([s for k in range(8) for s in photo(f"p{k}", k, count=96)])
    assert model._attention is not None

    found = model._attention.ask(FieldPosition(0.8, 0.5), F2, 31, None)
    rows = model._attention._answer(FieldPosition(0.8, 0.5), F2, None)[1]

    assert len(rows) == NEAREST
    assert set(found.photos) == {f"p{k}" for k in range(8)}
    apart = np.linalg.norm(model._attention._xy - FieldPosition(0.8, 0.5).xy, axis=1)
    assert np.median(apart[rows]) < 0.6 * np.median(apart)


def test_kernels_come_in_the_pixels_of_who_asks(network: SmallNetwork) -> None:
    model = LensModel.fit(photo("a", 1, pixel_pitch_um=4.0))

    assert model.pitch_um == 4.0
    assert rms_width(model.query(PLACES[0], F2, 31, pitch_um=8.0).kernel) == pytest.approx(1.0, rel=0.1)


def test_measured_kernels_count_by_the_error_that_they_expect(network: SmallNetwork) -> None:
    exact = PsfSample(
        gaussian(25, 9.0 * np.eye(2)), PLACES[1], F2, photo="chart", estimator="points/1", error=0.02
    )
    vague = replace(exact, error=0.9)
    blind = LensModel.fit(photo("a", 1))

    sure, unsure = (blind.added([sample]).query(PLACES[1], F2, 31) for sample in (exact, vague))

    assert (sure.weights, sure.ring_error) == ("small", None)
    assert rms_width(sure.kernel) > 2.8
    assert rms_width(unsure.kernel) < 2.3
    assert sure.predicted_error < min(0.05, blind.query(PLACES[1], F2).predicted_error)


def test_kernels_of_single_patches_feed_the_regression_of_the_paper(network: SmallNetwork) -> None:
    answer = LensModel.fit(photo("a", 1), "paper").query(PLACES[1], F2, 31)

    assert answer.weights == ""
    assert rms_width(answer.kernel) == pytest.approx(2.0, rel=0.1)


def test_samples_without_a_token_are_answered_by_regression(network: SmallNetwork) -> None:
    own = [replace(s, encoded=None, estimator="mine/1") for s in photo("a", 1)]

    assert LensModel.fit(own).query(PLACES[1], F2).weights == ""
    assert network.remembered == 0


def test_a_profile_gives_the_same_answers(network: SmallNetwork, tmp_path: Path) -> None:
    chart = PsfSample(delta(15), PLACES[0], F2, photo="chart", estimator="points/1", error=0.1)
    before = LensModel.fit([*photo("a", 1), chart])
    Lens(before).save(tmp_path / "a.lensprofile")

    after = Lens.load(tmp_path / "a.lensprofile").model

    for place in PLACES:
        a, b = before.query(place, F2, 31), after.query(place, F2, 31)
        assert np.abs(a.kernel - b.kernel).max() < 1e-6
        assert a.predicted_error == pytest.approx(b.predicted_error, rel=1e-6)
