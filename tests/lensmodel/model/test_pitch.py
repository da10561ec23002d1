"""One lens seen by bodies whose pixels differ in size."""

from __future__ import annotations

import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from lab.kernels import distance, gaussian
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import FieldPosition, Kernel, LensSettings
from lensmodel.model import LensModel
from lensmodel.model.camera_bodies import rescaled

FINE_UM, COARSE_UM = 4.0, 6.0
SETTINGS = LensSettings(aperture=2.0)


def seen(place: FieldPosition, pitch_um: float, size: int = 25) -> Kernel:
    """Blur of 6 to 10 micrometres, wide along v, as pixels of a pitch show it."""
    c, s = math.cos(place.phi), math.sin(place.phi)
    u, v = np.array([-s, c]), np.array([-c, -s])  # (row, col)
    along, across = (6.0 + 2.0 * place.r**2) / pitch_um, (6.0 + 4.0 * place.r**2) / pitch_um
    return gaussian(size, along**2 * np.outer(u, u) + across**2 * np.outer(v, v))


def photo(name: str, seed: int, pitch_um: float) -> list[PsfSample]:
    rng = np.random.default_rng(seed)
    places = [FieldPosition(float(r), float(a)) for r, a in rng.uniform((0.05, -3.1), (0.95, 3.1), (24, 2))]
    return [PsfSample(seen(p, pitch_um), p, SETTINGS, photo=name, pixel_pitch_um=pitch_um) for p in places]


@pytest.fixture(scope="module")
def both() -> list[PsfSample]:
    fine = [s for i in range(2) for s in photo(f"fine{i}", i, FINE_UM)]
    return [*fine, *photo("coarse", 9, COARSE_UM)]


ASKED = [FieldPosition(r, a) for r in (0.2, 0.5, 0.8) for a in (-2.0, 0.4, 1.7)]


def mean_error(model: LensModel, pitch_um: float | None, truth_um: float) -> float:
    answers = [model.query(p, SETTINGS, 21, pitch_um=pitch_um).kernel for p in ASKED]
    return float(
        np.mean([distance(k, seen(p, truth_um, 21)).rel_l2 for k, p in zip(answers, ASKED, strict=True)])
    )


@pytest.mark.parametrize(("before", "after"), [(FINE_UM, COARSE_UM), (COARSE_UM, FINE_UM)])
def test_kernel_of_one_pitch_becomes_that_of_another(before: float, after: float) -> None:
    place = FieldPosition(0.7, 0.4)
    found = rescaled(seen(place, before, 31), before, after, 25)

    assert distance(found, seen(place, after, 25)).rel_l2 < 0.01


def test_kernel_in_huge_pixels_is_a_point_and_takes_little_memory() -> None:
    tracemalloc.start()
    found = rescaled(gaussian(9, 4.0 * np.eye(2)), 1.0, 60.0, 55)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert found[27, 27] > 0.9
    assert peak < 32 << 20


def test_pixels_that_are_absurdly_wide_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="smaller pixels"):
        rescaled(gaussian(9, np.eye(2)), 1e-6, 100.0, 55)


def test_two_bodies_share_one_lens(both: list[PsfSample]) -> None:
    model = LensModel.fit(both)

    assert model.pitch_um == FINE_UM
    assert mean_error(model, None, FINE_UM) < 0.03
    assert mean_error(model, FINE_UM, FINE_UM) < 0.03
    assert mean_error(model, COARSE_UM, COARSE_UM) < 0.03


def test_pitch_that_is_not_known_is_that_of_the_others(both: list[PsfSample]) -> None:
    silent = [replace(s, pixel_pitch_um=None) if s.photo == "fine1" else s for s in both]

    assert mean_error(LensModel.fit(silent), None, FINE_UM) < 0.03


def test_photos_of_another_pitch_that_say_nothing_of_it_spoil_the_model(both: list[PsfSample]) -> None:
    silent = LensModel.fit([replace(s, pixel_pitch_um=None) for s in both])

    assert mean_error(silent, None, FINE_UM) > 2.0 * mean_error(LensModel.fit(both), None, FINE_UM)


def test_a_photo_of_another_body_joins_by_its_pitch(both: list[PsfSample]) -> None:
    few = photo("more", 5, COARSE_UM)[:2]
    model = LensModel.fit(both).added(few)

    assert len(model.samples) == len(both) + 2
    assert mean_error(model, None, FINE_UM) < 0.03


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan])
def test_impossible_pitches_are_refused(both: list[PsfSample], bad: float) -> None:
    with pytest.raises(InvalidInputError, match="pitch"):
        LensModel.fit(both).query(ASKED[0], SETTINGS, 21, pitch_um=bad)
