"""What a patch says without a kernel."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.spectrum import (
    PHASE_BINS,
    RINGS,
    SECTORS,
    CrossPhase,
    PatchSpectrum,
    binned_spectrum,
    tail_of,
)
from lensmodel.core.types import NoiseModel


def steps(seed: int, side: int = 192) -> np.ndarray:
    """Overlapping rectangles: a scene with sparse gradients."""
    rng = np.random.default_rng(seed)
    scene = np.full((side, side), 0.4)
    for _ in range(120):
        row, col = rng.integers(0, side - 8, 2)
        height, width = rng.integers(4, 40, 2)
        scene[row : row + height, col : col + width] = rng.random()
    return scene


def with_tail(right: float, up: float) -> np.ndarray:
    """A bright core and a fainter trail towards (right, up)."""
    kernel = np.zeros((15, 15))
    for t in np.linspace(0.0, 1.0, 30):
        row, col = 7 - round(up * 5 * t), 7 + round(right * 5 * t)
        kernel[row, col] += (1.0 - t) ** 2 + 0.05
    return kernel / kernel.sum()


@pytest.mark.parametrize(("right", "up"), [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_tail_points_where_the_kernel_has_one(right: int, up: int) -> None:
    votes = np.zeros(2)
    for seed in range(4):
        seen = signal.fftconvolve(steps(seed), with_tail(right, up), mode="same")
        noisy = seen + np.random.default_rng(seed).normal(0.0, 0.003, seen.shape)
        votes += tail_of(noisy.astype(np.float32), 1.5)

    along = votes @ (right, up)
    assert along > 0
    assert along > 2.0 * abs(votes @ (up, right))


def test_turning_the_patch_turns_the_tail() -> None:
    seen = signal.fftconvolve(steps(3), with_tail(1, 0), mode="same").astype(np.float32)

    right, up = tail_of(seen, 1.5)

    assert tail_of(seen[::-1, ::-1], 1.5) == pytest.approx((-right, -up), rel=1e-3, abs=1e-6)
    assert tail_of(seen[:, ::-1], 1.5)[0] == pytest.approx(-right, rel=1e-3, abs=1e-6)


def test_bytes_bring_the_same_spectrum_back() -> None:
    spectrum = PatchSpectrum.of(steps(1).astype(np.float32), NoiseModel.white(0.01), 1.0)

    back = PatchSpectrum.from_bytes(spectrum.to_bytes())

    assert np.array_equal(back.power, spectrum.power)
    assert back.noise == pytest.approx(spectrum.noise, rel=1e-6)
    assert back.tail == pytest.approx(spectrum.tail, rel=1e-6)
    assert back.cross is None


def test_bytes_bring_the_phases_back_and_do_without() -> None:
    rng = np.random.default_rng(4)
    cross = CrossPhase(*rng.random((2, PHASE_BINS), dtype=np.float32))
    spectrum = PatchSpectrum(rng.random((RINGS, SECTORS), dtype=np.float32), 0.1, (0.2, 0.3), cross)

    data = spectrum.to_bytes()
    back = PatchSpectrum.from_bytes(data)

    assert back.cross is not None
    assert np.array_equal(back.cross.phase, cross.phase)
    assert np.array_equal(back.cross.precision, cross.precision)
    assert PatchSpectrum.from_bytes(data[: 4 * (RINGS * SECTORS + 3)]).cross is None


@pytest.mark.parametrize("data", [b"", b"x" * 100, np.full(RINGS * SECTORS + 3, np.nan, "<f4").tobytes()])
def test_other_bytes_are_no_spectrum(data: bytes) -> None:
    with pytest.raises(InvalidInputError, match="spectrum"):
        PatchSpectrum.from_bytes(data)


def test_small_patch_has_no_tail() -> None:
    with pytest.raises(InvalidInputError, match="40 x 40"):
        tail_of(np.zeros((32, 64), np.float32), 1.0)


def test_white_noise_fills_every_bin_with_its_variance() -> None:
    noise = np.random.default_rng(0).normal(0.5, 0.1, (512, 512)).astype(np.float32)

    spectrum, floor = binned_spectrum(noise, NoiseModel.white(0.1))

    assert spectrum.shape == (RINGS, SECTORS)
    assert floor == pytest.approx(0.01)
    assert spectrum[4:].mean() == pytest.approx(floor, rel=0.05)
