"""Whether patches exclude that kernels are too wide."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from lensmodel.psf import PsfSample, gaussian
from lensmodel.regression import Doubt, LensModel
from lensmodel.spectrum import RING_LIMITS, RINGS, SECTORS, PatchSpectrum
from lensmodel.types import FieldPosition, LensSettings

SETTINGS = LensSettings(aperture=2.0)
NOISE = 1e-6


def seen(width: float, rng: np.random.Generator) -> PatchSpectrum:
    """Spectrum of a scene that falls off by a power law, behind a Gaussian."""
    edge = np.geomspace(*RING_LIMITS, RINGS + 1)
    modulus = np.sqrt(edge[1:] * edge[:-1])[:, None] * np.ones(SECTORS)
    scene = 1e-2 * (modulus / 0.1) ** -rng.normal(2.1, 0.2) * np.exp(0.2 * rng.standard_normal(modulus.shape))
    power = scene * np.exp(-((2 * math.pi * width * modulus) ** 2)) + NOISE
    return PatchSpectrum(power.astype(np.float32), NOISE)


def model(true: float, estimated: float) -> LensModel:
    rng = np.random.default_rng(3)
    return LensModel.fit(
        [
            PsfSample(
                gaussian(31, estimated**2 * np.eye(2)),
                FieldPosition(float(r), float(phi)),
                SETTINGS,
                0.5,
                "photo",
                spectrum=seen(true, rng),
            )
            for r, phi in zip(np.linspace(0.1, 0.9, 12), rng.uniform(-3, 3, 12), strict=True)
        ]
    )


@pytest.mark.parametrize("r", [0.1, 0.5, 0.9])
def test_wide_blur_that_is_right_excludes_a_narrower_one(r: float) -> None:
    assert Doubt(model(1.4, 1.4)).share(FieldPosition(r, 0.3), SETTINGS) == 0.5


@pytest.mark.parametrize("r", [0.1, 0.5, 0.9])
def test_kernels_twice_too_wide_are_not_taken_for_sure(r: float) -> None:
    assert Doubt(model(0.5, 1.0)).share(FieldPosition(r, 0.3), SETTINGS) == 1.0


def test_doubt_lies_between_a_half_and_all() -> None:
    shares = [
        Doubt(model(width, width)).share(FieldPosition(0.5, 0.3), SETTINGS) for width in (0.3, 0.7, 1.4)
    ]

    assert shares == sorted(shares, reverse=True)
    assert all(0.5 <= share <= 1.0 for share in shares)


def test_without_spectra_nothing_is_excluded() -> None:
    known = model(1.4, 1.4)
    plain = LensModel.fit([replace(sample, spectrum=None) for sample in known.samples])

    assert Doubt(plain).share(FieldPosition(0.5, 0.3), SETTINGS) == 1.0
