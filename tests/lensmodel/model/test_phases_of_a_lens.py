"""Phases between colours in the fit of a lens."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lensmodel.core.cross_phase import MIDDLES, mean_in_bins, unshifted
from lensmodel.core.psf import PsfSample, delta, distance
from lensmodel.core.spectrum import PHASE_BINS, RINGS, SECTORS, CrossPhase, PatchSpectrum
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, Kernel, LensSettings
from lensmodel.model import LensModel, LensProfile, load_profile, save_profile
from lensmodel.model.wavefront.from_spectra import PatchView, PooledFit, expected, phase_costs
from lensmodel.model.wavefront.joint_kernels import _places, _sided
from lensmodel.model.wavefront.search import view
from lensmodel.optics.wavefront import NAMES, Wavefront

SETTINGS = LensSettings(aperture=2.0)
TERMS = {"spherical": 0.6, "coma": 2.0, "focus": -0.7, "colour 1": -0.8, "colour 2": 1.5, "astigmatism": 0.6}
FRONT = Wavefront(
    np.array([TERMS.get(name, 0.0) for name in NAMES]), math.log(0.54 * 2.0 / 4.5), (1.1, 0.2), 2.0, 41
)
PLACES = [FieldPosition(r, phi) for r, phi in ((0.3, 0.2), (0.5, 2.0), (0.7, -1.0), (0.9, 2.8), (0.6, -2.4))]
KNOWN = np.hypot(*MIDDLES.T) > 0


def transfer_of(kernel: Kernel) -> np.ndarray:
    grid, half = np.zeros((64, 64)), len(kernel) // 2
    grid[: len(kernel), : len(kernel)] = kernel
    return np.fft.fft2(np.roll(grid, (-half, -half), axis=(0, 1)))


def samples(front: Wavefront, place: FieldPosition) -> dict[Channel, PsfSample]:
    """What an exact patch behind a lens says: a flat power and the phases."""
    waves = {c: transfer_of(front.kernel(place, SETTINGS.with_channel(c), 41)) for c in CHANNELS}
    power, found = np.full((RINGS, SECTORS), 1e-2, np.float32), {}
    for channel in CHANNELS:
        cross = None
        if channel != "g":
            phase = np.angle(mean_in_bins(waves[channel] * waves["g"].conj())).astype(np.float32)
            cross = CrossPhase(phase, np.where(KNOWN, 100.0, 0.0).astype(np.float32))
        spectrum = PatchSpectrum(power, 1e-7, (0.0, 0.0), cross)
        found[channel] = PsfSample(delta(9), place, SETTINGS.with_channel(channel), spectrum=spectrum)
    return found


def views(front: Wavefront) -> list[PatchView]:
    return [view(samples(front, place)) for place in PLACES]


def lens_of(front: Wavefront) -> np.ndarray:
    return np.concatenate([front.terms, front.eye])


@pytest.mark.parametrize("channel", ["r", "b"])
def test_expected_phases_are_those_of_the_kernels(channel: Channel) -> None:
    for patch in views(FRONT):
        seen, phase = patch.phases[channel], expected(FRONT, lens_of(FRONT), patch)[2][channel][0]

        size = float(np.sqrt(np.mean(unshifted(seen)[KNOWN] ** 2)))
        assert np.sqrt(np.mean(unshifted(seen, phase)[KNOWN] ** 2)) < max(0.3 * size, 0.02)
        assert phase.shape == (PHASE_BINS,)


def test_derivatives_of_the_phases_are_those_of_their_values() -> None:
    patch, lens, step = views(FRONT)[2], lens_of(FRONT), 1e-3
    by_lens = expected(FRONT, lens, patch)[2]["b"][1]
    for index in (0, 2, 6, 10, 13):
        change = np.zeros(lens.size)
        change[index] = step
        after, before = (expected(FRONT, lens + s * change, patch)[2]["b"][0] for s in (1, -1))
        assert by_lens[:, index] == pytest.approx((after - before) / (2 * step), abs=2e-3)


def test_phases_tell_a_lens_from_the_one_turned_by_180_degrees() -> None:
    own, turned = phase_costs(views(FRONT), FRONT)
    turned_again, own_again = phase_costs(views(FRONT), replace(FRONT, terms=-FRONT.terms))

    assert turned > own + 5.0
    assert (own_again, turned_again) == pytest.approx((own, turned), rel=0.1)


def test_phases_that_suit_worse_than_none_say_nothing() -> None:
    strange = [
        replace(p, phases={c: replace(s, phase=0.0 * s.phase) for c, s in p.phases.items()})
        for p in views(FRONT)
    ]

    assert phase_costs(strange, FRONT) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_lenses_without_axial_colour_have_no_side_by_phases() -> None:
    terms = np.where([name.startswith("colour") for name in NAMES], 0.0, FRONT.terms)
    own, turned = phase_costs(views(replace(FRONT, terms=terms)), replace(FRONT, terms=terms))

    assert turned - own < 2.0


def test_a_fit_is_turned_to_the_side_that_phases_speak_for() -> None:
    turned = replace(FRONT, terms=-FRONT.terms)
    heads = [samples(FRONT, place)["g"] for place in PLACES]
    for front in (FRONT, turned):
        fit = PooledFit(front, 10.0, np.eye(21), np.ones(len(PLACES)))
        sided, vote = _sided(fit, heads, views(FRONT))

        assert np.array_equal(sided.front.terms, FRONT.terms)
        assert (vote > 0) == (front is FRONT)


def test_a_lens_whose_coma_is_negated_is_turned_back() -> None:
    sign = np.where([name == "coma" for name in NAMES], -1.0, 1.0)
    mirrored = replace(FRONT, terms=sign * FRONT.terms)
    heads = [samples(FRONT, place)["g"] for place in PLACES]

    sided, vote = _sided(PooledFit(mirrored, 10.0, np.eye(21), np.ones(len(PLACES))), heads, views(FRONT))

    true, before, after = (front.kernel(PLACES[2], SETTINGS, 31) for front in (FRONT, mirrored, sided.front))
    assert vote < 0
    assert distance(after, true).rel_l2 < 0.5 * distance(before, true).rel_l2


def test_phases_survive_a_profile_and_do_not_disturb_older_readers(tmp_path: Path) -> None:
    known = [s for place in PLACES for s in samples(FRONT, place).values()]
    save_profile(tmp_path / "a.lensprofile", LensProfile(LensModel.fit(known)))

    back = load_profile(tmp_path / "a.lensprofile").model.samples
    for sample, again in zip(known, back, strict=True):
        assert again.spectrum is not None
        assert sample.spectrum is not None
        assert (again.spectrum.cross is None) == (sample.spectrum.cross is None)
        if again.spectrum.cross is not None and sample.spectrum.cross is not None:
            assert np.array_equal(again.spectrum.cross.phase, sample.spectrum.cross.phase)
    assert len(_places(back)) == len(PLACES)
