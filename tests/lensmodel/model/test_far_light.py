"""What the shadows of several photos say together of far light, and kernels that have it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lensmodel.core.psf import PsfSample, gaussian
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import LensModel, ModelSettings
from lensmodel.model.answer import PAPER
from lensmodel.model.far_light import expected_share

OPEN = LensSettings(aperture=1.8)
SHADOWS = (0.31, 0.34, 0.42, 0.6)
T = np.arange(55) - 27
OUTSIDE = np.hypot(T[:, None], T[None, :]) > 8.0


def share(*bounds: float) -> float:
    return float(expected_share(np.array([bounds]))[0])


def photo(name: str, darkest: float | None, settings: LensSettings = OPEN) -> list[PsfSample]:
    """A photo through a lens of even blur."""
    rng = np.random.default_rng(len(name) + ord(name[-1]))
    kernel = gaussian(31, 1.4 * np.eye(2))
    places = [FieldPosition(r, phi) for r, phi in rng.uniform((0.05, -3.0), (1.0, 3.0), (12, 2))]
    return [
        PsfSample(kernel, place, settings.with_channel(channel), photo=name, darkest=darkest)
        for place in places
        for channel in ("r", "g", "b")
    ]


def learned(*bounds: float | None) -> LensModel:
    return LensModel.fit([s for k, bound in enumerate(bounds) for s in photo(f"p{k}", bound)])


def outside(model: LensModel, settings: LensSettings = OPEN) -> float:
    return float(model.query(FieldPosition(0.5, 0.3), settings).kernel[OUTSIDE].sum())


def test_share_stays_below_every_bound() -> None:
    for bounds in ((0.1,), (0.3, 0.2), (0.5, 0.4, 0.45), (0.02, 0.6)):
        assert share(*bounds) < min(bounds)


def test_order_of_photos_does_not_count() -> None:
    assert share(0.3, 0.5, 0.2) == pytest.approx(share(0.2, 0.3, 0.5))


def test_photos_that_all_lack_shadows_speak_the_louder_the_more_they_are() -> None:
    shares = [share(*(0.4,) * count) for count in (1, 2, 3, 5)]
    assert np.all(np.diff(shares) > 0.02)
    assert 0.33 < shares[-1] < 0.4


def test_one_photo_with_black_shadows_overrules_four_without() -> None:
    assert share(0.03, 0.5, 0.5, 0.5, 0.5) < 0.02


def test_one_photo_without_any_shadow_says_nothing() -> None:
    assert share(0.9) == pytest.approx(share(0.95), abs=0.01)


def test_kernels_get_what_the_shadows_of_the_photos_allow() -> None:
    model = learned(*SHADOWS)

    expected = share(*SHADOWS)
    assert expected > 0.1
    kernels = model.kernels([FieldPosition(0.5, 0.3)], OPEN, 55)
    np.testing.assert_allclose(kernels[0].sum(), 1.0)
    assert outside(model) == pytest.approx(0.5 * expected, rel=0.35)  # half of it lies beyond eight pixels
    assert outside(learned(None, None, None, None)) < 1e-5
    answer = model.query(FieldPosition(0.5, 0.3), OPEN, 55)
    assert answer.far_light == pytest.approx(expected, rel=0.1)  # nearest bounds are some way off
    np.testing.assert_array_equal(answer.kernel, kernels[0])


def test_each_colour_gets_what_green_says() -> None:
    model = learned(*SHADOWS)
    shares = [outside(model, OPEN.with_channel(channel)) for channel in ("r", "g", "b")]
    assert shares == pytest.approx([shares[1]] * 3, rel=1e-6)


def test_photos_stopped_down_say_nothing_of_the_open_lens() -> None:
    samples = [s for k, bound in enumerate(SHADOWS) for s in photo(f"p{k}", bound)]
    stopped = [s for k in range(4) for s in photo(f"q{k}", 0.01, LensSettings(aperture=8.0))]
    model = LensModel.fit(samples + stopped)

    assert outside(model) > 0.05
    assert outside(model, LensSettings(aperture=8.0)) < 0.01


def test_photo_that_is_corrected_lowers_what_its_shadows_rule_out() -> None:
    model = learned(*SHADOWS)
    black, even = photo("x", 0.02), photo("x", 0.9)

    assert outside(model.hearing(black)) < 0.02 < outside(model.hearing(even))
    # one that the model was learned from says nothing new
    assert outside(model.hearing(photo("p0", SHADOWS[0]))) == outside(model)
    # alone it may be of haze: where the model knows nothing of far light, it stays so
    assert outside(learned(None, None).hearing(even)) < 1e-5


def test_measured_kernels_and_the_papers_way_get_none() -> None:
    samples = [s for k, bound in enumerate(SHADOWS) for s in photo(f"p{k}", bound)]

    assert outside(LensModel.fit([replace(s, error=0.03) for s in samples])) < 1e-5
    assert outside(LensModel.fit(samples, ModelSettings(mode=PAPER))) < 1e-5


def test_what_was_learned_keeps_it() -> None:
    model = learned(*SHADOWS)
    again = LensModel.restored(model.samples, model.learned())
    more = model.grown(photo("q9", 0.02))

    assert outside(again) == pytest.approx(outside(model), rel=1e-9)
    assert outside(more) < 0.02
