"""Which model answered, why, and what stands behind it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from lensmodel.core.psf import PsfSample, gaussian
from lensmodel.core.spectrum import RINGS, SECTORS, PatchSpectrum
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings
from lensmodel.model import LensModel, ModelSettings
from lensmodel.model.fitting import Fit
from lensmodel.model.modes import WAVEFRONT_SHARE
from lensmodel.model.provenance import answerers_in_words
from lensmodel.model.wavefront.physical_mean import FEW_SPECTRA, NO_AGREEMENT, SEVERAL_FOCAL_LENGTHS, Physics
from lensmodel.model.wavefront.zoom import End
from lensmodel.optics.wavefront import NAMES, Wavefront

SIDE = 9
SETTINGS = LensSettings(aperture=2.0)
PLACE = FieldPosition(0.9, 1.0)
SPECTRUM = PatchSpectrum(np.full((RINGS, SECTORS), 1e-3, dtype=np.float32), 1e-5)


def taken(
    photos: int = 2, patches: int = 6, focal_mm: float | None = None, *, exact: bool = False
) -> list[PsfSample]:
    """Patches of every channel with spectra, the photos at different radii; estimates differ in width."""
    return [
        PsfSample(
            gaussian(SIDE, (1.0 if exact or k % 2 else 2.0) * np.eye(2)),
            FieldPosition(0.15 + 0.7 * photo, 0.9 * k - 2.7),
            LensSettings(2.0, focal_mm, None, channel),
            photo=f"p{photo}",
            spectrum=SPECTRUM,
        )
        for photo in range(photos)
        for k in range(patches)
        for channel in CHANNELS
    ]


def physics(count: int, apart: str = "", *, known: bool = True) -> Physics:
    front = Wavefront(np.zeros(len(NAMES)), math.log(0.3), (1.15, 0.3), 2.0, SIDE)
    empty = np.empty((0, 2)), np.empty((0, 7)), np.ones(7), np.empty((0, SIDE**2))
    return Physics(
        front, SIDE, *empty, np.full(count, 0.2), agreed=not apart, diffraction_known=known, why_apart=apart
    )


def with_wavefront(
    samples: list[PsfSample], physical: Physics | None, settings: ModelSettings | None = None
) -> LensModel:
    chosen = settings or ModelSettings()
    fit: Fit = replace(LensModel.fit(samples, chosen)._fit, physical=physical)
    return LensModel(tuple(samples), chosen, fit)


@pytest.mark.parametrize(
    ("apart", "known", "reason"),
    [
        (NO_AGREEMENT, True, "no wavefront agrees with all patches"),
        (FEW_SPECTRA, True, "fewer than 8 patches with a spectrum"),
        (
            SEVERAL_FOCAL_LENGTHS,
            True,
            "photos of several focal lengths, whose patches are not solved together",
        ),
        ("", False, "aperture or pixel pitch unknown"),
    ],
)
def test_a_wavefront_that_takes_no_part_is_accounted_for(apart: str, known: bool, reason: str) -> None:
    samples = taken()

    answer = with_wavefront(samples, physics(len(samples), apart, known=known)).query(PLACE, SETTINGS, SIDE)

    assert (answer.answered_by, answer.reason) == ("regression", reason)


@pytest.mark.parametrize(
    ("samples", "settings", "named"),
    [
        (taken(), None, ("regression", "the wavefront is not fitted yet")),
        (taken(1, 3), None, ("regression", "fewer than 12 samples")),
        ([replace(s, spectrum=None) for s in taken()], None, ("regression", "no patch has a spectrum")),
        (
            taken(),
            ModelSettings(method="nadaraya-watson"),
            ("regression", "the regression that was chosen takes no wavefront"),
        ),
        (taken(), ModelSettings(mode="paper"), ("paper", "the lens has the model paper")),
        (taken(), ModelSettings(mode="kernels"), ("regression", "the kernels alone were asked for")),
    ],
)
def test_an_answer_without_any_wavefront_says_why(
    samples: list[PsfSample], settings: ModelSettings | None, named: tuple[str, str]
) -> None:
    answer = with_wavefront(samples, None, settings).query(PLACE, SETTINGS, SIDE)

    assert (answer.answered_by, answer.reason) == named


def test_kernels_that_agree_all_over_the_field_answer_alone() -> None:
    samples = taken(exact=True)

    answer = with_wavefront(samples, physics(len(samples))).query(PLACE, SETTINGS, SIDE)

    assert (answer.answered_by, answer.wavefront_share) == ("regression", 0.0)
    assert answer.reason == "kernels agree with each other all over the field"


def test_all_patches_that_the_wavefront_was_fitted_to_stand_behind_its_answer() -> None:
    samples = taken()
    together = with_wavefront(samples, physics(len(samples)))

    alone = together.opinion("kernels")
    assert alone is not None
    near, answer = (model.query(PLACE, SETTINGS, SIDE) for model in (alone, together))
    rows, _, weights = together.weights(PLACE, SETTINGS)

    assert answer.answered_by == "wavefront and regression"
    assert answer.reason == "all patches agree on a wavefront, and aperture and pixel pitch are known"
    assert (near.photos, answer.photos) == (1, 2)  # the inner photo says nothing of the corner by itself
    green = np.array([s.settings.channel == "g" for s in samples])
    parts = WAVEFRONT_SHARE * green / green.sum()
    parts[rows] += (1.0 - WAVEFRONT_SHARE) * weights
    assert answer.effective_samples == pytest.approx(1.0 / (parts @ parts))
    assert answer.effective_samples > near.effective_samples


def test_a_wavefront_alone_is_called_so_and_rests_on_its_samples_only() -> None:
    samples = taken()
    heard = [s if s.photo == "p0" else replace(s, spectrum=None) for s in samples]

    answer = with_wavefront(heard, physics(len(heard)), ModelSettings(mode="wavefront")).query(
        PLACE, SETTINGS, SIDE
    )

    assert (answer.answered_by, answer.photos) == ("wavefront", 1)
    assert answer.effective_samples == pytest.approx(6.0)  # green patches of the photo with spectra


def test_samples_that_joined_after_the_fit_of_the_wavefront_do_not_stand_behind_it() -> None:
    samples = taken(1)
    alone = with_wavefront(samples, physics(len(samples)), ModelSettings(mode="wavefront"))

    grown = alone.grown([replace(s, photo="new") for s in samples[:3]])

    assert grown.query(PLACE, SETTINGS, SIDE).photos == 1


def test_one_end_of_a_zoom_rests_on_its_own_photos() -> None:
    short, long = taken(1, focal_mm=24.0), [replace(s, photo="long") for s in taken(1, focal_mm=70.0)]
    samples = [*short, *long]
    fit = LensModel.fit(samples)._fit
    ends = (End(math.log2(70.0), physics(len(samples))),)
    shared = physics(len(samples), SEVERAL_FOCAL_LENGTHS)
    model = LensModel(tuple(samples), ModelSettings(), replace(fit, physical=shared, ends=ends))

    there, here = (model.query(PLACE, LensSettings(2.0, focal), SIDE) for focal in (70.0, 24.0))

    assert (there.answered_by, there.photos) == ("wavefront and regression", 1)
    assert (here.answered_by, here.photos) == ("regression", 1)
    assert "several focal lengths" in here.reason


def test_words_name_one_answerer_alone_and_count_the_places_of_several() -> None:
    one, other = ("regression", "fewer than 12 samples"), ("wavefront", "it was asked for")

    assert answerers_in_words([one, one]) == "answered by regression: fewer than 12 samples"
    assert answerers_in_words([one, other, other]) == (
        "answered at 2 of 3 places by wavefront: it was asked for; at 1 of 3 places by regression: "
        "fewer than 12 samples"
    )
