"""Compiled loops of the audit find what NumPy finds."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core import loops
from lensmodel.core.psf import as_kernel, gaussian
from lensmodel.core.types import NoiseModel, Planes
from lensmodel.correction.audit import CHECKS, Evidence, audit_tile
from lensmodel.correction.audit.check import TilePair
from lensmodel.correction.blur import UniformBlur

NOISE = NoiseModel(1 / 20_000, 0.001**2)
LOPSIDED = as_kernel(gaussian(9, np.array([[1.5, 0.4], [0.4, 0.7]])) + 0.05 * np.eye(9))

needs_numba = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("numba", "rocket_fft")),
    reason="compares NumPy with Numba and rocket-fft",
)


def pair_of(shape: tuple[int, int], seed: int = 0) -> tuple[Planes, Planes]:
    """A photo with saturated places, and a result with faults of every kind."""
    rng = np.random.default_rng(seed)
    photo = ndimage.gaussian_filter(rng.uniform(-0.2, 1.3, (3, *shape)), (0, 2, 2)) * 1.5 - 0.3
    photo = np.clip(photo + 0.001 * rng.standard_normal(photo.shape), -0.01, 1.0)
    made = photo + rng.choice([0.001, 0.3], p=[0.9, 0.1], size=photo.shape) * rng.standard_normal(photo.shape)
    return photo.astype(np.float32), made.astype(np.float32)


def evidence(shape: tuple[int, int], offset: tuple[float, float] = (0.0, 0.0)) -> Evidence:
    rows, cols = np.indices(shape)
    measured: list[NDArray[np.bool_] | None] = [(rows + cols) % 2 == 0, None, rows % 2 == 1]
    blurs = [UniformBlur(LOPSIDED, offset), UniformBlur(LOPSIDED), UniformBlur(LOPSIDED[::-1], offset)]
    return Evidence([NOISE] * 3, (1.0, 0.9, 0.95), blurs, (0.0, 0.2, 0.5), measured)


@needs_numba
@pytest.mark.parametrize(
    "shape", [(1, 1), (1, 40), (2, 3), (9, 8), (33, 40), (60, 17), (81, 96), (100, 131)], ids=str
)
def test_both_engines_find_the_same(shape: tuple[int, int]) -> None:
    photo, made = pair_of(shape)
    known = evidence(shape)

    plain, quick = (TilePair.of(photo, made, known, engine=name) for name in ("numpy", "auto"))

    assert quick.loops is not None
    for name, check in CHECKS.items():
        expected, severity = check(plain), check(quick)
        assert severity.step == expected.step, name
        np.testing.assert_allclose(severity.values, expected.values, rtol=2e-3, atol=2e-3, err_msg=name)


@needs_numba
def test_both_engines_know_a_lateral_shift() -> None:
    photo, made = pair_of((64, 72))
    known = evidence((64, 72), offset=(0.7, -1.6))

    plain, quick = (CHECKS["re-blur"](TilePair.of(photo, made, known, engine=e)) for e in ("numpy", "auto"))

    np.testing.assert_allclose(quick.values, plain.values, rtol=1e-3)
    without = CHECKS["re-blur"](TilePair.of(photo, made, evidence((64, 72))))
    assert not np.allclose(quick.values, without.values, rtol=1e-2)


@needs_numba
def test_parts_of_larger_planes_are_audited_alike() -> None:
    photo, made = pair_of((90, 100))
    known = replace(evidence((70, 80)), blurs=None)
    cut = (slice(None), slice(10, 80), slice(5, 85))

    copied = audit_tile(photo[cut].copy(), made[cut].copy(), known)
    viewed = audit_tile(photo[cut], made[cut], known)

    assert np.array_equal(copied.keep, viewed.keep)
    assert copied.findings == viewed.findings


def test_the_audit_runs_where_numba_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    photo, made = pair_of((48, 48))
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    loops._load.cache_clear()
    try:
        pair = TilePair.of(photo, made, evidence((48, 48)))
        found = audit_tile(photo, made, evidence((48, 48)))
    finally:
        monkeypatch.undo()
        loops._load.cache_clear()

    assert pair.loops is None
    assert found.findings == audit_tile(photo, made, evidence((48, 48)), engine="numpy").findings
