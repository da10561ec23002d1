from __future__ import annotations

import io
import math
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.evidence import (
    PatchEvidence,
    nonnegative_least_squares,
    solve_kernel,
)
from lensmodel.core.psf import distance, gaussian
from lensmodel.core.spectrum import RINGS, SECTORS, binned_spectrum
from lensmodel.core.types import NoiseModel

K = 9


def texture(seed: int, side: int = 160) -> np.ndarray:
    rng = np.random.default_rng(seed)
    blocks = rng.random((side // 4, side // 4))
    return np.kron(blocks, np.ones((4, 4))) + 0.3 * rng.random((side, side))


def evidence_of(seed: int, kernel: np.ndarray, sigma: float) -> PatchEvidence:
    """Statistics by their definition, from a known scene: sums over shifts, one by one."""
    scene = texture(seed)
    scene -= scene.mean()
    y = signal.convolve2d(scene, kernel, mode="same")
    y += np.random.default_rng(seed + 100).normal(0, sigma, y.shape)
    margin = 2 * K
    inner = (slice(margin, -margin),) * 2
    r = np.zeros((K, K))
    full = np.zeros((2 * K - 1, 2 * K - 1))
    for i in range(K):
        for j in range(K):
            r[i, j] = (y[inner] * np.roll(scene, (i - K // 2, j - K // 2), (0, 1))[inner]).sum()
    for i in range(2 * K - 1):
        for j in range(2 * K - 1):
            full[i, j] = (scene[inner] * np.roll(scene, (i - K + 1, j - K + 1), (0, 1))[inner]).sum()
    spectrum, floor = binned_spectrum(y.astype(np.float32), NoiseModel.white(sigma))
    return PatchEvidence(full.astype(np.float32), r.astype(np.float32), y[inner].size, sigma, spectrum, floor)


def test_known_scene_gives_the_kernel_back() -> None:
    kernel = gaussian(K, [[1.2, 0.4], [0.4, 0.8]])

    found = solve_kernel([evidence_of(0, kernel, 0.0)], [1.0], K, ridge=1e-4)

    assert distance(found, kernel).rel_l2 < 0.05


def test_pooling_patches_lowers_the_error_of_noisy_ones() -> None:
    kernel = gaussian(K, [[1.2, 0.4], [0.4, 0.8]])
    patches = [evidence_of(seed, kernel, 0.5) for seed in range(8)]

    alone = np.median([distance(solve_kernel([p], [1.0], K), kernel).rel_l2 for p in patches])
    pooled = distance(solve_kernel(patches, [1.0] * 8, K), kernel).rel_l2

    assert pooled < 0.7 * alone


def test_a_patch_of_no_weight_has_no_vote() -> None:
    kernel, other = gaussian(K, np.eye(2)), gaussian(K, 4 * np.eye(2))
    first, second = evidence_of(0, kernel, 0.01), evidence_of(1, other, 0.01)

    assert np.allclose(solve_kernel([first, second], [1.0, 0.0], K), solve_kernel([first], [1.0], K))


def test_bytes_come_back_as_they_went() -> None:
    evidence = evidence_of(0, gaussian(K, np.eye(2)), 0.01)

    back = PatchEvidence.from_bytes(evidence.to_bytes())

    assert np.array_equal(back.autocorrelation, evidence.autocorrelation)
    assert np.array_equal(back.spectrum, evidence.spectrum)
    assert (back.pixels, back.noise) == (evidence.pixels, evidence.noise)


def hostile() -> list[bytes]:
    pickled = io.BytesIO()
    np.savez(pickled, autocorrelation=np.array([object()], dtype=object))
    short = io.BytesIO()
    np.savez(short, autocorrelation=np.zeros((3, 3)), scalars=np.zeros(3))
    return [b"", b"PK\x03\x04garbage", pickled.getvalue(), short.getvalue(), b"x" * (5 << 20)]


@pytest.mark.parametrize("data", hostile())
def test_foreign_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(InvalidInputError):
        PatchEvidence.from_bytes(data)


def test_white_noise_fills_every_bin_with_its_variance() -> None:
    noise = np.random.default_rng(0).normal(0.5, 0.1, (512, 512)).astype(np.float32)

    spectrum, floor = binned_spectrum(noise, NoiseModel.white(0.1))

    assert spectrum.shape == (RINGS, SECTORS)
    assert floor == pytest.approx(0.01)
    assert spectrum[4:].mean() == pytest.approx(floor, rel=0.05)


def test_least_squares_respects_the_sign_constraint() -> None:
    a = np.diag([2.0, 4.0, 1.0])

    k = nonnegative_least_squares(a, np.array([2.0, -3.0, 0.5]), np.ones(3))

    assert np.allclose(k, [1.0, 0.0, 0.5], atol=1e-6)


def test_a_patch_without_any_light_determines_nothing() -> None:
    dark = evidence_of(0, gaussian(K, np.eye(2)), 0.1)
    dark = replace(dark, autocorrelation=0 * dark.autocorrelation, crosscorrelation=0 * dark.crosscorrelation)

    assert nonnegative_least_squares(np.zeros((2, 2)), np.zeros(2), np.ones(2)).tolist() == [1.0, 1.0]
    with pytest.raises(InvalidInputError, match="no kernel"):
        solve_kernel([dark], [1.0], K)


@pytest.mark.parametrize("change", [{"pixels": 0}, {"noise": math.nan}, {"spectrum_noise": -1.0}])
def test_impossible_scalars_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(InvalidInputError, match="noise"):
        replace(evidence_of(0, gaussian(K, np.eye(2)), 0.1), **change)


def test_a_header_that_promises_more_than_its_bytes_is_refused() -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        member = io.BytesIO()
        header = {"descr": "<f4", "fortran_order": False, "shape": (1 << 20, 1 << 20)}
        np.lib.format.write_array_header_1_0(member, header)
        archive.writestr("scalars.npy", member.getvalue())
    with pytest.raises(InvalidInputError, match="claims an array"):
        PatchEvidence.from_bytes(buffer.getvalue())
