from __future__ import annotations

from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from lab.population.sets import adjusted, judge, load_sets
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import LensSettings
from lensmodel.neural.network import (
    LENGTH,
    OCTANTS,
    RELATIVE,
    WEIGHTS,
    WINDOW,
    FieldAnswer,
    FieldNetwork,
    conditions_of,
    from_octant_image,
    group,
    octant_of,
    patch_statistics,
    to_octant,
    to_octant_image,
    to_octant_place,
)

COLOURS = np.tile(np.array([[0, 1], [1, 2]], np.int8), (WINDOW // 2, WINDOW // 2))
WIDE_OPEN = conditions_of(LensSettings(aperture=2.8), 4.5)
PHOTOGRAPHS = ("spices", "lake", "city", "colosseum", "tea-gardens")
PLACES = np.array([(x, y) for x in (-0.7, -0.25, 0.3, 0.75) for y in (-0.4, 0.05, 0.45)])


@cache
def scene(name: str) -> np.ndarray:
    """A demonstration photograph in linear light, scaled down until it is sharp; (rows, cols, 3)."""
    with Image.open(files("lensmodel") / "demo_data" / f"{name}.jpg") as picture:
        half = picture.convert("RGB").reduce(2)
        return (np.asarray(half, np.float64) / 255) ** 2.2


def photo(blur: float, *, noise: float = 1e-3, seed: int = 0, name: str = "spices") -> np.ndarray:
    """Statistics of patches of a photograph behind a Gaussian blur, one a place."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in PLACES:
        row, col = (int(rng.integers(0, n - WINDOW)) // 2 * 2 for n in scene(name).shape[:2])
        planes = scene(name)[row : row + WINDOW, col : col + WINDOW]
        blurred = ndimage.gaussian_filter(planes, (blur, blur, 0))
        mosaic = np.take_along_axis(blurred, COLOURS[..., None].astype(int), 2)[..., 0]
        mosaic = mosaic + noise * rng.standard_normal(mosaic.shape)
        out.append(patch_statistics(mosaic.astype(np.float32), COLOURS, noise, 0.0))
    return to_octant(np.array(out), PLACES)


def ask(
    statistics: np.ndarray, xy: np.ndarray, place: tuple[float, float], conditions: np.ndarray = WIDE_OPEN
) -> FieldAnswer:
    network = FieldNetwork.load()
    tokens = network.encode(statistics, xy, WIDE_OPEN)
    return network.query(network.memory(tokens, xy, WIDE_OPEN), np.array(place), conditions)


@pytest.fixture(scope="module")
def sharp() -> np.ndarray:
    return photo(0.8)


def width(answer: FieldAnswer) -> float:
    at = np.arange(answer.kernels.shape[-1]) - answer.kernels.shape[-1] // 2
    green = answer.kernels[1]
    return float(np.sqrt((green.sum(0) @ at**2 + green.sum(1) @ at**2) / 2))


def test_kernels_are_not_negative_of_sum_one_and_centred(sharp: np.ndarray) -> None:
    kernels = ask(sharp, PLACES, (0.4, -0.2)).kernels
    at = np.arange(kernels.shape[-1]) - kernels.shape[-1] // 2
    assert (kernels >= 0).all()
    np.testing.assert_allclose(kernels.sum((1, 2)), 1.0, atol=1e-9)
    assert np.abs(kernels.sum(1) @ at).max() < 0.01
    assert np.abs(kernels.sum(2) @ at).max() < 0.01


def test_order_of_samples_does_not_matter(sharp: np.ndarray) -> None:
    order = np.random.default_rng(1).permutation(len(PLACES))
    there = ask(sharp, PLACES, (0.2, 0.3))
    again = ask(sharp[order], PLACES[order], (0.2, 0.3))
    np.testing.assert_allclose(again.kernels, there.kernels, atol=1e-6)
    np.testing.assert_allclose(again.weights, there.weights[order], atol=1e-5)


@pytest.mark.parametrize("symmetry", range(OCTANTS))
def test_a_lens_that_is_turned_has_its_psf_turned(sharp: np.ndarray, symmetry: int) -> None:
    turn = np.array(symmetry)
    place = np.array([0.35, 0.1])
    before = ask(sharp, PLACES, (0.35, 0.1)).kernels
    after = ask(sharp, to_octant_place(turn, PLACES), tuple(to_octant_place(turn, place))).kernels
    np.testing.assert_allclose(after, to_octant_image(symmetry, before), atol=1e-9)


def test_a_new_photo_leaves_the_tokens_of_others_as_they_are(sharp: np.ndarray) -> None:
    network = FieldNetwork.load()
    alone = network.encode(sharp, PLACES, WIDE_OPEN)
    np.testing.assert_array_equal(network.encode(sharp, PLACES, WIDE_OPEN), alone)
    both = np.concatenate([alone, network.encode(photo(0.8, seed=5), PLACES, WIDE_OPEN)])
    memory = network.memory(both, np.tile(PLACES, (2, 1)), WIDE_OPEN)
    part = network.memory(alone, PLACES, WIDE_OPEN)
    np.testing.assert_allclose(memory.keys[:, :, : len(alone)], part.keys, atol=1e-5)


def test_softer_photos_give_wider_kernels() -> None:
    peaks = [
        np.mean([ask(photo(blur, name=name), PLACES, (0.3, 0.1)).kernels[1].max() for name in PHOTOGRAPHS])
        for blur in (0.5, 1.2, 2.5)
    ]
    assert peaks[0] > peaks[1] > peaks[2]


def test_a_question_at_another_aperture_uses_these_samples(sharp: np.ndarray) -> None:
    closed = conditions_of(LensSettings(aperture=5.6), 4.5)
    soft = photo(2.5)
    assert width(ask(soft, PLACES, (0.3, 0.1), closed)) > width(ask(sharp, PLACES, (0.3, 0.1), closed))


def told(statistics: np.ndarray, xy: np.ndarray) -> float:
    """Mean error of green that is told over places of the field."""
    asked = ((0.7, 0.4), (0.1, 0.05), (-0.5, 0.3), (0.3, -0.4), (-0.75, -0.45))
    return float(np.mean([ask(statistics, xy, place).error[1] for place in asked]))


def test_told_error_grows_where_samples_are_few_far_or_noisy() -> None:
    """On average over photographs: of one alone, the error that is told depends on the scene."""
    photos = [photo(0.8, name=name) for name in PHOTOGRAPHS]
    left = PLACES[:, 0] < 0
    right = (0.74, 0.44)
    all_of_them = np.mean([told(statistics, PLACES) for statistics in photos])
    near = np.mean([ask(statistics, PLACES, right).error[1] for statistics in photos])
    far = np.mean([ask(statistics[left], PLACES[left], right).error[1] for statistics in photos])
    noisy = np.mean([told(photo(0.8, noise=0.05, name=name), PLACES) for name in PHOTOGRAPHS])
    assert np.mean([told(statistics[4:5], PLACES[4:5]) for statistics in photos]) > all_of_them
    assert far > near
    assert noisy > all_of_them


def test_statistics_of_a_wrong_shape_or_not_finite_are_refused(sharp: np.ndarray) -> None:
    network = FieldNetwork.load()
    with pytest.raises(InvalidInputError, match=str(LENGTH)):
        network.encode(sharp[:, :-1], PLACES, WIDE_OPEN)
    broken = sharp.copy()
    broken[0, 0] = np.nan
    with pytest.raises(InvalidInputError, match="finite"):
        network.encode(broken, PLACES, WIDE_OPEN)


def test_scaled_logits_raise_kernels_to_powers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lensmodel.neural.network.centred_kernels", lambda kernels: kernels)
    plain = FieldNetwork.load()
    scaled = FieldNetwork.from_bytes(adjusted(WEIGHTS.read_bytes(), powers=(1.0, 0.5, 1.0)))
    sharp = photo(1.0)
    before, after = (
        network.query(network.memory(network.encode(sharp, PLACES, WIDE_OPEN), PLACES, WIDE_OPEN),
                      PLACES[0], WIDE_OPEN).kernels
        for network in (plain, scaled)
    )  # fmt: skip
    root = np.sqrt(before[1, 30:45, 30:45])
    kept = after[1, 30:45, 30:45]
    np.testing.assert_allclose(kept / kept.sum(), root / root.sum(), atol=5e-4)
    np.testing.assert_allclose(after[0], before[0], atol=1e-5)


def test_packaged_weights_give_their_published_figures() -> None:
    sets = load_sets(Path(__file__).parent / "data" / "fixed-set.npz")
    figures = judge(FieldNetwork.load(), sets)
    assert figures == pytest.approx(dict(FieldNetwork.load().provenance["fixed_set"]), abs=2e-3)


# ---- statistics and octants


OCTANT_PLACES = np.array(
    [(0.7, 0.3), (-0.7, 0.3), (0.7, -0.3), (-0.7, -0.3), (0.3, 0.7), (-0.3, 0.7), (0.3, -0.7), (-0.3, -0.7)]
)


def mosaic(seed: int = 0, blur: float = 1.5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = ndimage.gaussian_filter(rng.random((WINDOW, WINDOW)), 2.0) > 0.5
    return (0.1 + 0.7 * ndimage.gaussian_filter(coarse.astype(float), blur)).astype(np.float32)


@pytest.mark.parametrize("octant", range(OCTANTS))
def test_statistics_turn_with_the_picture(octant: int) -> None:
    xy = OCTANT_PLACES[[int(octant_of(place)) for place in OCTANT_PLACES].index(octant)]
    picture = mosaic()
    turned = to_octant(patch_statistics(picture, COLOURS, 1e-3, 1e-5)[None], xy[None])[0]
    again = patch_statistics(
        np.ascontiguousarray(to_octant_image(octant, picture)),
        np.ascontiguousarray(to_octant_image(octant, COLOURS)),
        1e-3,
        1e-5,
    )
    np.testing.assert_allclose(turned, again, atol=2e-4)


@pytest.mark.parametrize("octant", range(OCTANTS))
def test_pictures_and_places_turn_alike(octant: int) -> None:
    picture = np.zeros((5, 5))
    picture[1, 4] = 1.0  # two to the right, one up
    row, col = np.unravel_index(to_octant_image(octant, picture).argmax(), (5, 5))
    assert (col - 2, 2 - row) == tuple(to_octant_place(np.array(octant), np.array([2.0, 1.0])))
    np.testing.assert_array_equal(from_octant_image(octant, to_octant_image(octant, picture)), picture)


def test_relation_of_octants_is_the_same_after_any_symmetry() -> None:
    for symmetry in range(OCTANTS):
        moved = octant_of(to_octant_place(np.array(symmetry), OCTANT_PLACES))
        before = RELATIVE[octant_of(OCTANT_PLACES)[:, None], octant_of(OCTANT_PLACES)[None]]
        np.testing.assert_array_equal(RELATIVE[moved[:, None], moved[None]], before)


def test_blur_shows_in_every_ring_of_the_spectrum_and_in_the_edges() -> None:
    sharp, soft = (patch_statistics(mosaic(blur=b), COLOURS, 1e-4, 0.0) for b in (0.6, 2.0))
    spectra = (sharp - soft)[group("green")].reshape(-1, 8).mean(1)
    assert (spectra[4:9] > 0.5).all()
    near = (soft - sharp)[group("cubed_even")].reshape(-1, 8).mean(1)
    assert near[1] > 0.1  # gradients two pixels apart belong to one edge now


def test_one_sided_blur_shows_in_odd_statistics_and_its_mirror_in_their_opposite() -> None:
    tail = np.zeros((1, 15), np.float32)
    tail[0, 7:] = np.exp(-np.arange(8) / 2.5)
    picture = ndimage.convolve(mosaic(blur=0.4), tail / tail.sum())
    right = patch_statistics(picture, COLOURS, 1e-4, 0.0)[group("cubed_odd")].reshape(-1, 8)[:, 0]
    left = patch_statistics(np.ascontiguousarray(picture[:, ::-1]), COLOURS, 1e-4, 0.0)[group("cubed_odd")]
    assert abs(right[:4]).max() > 0.02
    np.testing.assert_allclose(left.reshape(-1, 8)[:, 0], -right, atol=0.05)


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_a_flat_patch_has_finite_statistics(value: float) -> None:
    flat = np.full((WINDOW, WINDOW), value, np.float32)
    statistics = patch_statistics(flat, COLOURS, 0.0, 0.0)
    assert statistics.shape == (LENGTH,)
    assert np.isfinite(statistics).all()
