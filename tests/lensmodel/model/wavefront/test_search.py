"""Where fits of wavefronts begin, and which of their minima are taken."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from lensmodel.core.psf import PsfSample, delta, distance
from lensmodel.core.spectrum import RINGS, SECTORS, PatchSpectrum, bin_frequencies
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings
from lensmodel.model.wavefront.search import Group, _decentred, _moved, held_out, search
from lensmodel.optics.transfer import FIRST_RING
from lensmodel.optics.wavefront import NAMES, Wavefront, design
from lensmodel.scene.prior import PATCHES

SETTINGS = LensSettings(aperture=2.0)
THIRD_ORDER = {"spherical": 0.7, "coma": 1.5, "focus": -0.8, "field curvature": 1.2, "astigmatism": 0.8}


def front_of(terms: dict[str, float]) -> Wavefront:
    return Wavefront(
        np.array([terms.get(name, 0.0) for name in NAMES]), math.log(0.54 * 2.0 / 4.5), (1.1, 0.2), 2.0, 31
    )


FRONT = front_of(THIRD_ORDER)


def power_of(kernel: np.ndarray) -> np.ndarray:
    """|OTF|^2 at the middles of the bins by a direct sum, shape (BINS,)."""
    modulus, angle = bin_frequencies()
    half = kernel.shape[0] // 2
    row, col = np.mgrid[-half : half + 1, -half : half + 1]
    along = np.outer(modulus * np.sin(angle), row.ravel()) + np.outer(modulus * np.cos(angle), col.ravel())
    return np.abs(np.exp(-2j * np.pi * along) @ kernel.ravel()) ** 2


def groups_behind(front: Wavefront, count: int, photo: str = "a", seed: int = 0) -> list[Group]:
    """Patches of scenes that fall off by power laws, seen through the wavefront's kernels."""
    rng, modulus = np.random.default_rng(seed), bin_frequencies()[0]
    found: list[Group] = []
    for _ in range(count):
        place = FieldPosition(float(0.95 * math.sqrt(rng.random())), float(rng.uniform(-3, 3)))
        scene = 1e-2 * (modulus / 0.1) ** -rng.normal(2.1, 0.2)
        group: Group = {}
        for channel in CHANNELS:
            settings = SETTINGS.with_channel(channel)
            passed = power_of(front.kernel(place, settings, 31))
            power = np.zeros((RINGS, SECTORS), np.float32)
            seen = scene * np.exp(PATCHES.bias + PATCHES.with_power * passed**2) * passed + 1e-7
            power[FIRST_RING:] = seen.reshape(-1, SECTORS)
            spectrum = PatchSpectrum(power, 1e-7)
            group[channel] = PsfSample(delta(9), place, settings, photo=photo, spectrum=spectrum)
        found.append(group)
    return found


@pytest.fixture(scope="module")
def groups() -> list[Group]:
    return groups_behind(FRONT, 8)


def test_a_field_that_is_centred_elsewhere_has_there_what_it_had_in_the_middle() -> None:
    x, y = 0.2, -0.3
    moved = _moved(FRONT, x, y)
    for r, phi in ((0.1, 0.3), (0.6, 2.0), (0.5, -1.0)):
        across, up = r * math.cos(phi), r * math.sin(phi)
        there = FieldPosition(math.hypot(across + x, up + y), math.atan2(up + y, across + x))

        before = design(FieldPosition(r, phi), SETTINGS) @ FRONT.terms
        after = design(there, SETTINGS) @ moved.terms

        np.testing.assert_allclose(after, before, atol=1e-12)


def test_the_field_is_centred_to_the_side_that_the_patches_speak_for() -> None:
    x, y = 0.3, 0.0
    true = _moved(FRONT, x, y)

    found = _decentred(groups_behind(true, 6), FRONT)

    by_name = dict(zip(NAMES, found.terms - FRONT.terms, strict=True))
    assert by_name["tilt x"] == pytest.approx(-2.0 * THIRD_ORDER["field curvature"] * 0.35)
    assert by_name["tilt y"] == pytest.approx(0.0, abs=1e-12)


def test_patches_left_out_cost_less_behind_the_lens_than_behind_another(groups: list[Group]) -> None:
    wrong = replace(FRONT, terms=-3.0 * FRONT.terms, eye=(0.6, -0.5))

    assert held_out(groups, FRONT) < 0.7 * held_out(groups, wrong)


def test_a_search_ends_where_a_known_lens_leads_and_tells_how_far_it_is(groups: list[Group]) -> None:
    steps: list[tuple[int, int]] = []

    minima = search(
        groups, [], [replace(FRONT, terms=0.2 * FRONT.terms)], [FRONT], lambda *s: steps.append(s)
    )

    kernel, true = (front.kernel(FieldPosition(0.7, 0.4), SETTINGS, 31) for front in (minima[0].front, FRONT))
    # powers know nothing of the side of tails
    assert min(distance(kernel, true).rel_l2, distance(kernel[::-1, ::-1], true).rel_l2) < 0.15
    assert [fit.cost for fit in minima] == sorted(fit.cost for fit in minima)
    done, total = zip(*steps, strict=True)
    assert list(done) == sorted(done)
    assert done[-1] == total[0] == max(total)
