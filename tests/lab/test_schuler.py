"""`lab.schuler`: recovery of a field that lies in its basis."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import fftconvolve

from lab.kernels import distance, gaussian
from lab.scenes import dead_leaves
from lab.schuler import BasisField, PhotoWindow, RadialBasis, Schuler, load_basis, principal, save_basis
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.types import FieldPosition, Frame, NoiseModel
from lensmodel.simulate import draw_lens

FRAME = Frame(2000, 3000)
RADII = (0.0, 0.5, 1.0)
SIDE = 15
NOISE = NoiseModel(1e-6, 1e-7)


def windows(kernel_of: Callable[[FieldPosition], np.ndarray]) -> list[PhotoWindow]:
    """A scene photographed at six places of the frame, each with the kernel of its middle."""
    found = []
    rng = np.random.default_rng(0)
    scene = dead_leaves(2 * 140, 3 * 140, np.random.default_rng(5), smallest=4.0)[1]
    for i, j in np.ndindex(2, 3):
        place = FRAME.position(400.0 + 1200 * i, 300.0 + 1200 * j)
        sharp = scene[i * 140 : (i + 1) * 140, j * 140 : (j + 1) * 140]
        wide = np.pad(sharp, 20, mode="symmetric")
        seen = fftconvolve(wide, kernel_of(place), mode="same")[20:-20, 20:-20]
        seen = seen + rng.normal(0.0, 1e-3, seen.shape)
        found.append(PhotoWindow(np.stack([seen] * 3).astype(np.float32), (NOISE,) * 3, place))
    return found


def local(place: FieldPosition, across: float, out: float) -> np.ndarray:
    """Covariance (row, col) of a Gaussian with these widths along v and u."""
    u = np.array([-math.sin(place.phi), math.cos(place.phi)])
    v = np.array([-math.cos(place.phi), -math.sin(place.phi)])
    return np.asarray(out**2 * np.outer(u, u) + across**2 * np.outer(v, v))


def radial(across: float, out: float) -> list[np.ndarray]:
    """Kernels of one lens at the radii, in the local frame."""
    return [gaussian(SIDE, local(FieldPosition(r, 0.0), 0.5 + across * r, 0.5 + out * r)) for r in RADII]


@cache
def small_basis() -> RadialBasis:
    lenses = [radial(a, b) for a in np.linspace(0.0, 1.6, 7) for b in np.linspace(0.0, 1.6, 7)]
    return principal(np.array(lenses), RADII, 8)


def missing(basis: RadialBasis, kernels: np.ndarray) -> np.ndarray:
    """The share of the kernels at each radius that no field of a basis has."""
    parts, wanted = basis.parts.reshape(len(basis.parts), -1).T, (kernels - basis.mean).ravel()
    rest = (wanted - parts @ np.linalg.lstsq(parts, wanted, rcond=None)[0]).reshape(kernels.shape)
    return np.asarray(np.linalg.norm(rest, axis=(1, 2)) / np.linalg.norm(kernels, axis=(1, 2)))


def test_basis_holds_the_fields_that_it_was_made_of() -> None:
    lenses = np.array([radial(a, 0.5) for a in (0.0, 0.4, 0.9, 1.3)])
    basis = principal(lenses, RADII, 7)
    assert missing(basis, lenses[2]).max() < 1e-6


def test_basis_survives_its_file(tmp_path: Path) -> None:
    save_basis(small_basis(), tmp_path / "basis.npz")
    back = load_basis(tmp_path / "basis.npz")
    assert np.abs(back.parts - small_basis().parts).max() < 1e-3 * np.abs(small_basis().parts).max()
    assert back.mean == pytest.approx(small_basis().mean, abs=1e-6)


def test_components_turn_with_the_place() -> None:
    upright = small_basis().turned(FieldPosition(1.0, 0.0))
    turned = small_basis().turned(FieldPosition(1.0, math.pi / 2))
    assert turned == pytest.approx(np.rot90(upright, axes=(1, 2)), abs=1e-6)


def test_field_between_two_radii_is_their_mean() -> None:
    basis = small_basis()
    field = BasisField(basis, {"g": np.zeros((8, 3))})
    middle = field.kernel_at(FieldPosition(0.25, 0.0), "g", SIDE)
    assert distance(middle, 0.5 * (basis.mean[0] + basis.mean[1])).rel_l2 < 0.02


@pytest.mark.slow  # its parts are tested above, each by itself
def test_schuler_recovers_a_lens_within_its_basis(monkeypatch: pytest.MonkeyPatch) -> None:
    def truth(place: FieldPosition) -> np.ndarray:
        return gaussian(SIDE, local(place, 0.5 + 0.35 * place.r, 0.5 + 1.45 * place.r))

    taken = windows(truth)
    monkeypatch.setattr("lab.schuler.windows_of", lambda _: taken)
    field = Schuler(basis=small_basis()).field(())
    mean = BasisField(small_basis(), {"g": np.zeros((8, 3))})
    found, naive = [], []
    for window in taken:
        true = truth(window.position)
        found.append(distance(field.kernel_at(window.position, "g", SIDE), true).rel_l2)
        naive.append(distance(mean.kernel_at(window.position, "g", SIDE), true).rel_l2)
    assert np.median(found) < 0.5 * np.median(naive)
    assert np.median(found) < 0.2


def test_schuler_refuses_too_few_patches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lab.schuler.windows_of", lambda _: [])
    with pytest.raises(NotEnoughEvidenceError, match="determine no field"):
        Schuler(basis=small_basis()).field(())


def test_stored_basis_holds_lenses_that_it_was_not_made_of() -> None:
    basis, left = load_basis(), []
    for seed in range(200, 208):
        lens = draw_lens(seed)
        true = np.stack([lens.kernel(FieldPosition(float(r), 0.0), None, basis.side) for r in basis.radii])
        left.append(missing(basis, true))
    center, *_, corner = np.median(left, axis=0)
    assert center < 0.1
    assert corner < 0.3
