"""The phase between two colours of a mosaic."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lensmodel.core.cross_phase import (
    MIDDLES,
    coherence,
    cross_phase,
    log_likelihood,
    mean_in_bins,
    noise_in_bins,
    spectra_in_bins,
    unshifted,
    without_linear,
)
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.spectrum import PHASE_BINS, CrossPhase
from lensmodel.core.types import CHANNELS, BayerPattern, Channel

RGGB: BayerPattern = ((0, 1), (1, 2))
PATTERNS: tuple[BayerPattern, ...] = (RGGB, ((2, 1), (1, 0)), ((1, 0), (2, 1)), ((1, 2), (0, 1)))
SIDE = 192


def frequencies(side: int) -> tuple[np.ndarray, np.ndarray]:
    rows, cols = np.meshgrid(*[np.fft.fftfreq(side)] * 2, indexing="ij")
    return rows, cols


def trail(side: int, right: float, down: float, shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Transfer function of a core with a fainter trail towards (right, down) pixels, moved by `shift`."""
    rows, cols = frequencies(side)
    steps = np.linspace(0.0, 1.0, 24)
    weights = (1.0 - steps) ** 2 + 0.02
    along = np.exp(-2j * np.pi * (right * cols + down * rows)[..., None] * steps) @ weights / weights.sum()
    moved = np.exp(-2j * np.pi * (rows * shift[0] + cols * shift[1]))
    return np.asarray(along * moved * np.exp(-12.0 * (rows**2 + cols**2)))


def scene(seed: int) -> np.ndarray:
    """Transform of noise that falls off as photographs do."""
    rows, cols = frequencies(SIDE)
    noise = np.random.default_rng(seed).standard_normal((SIDE, SIDE))
    return np.asarray(np.fft.fft2(noise) / (0.02 + np.hypot(rows, cols)) ** 1.5)


def planes(blue: np.ndarray, green: np.ndarray, seed: int = 0) -> np.ndarray:
    """Red, green and blue of one scene behind the transfer functions of blue and of green."""
    seen = [np.fft.ifft2(scene(seed) * wave).real for wave in (green, green, blue)]
    return np.stack(seen).astype(np.float32)


BLUE, GREEN = trail(SIDE, 6.0, 3.0), trail(SIDE, 2.0, 0.0)
TRUE = np.angle(mean_in_bins(trail(64, 6.0, 3.0) * trail(64, 2.0, 0.0).conj()))


def test_phase_is_that_of_the_two_kernels() -> None:
    measured = cross_phase(planes(BLUE, GREEN), RGGB, "b")
    left = unshifted(measured, TRUE)[measured.precision > 0]

    size = float(np.sqrt(np.mean(unshifted(replace(measured, phase=TRUE.astype(np.float32))) ** 2)))
    assert size > 0.1
    assert np.sqrt(np.mean(left**2)) < 0.25 * size
    assert coherence(planes(BLUE, GREEN), RGGB, "b").max() <= 1.0 + 1e-9


def test_equal_kernels_have_no_phase() -> None:
    measured = cross_phase(planes(GREEN, GREEN), RGGB, "b")

    assert np.abs(measured.phase).max() < 0.05


@pytest.mark.parametrize("shift", [(0.6, -0.4), (-2.3, 1.7)])
def test_a_shift_between_the_channels_changes_nothing(shift: tuple[float, float]) -> None:
    still = cross_phase(planes(BLUE, GREEN), RGGB, "b")
    moved = cross_phase(planes(trail(SIDE, 6.0, 3.0, shift), GREEN), RGGB, "b")

    apart = unshifted(moved, still.phase)[still.precision > 0]
    assert np.sqrt(np.mean(apart**2)) < 0.04


def test_kernels_turned_by_180_degrees_have_the_opposite_phase() -> None:
    turned = cross_phase(planes(BLUE.conj(), GREEN.conj()), RGGB, "b")

    apart = unshifted(turned, -TRUE)[turned.precision > 0]
    assert np.sqrt(np.mean(apart**2)) < 0.06
    assert log_likelihood(turned, -TRUE) > log_likelihood(turned, TRUE) + 10.0


@pytest.mark.parametrize("cfa", PATTERNS[1:])
def test_where_the_lattices_begin_does_not_matter(cfa: BayerPattern) -> None:
    first, other = (cross_phase(planes(BLUE, GREEN), each, "b") for each in (RGGB, cfa))

    apart = unshifted(other, first.phase)[first.precision > 0]
    assert np.sqrt(np.mean(apart**2)) < 0.04


def test_only_own_sites_count() -> None:
    seen = planes(BLUE, GREEN)
    filled = seen.copy()
    filled[2, ::2, :] = filled[2, :, ::2] = 0.5  # blue is measured at odd rows and columns
    filled[1, ::2, ::2] = filled[1, 1::2, 1::2] = 0.1

    assert np.array_equal(cross_phase(filled, RGGB, "b").phase, cross_phase(seen, RGGB, "b").phase)


def test_noise_makes_phases_less_precise() -> None:
    rng = np.random.default_rng(1)
    seen = planes(BLUE, GREEN)
    noisy = (seen + rng.normal(0.0, float(seen.std()), seen.shape)).astype(np.float32)

    clean, grainy = (cross_phase(each, RGGB, "b").precision.sum() for each in (seen, noisy))
    assert grainy < 0.3 * clean


def test_cross_spectrum_over_green_is_the_gain_of_the_two_kernels() -> None:
    inside = np.hypot(*MIDDLES.T) > 0.05
    cross, own, green = (part[inside] for part in spectra_in_bins(planes(BLUE, GREEN), RGGB, "b"))
    blue, other = (
        np.abs(mean_in_bins(trail(64, right, down)))[inside] for right, down in ((6.0, 3.0), (2.0, 0.0))
    )

    true = np.log(blue / other)
    for measured in (np.log(np.abs(cross) / green), 0.5 * np.log(own / green)):
        off = measured - true
        assert np.std(true) > 0.15
        assert np.std(off) < 0.4 * np.std(true)


@pytest.mark.parametrize("channel", CHANNELS)
def test_power_of_noise_in_the_bins_is_known(channel: Channel) -> None:
    noise = np.random.default_rng(3).normal(0.0, 2.0, (3, 320, 320)).astype(np.float32)
    other: Channel = "b" if channel == "g" else channel
    _, own, green = spectra_in_bins(noise, RGGB, other)

    seen, known = (green if channel == "g" else own), 4.0 * noise_in_bins(RGGB, channel)
    assert seen.sum() == pytest.approx(known.sum(), rel=0.03)
    assert (known > 0).sum() == (np.hypot(*MIDDLES.T) > 0).sum()


def test_a_shift_is_taken_from_columns() -> None:
    precision = np.random.default_rng(2).random(PHASE_BINS)

    assert np.abs(without_linear(MIDDLES, precision)).max() < 1e-6


def test_values_of_another_shape_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="84 each"):
        CrossPhase(np.zeros(3, np.float32), np.zeros(3, np.float32))
    with pytest.raises(InvalidInputError, match="64 x 64"):
        cross_phase(np.zeros((3, 60, 90), np.float32), RGGB, "r")
