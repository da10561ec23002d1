"""What is expected of a lens."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lensmodel.core.psf import distance
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.lab.model.expected_lens import terms_of
from lensmodel.optics.aberration_prior import ABERRATIONS, unlikeliness
from lensmodel.optics.pupil import TERMS, ray_gradients
from lensmodel.optics.wavefront import NAMES, Wavefront
from lensmodel.simulate import draw_lens


def test_spreads_belong_to_the_terms_that_are_fitted() -> None:
    assert ABERRATIONS.with_kernels.shape == ABERRATIONS.with_spectra.shape == (len(NAMES),)
    assert ABERRATIONS.at_place.shape == (TERMS,)
    assert set(ABERRATIONS.drawn) <= set(NAMES)


def test_spectra_hold_each_term_at_least_as_closely_as_kernels() -> None:
    assert (ABERRATIONS.with_spectra <= ABERRATIONS.with_kernels).all()


@pytest.mark.parametrize("seed", range(3))
def test_a_simulated_lens_is_likelier_than_one_that_nobody_would_have_focused_so(seed: int) -> None:
    terms = terms_of(draw_lens(seed).at_focal())
    wrong = terms.copy()
    wrong[NAMES.index("focus")] += 2.0

    assert (
        unlikeliness(np.append(terms, ABERRATIONS.eye))[0]
        < unlikeliness(np.append(wrong, ABERRATIONS.eye))[0]
    )


@pytest.mark.parametrize("seed", [0, 3, 5])
def test_terms_of_a_simulated_lens_make_its_kernels(seed: int) -> None:
    """Two renderings that share no code: the simulator's, and that of the fit."""
    lens = draw_lens(seed)
    optics = lens.at_focal()
    log_q = math.log(0.54 * optics.f_number / 4.5)
    front = Wavefront(terms_of(optics), log_q, optics.vignetting, optics.f_number, 41)
    settings = LensSettings(aperture=optics.f_number)

    for place in (FieldPosition(0.0, 0.0), FieldPosition(0.6, 1.0), FieldPosition(0.9, -2.0)):
        truth = lens.kernel(place, settings, 41)
        assert distance(front.kernel(place, settings, 41), truth).rel_l2 < 0.1


def test_rays_land_where_the_slope_of_the_terms_sends_them() -> None:
    rng = np.random.default_rng(0)
    px, py = rng.uniform(-0.7, 0.7, (2, 20))
    step = 1e-6

    def terms(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        square = x * x + y * y
        return np.stack([square**2, x * square, y * square, square, x * x - y * y, 2 * x * y])

    across, up = ray_gradients(px, py)

    assert across == pytest.approx((terms(px + step, py) - terms(px - step, py)) / (2 * step), abs=1e-8)
    assert up == pytest.approx((terms(px, py + step) - terms(px, py - step)) / (2 * step), abs=1e-8)
