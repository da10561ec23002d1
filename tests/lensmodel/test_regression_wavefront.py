"""The physical mean: derivatives of kernels, and recovery of a lens from its true kernels."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lensmodel.psf import PsfSample, distance
from lensmodel.regression.pupil import TERMS, PupilGrid
from lensmodel.regression.wavefront_fit import fit_wavefront
from lensmodel.simulate import draw_lens
from lensmodel.types import FieldPosition, LensSettings


def test_derivatives_of_the_light_are_its_differences() -> None:
    grid = PupilGrid.of(0.3, 15)
    g = np.array([0.4, 0.5, -0.3, 0.6, 0.4, -0.2, 0.1, 0.2])
    amplitude = grid.amplitude(1.1, (0.2, 0.1))

    _, found = grid.with_derivatives(g, amplitude)

    for term in range(TERMS):
        step = 1e-3 * np.eye(TERMS)[term]
        wanted = (grid.light(g + step, amplitude) - grid.light(g - step, amplitude)) / 2e-3
        assert np.abs(found[term] - wanted).max() < 5e-3 * np.abs(wanted).max()


def test_tilt_to_the_right_moves_the_light_to_the_right() -> None:
    grid = PupilGrid.of(0.5, 21)
    amplitude = grid.amplitude(2.0, (0.0, 0.0))

    right = grid.light(np.array([0, 0, 0, 0, 0, 0, 3.0, 0]), amplitude)
    up = grid.light(np.array([0, 0, 0, 0, 0, 0, 0, 3.0]), amplitude)

    assert int(right.argmax()) == 10 * 21 + 13
    assert int(up.argmax()) == 7 * 21 + 10


def test_one_photo_of_true_kernels_tells_the_corner_that_it_did_not_see() -> None:
    lens = draw_lens(4)
    settings = LensSettings(aperture=lens.at_focal(None).f_number)
    places = [FieldPosition(r, a + r) for r in (0.1, 0.4, 0.6, 0.8) for a in np.arange(6) * math.pi / 3]
    samples = [PsfSample(lens.kernel(p, settings, 31), p, settings) for p in places]
    corner = FieldPosition(0.97, 0.58)

    front = fit_wavefront(samples)

    assert front is not None
    assert distance(front.kernel(corner, settings, 31), lens.kernel(corner, settings, 31)).rel_l2 < 0.08


@pytest.mark.parametrize("count", [0, 11])
def test_too_few_samples_make_no_wavefront(count: int) -> None:
    kernel = draw_lens(4).kernel(FieldPosition(0.2, 0.0), None, 11)

    assert fit_wavefront([PsfSample(kernel, FieldPosition(0.2, 0.0))] * count) is None
