"""One wavefront over the focal lengths of a zoom."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from lensmodel.core.errors import CancelledError
from lensmodel.core.psf import PsfSample, distance, gaussian
from lensmodel.core.types import FieldPosition, Kernel, LensSettings
from lensmodel.model import LensModel, ModelSettings
from lensmodel.model.field.cross_validation import held_together
from lensmodel.model.wavefront.from_kernels import fit_wavefront
from lensmodel.model.wavefront.physical_mean import Physics
from lensmodel.model.wavefront.zoom import End, ends_of, nearest
from lensmodel.optics.wavefront import NAMES, Wavefront
from lensmodel.simulate import SimulatedLens, draw_lens

SIZE = 31
WAVEFRONT = ModelSettings(mode="wavefront")
LENS = draw_lens(1001, "zoom")
SHORT, LONG = LENS.focal_mm
CORNER, MID = FieldPosition(0.85, 0.9), FieldPosition(0.5, -2.0)
FIELD = [FieldPosition(r, 9.0 * r - 3.0) for r in (0.1, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 0.97)]


def at(focal_mm: float, lens: SimulatedLens = LENS) -> LensSettings:
    return LensSettings(aperture=lens.at_focal().f_number, focal_mm=focal_mm)


def taken(
    focal_mm: float, rings: tuple[float, ...], photo: str, lens: SimulatedLens = LENS
) -> list[PsfSample]:
    """True kernels at four places of each ring."""
    places = [FieldPosition(r, a + 3.0 * r - 3.0) for r in rings for a in np.arange(4) * math.pi / 3]
    settings = at(focal_mm, lens)
    return [
        PsfSample(lens.kernel(p, settings, SIZE), p, settings, photo=photo, pixel_pitch_um=4.5)
        for p in places
    ]


def error(kernel: Kernel, place: FieldPosition, focal_mm: float, lens: SimulatedLens = LENS) -> float:
    return distance(kernel, lens.kernel(place, at(focal_mm, lens), SIZE)).rel_l2


@pytest.fixture(scope="module")
def many() -> list[PsfSample]:
    return taken(SHORT, (0.15, 0.4, 0.6, 0.75, 0.9), "short")


@pytest.fixture(scope="module")
def few() -> list[PsfSample]:
    return taken(LONG, (0.3, 0.7), "long")[1:7]


def test_terms_follow_a_straight_line_over_octaves() -> None:
    rng = np.random.default_rng(0)
    terms, slopes = rng.normal(0.0, 0.4, (2, len(NAMES)))
    zoom = Wavefront(terms, math.log(0.3), (1.15, 0.3), 2.8, SIZE, slopes=slopes, focal_octaves=5.0)

    twice = zoom.kernel(MID, LensSettings(2.8, 64.0), SIZE)
    plain = replace(zoom, terms=terms + slopes, slopes=None).kernel(MID, LensSettings(2.8, 64.0), SIZE)
    unknown = zoom.kernel(MID, LensSettings(2.8), SIZE)

    assert np.allclose(twice, plain)
    assert np.allclose(unknown, replace(zoom, slopes=None).kernel(MID, LensSettings(2.8), SIZE))
    assert distance(twice, unknown).rel_l2 > 0.05


@pytest.mark.slow
def test_few_samples_at_one_end_of_a_zoom_lean_on_those_of_the_other(
    many: list[PsfSample], few: list[PsfSample]
) -> None:
    alone = LensModel.fit(few, WAVEFRONT).warmed()

    front = fit_wavefront([*many, *few])

    assert front is not None
    for place in (CORNER, MID):
        shared = error(front.kernel(place, at(LONG), SIZE), place, LONG)
        assert shared < 0.6 * error(alone.query(place, at(LONG), SIZE).kernel, place, LONG)
        assert error(front.kernel(place, at(SHORT), SIZE), place, SHORT) < 0.08


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3, 1001])
def test_other_end_of_a_zoom_never_gets_worse(seed: int) -> None:
    lens = draw_lens(seed, "zoom")
    for mine, other in (lens.focal_mm, lens.focal_mm[::-1]):
        rings = (0.15, 0.4, 0.6, 0.75, 0.9)
        own, few = taken(mine, rings, "mine", lens), taken(other, (0.3, 0.7), "other", lens)[1:7]
        alone, both = LensModel.fit(own, WAVEFRONT).warmed(), LensModel.fit([*own, *few], WAVEFRONT).warmed()

        def missed(model: LensModel, focal: float = mine) -> float:
            kernels = model.kernels(FIELD, at(focal, lens), SIZE)
            return float(np.mean([error(k, p, focal, lens) for k, p in zip(kernels, FIELD, strict=True)]))

        assert missed(both) <= missed(alone) + 0.002


@pytest.mark.slow
def test_wavefronts_of_a_zoom_are_kept_by_what_was_learned_and_not_worse_at_the_other_end(
    many: list[PsfSample], few: list[PsfSample]
) -> None:
    samples = [*many, *few]
    model, alone = LensModel.fit(samples, WAVEFRONT).warmed(), LensModel.fit(many, WAVEFRONT).warmed()

    again = LensModel.restored(samples, model.learned(), WAVEFRONT)

    for focal in (SHORT, 1.05 * SHORT, LONG):
        both = model.query(CORNER, at(focal), SIZE), again.query(CORNER, at(focal), SIZE)
        assert both[0].wavefront_share == 1.0
        assert np.abs(both[0].kernel - both[1].kernel).max() < 1e-5
    for place in (CORNER, MID):
        own = error(alone.query(place, at(SHORT), SIZE).kernel, place, SHORT)
        assert error(model.query(place, at(SHORT), SIZE).kernel, place, SHORT) < own + 0.002


def test_fits_to_the_ends_of_a_zoom_can_be_stopped(many: list[PsfSample]) -> None:
    front = Wavefront(
        np.zeros(len(NAMES)), math.log(0.3), (1.15, 0.3), 2.8, SIZE, slopes=np.zeros(len(NAMES))
    )
    empty = np.empty((0, 2)), np.empty((0, 7)), np.ones(7), np.empty((0, SIZE**2)), np.empty(0)

    def stop(*_: int) -> None:
        raise CancelledError("enough")

    votes, groups = np.ones(len(many)), np.arange(len(many))
    with pytest.raises(CancelledError):
        ends_of(many, votes, groups, np.ones(7), Physics(front, SIZE, *empty), stop)


def test_the_say_of_one_focal_length_fades_without_a_step(many: list[PsfSample]) -> None:
    front = Wavefront(np.zeros(len(NAMES)), math.log(0.3), (1.15, 0.3), 2.8, SIZE)
    empty = np.empty((0, 2)), np.empty((0, 7)), np.ones(7), np.empty((0, SIZE**2)), np.empty(0)
    end = End(5.0, Physics(front, SIZE, *empty))
    shares = [end.share(LensSettings(2.8, 2.0**octaves)) for octaves in np.arange(5.0, 6.5, 0.01)]

    assert shares[0] == 1.0
    assert shares[-1] == 0.0
    assert all(0.0 <= a - b < 0.05 for a, b in itertools.pairwise(shares))
    assert end.share(LensSettings(2.8)) == 0.0
    assert nearest((end, End(7.0, end.physical)), LensSettings(2.8, 125.0))[0] is not end
    assert nearest((end,), LensSettings(2.8, 64.0)) == (None, 0.0)
    assert nearest((), many[0].settings) == (None, 0.0)


@pytest.mark.parametrize(("last", "apart"), [(100.0, True), (None, False), (52.0, False)])
def test_photo_alone_at_its_focal_length_is_held_out_sample_by_sample(
    last: float | None, apart: bool
) -> None:
    kernel, photo = gaussian(5, np.eye(2)), np.array([0, 0, 1, 2, 2])
    samples = [
        PsfSample(kernel, MID, LensSettings(2.8, focal), photo=str(number))
        for focal, number in zip((50.0, 50.0, 52.0, last, last), photo, strict=True)
    ]

    groups = held_together(samples, photo)

    assert groups[0] == groups[1] != groups[2]
    assert (groups[3] != groups[4]) == apart
