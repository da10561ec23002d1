"""Mosaics behind lenses that blur each colour differently, and the grain that comes back."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from lab.images import psnr_of, to_srgb
from lab.kernels import gaussian
from lab.scenes import dead_leaves
from lensmodel import photo
from lensmodel.core.psf import as_kernel, delta
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, Kernel, NoiseModel, Planes
from lensmodel.correction import Sensor, correct_planes
from lensmodel.correction.blur import smooth
from lensmodel.correction.mosaic import spread_grain
from lensmodel.photo.writing import write_bayer_dng

SIDES = (160, 224)
BLACK, WHITE, ELECTRONS = 512, 15872, 20_000.0


@dataclass(frozen=True)
class Colours:
    """One Gaussian a colour; 0 is a point."""

    widths: tuple[float, float, float]

    def kernel(self, channel: Channel) -> Kernel:
        width = self.widths[CHANNELS.index(channel)]
        return gaussian(17, np.eye(2) * width**2) if width > 0.0 else delta(17)

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        return as_kernel(np.pad(self.kernel(channel), (size - 17) // 2))


@cache
def leaves() -> tuple[np.ndarray, np.random.Generator]:
    """Return the one scene, not to be changed, and the numbers that come after it, to be copied."""
    rng = np.random.default_rng(4)
    return dead_leaves(*(side + 32 for side in SIDES), rng) * 0.8, rng


def develop_mosaic(light: np.ndarray, path: Path) -> photo.LinearPhoto:
    """Write what a mosaic sees of each colour, and develop it."""
    mosaic = np.where(sites(SIDES), light, 0.0).sum(axis=0)
    numbers = np.rint(BLACK + np.minimum(mosaic, 1.0) * (WHITE - BLACK)).astype(np.uint16)
    write_bayer_dng(path, numbers, black=BLACK, white=WHITE)
    return photo.develop(path)


def corrected(developed: photo.LinearPhoto, lens: Colours, error: float = 0.0) -> Planes:
    return correct_planes(
        developed.planes,
        lens,
        developed.frame,
        noise=developed.correction_noise,
        clip=developed.clip,
        psf_error=error,
        cfa=developed.cfa,
    ).planes


def taken(lens: Colours, path: Path) -> tuple[photo.LinearPhoto, np.ndarray]:
    """Photograph leaves through a lens; return the developed photo and the sharp light."""
    scene, rng = leaves()[0], deepcopy(leaves()[1])
    kernels = [lens.kernel(name) for name in CHANNELS]  # round: rows and columns one after the other
    light = np.stack(
        [
            ndimage.convolve1d(ndimage.convolve1d(plane, k.sum(axis=1), axis=0), k.sum(axis=0), axis=1)
            for plane, k in zip(scene, kernels, strict=True)
        ]
    )
    light, sharp = light[:, 16:-16, 16:-16], scene[:, 16:-16, 16:-16]
    electrons = rng.poisson(np.maximum(light, 0.0) * ELECTRONS) / ELECTRONS
    return develop_mosaic(electrons, path), sharp


@pytest.mark.parametrize("widths", [(1.0, 0.0, 1.0), (2.0, 0.4, 1.4), (0.5, 0.5, 0.5), (1.2, 1.2, 0.3)])
def test_no_colour_falls_below_the_photo_or_the_same_with_a_point(
    tmp_path: Path, widths: tuple[float, float, float]
) -> None:
    lens = Colours(widths)
    developed, sharp = taken(lens, tmp_path / "x.dng")

    def levels(planes: np.ndarray) -> np.ndarray:
        squares = np.square(to_srgb(planes) - to_srgb(sharp))[:, 8:-8, 8:-8]
        return np.array([psnr_of(plane.mean()) for plane in squares])

    made = levels(corrected(developed, lens))

    assert (made > levels(developed.planes)).all()
    assert (made > levels(corrected(developed, Colours((0.0, 0.0, 0.0)))) - 0.05).all()


def test_coloured_edges_do_not_show_the_mosaic_where_a_blue_is_thought_too_sharp(tmp_path: Path) -> None:
    scene = np.full((3, *SIDES), 0.03)
    rows, cols = np.indices(SIDES)
    spot = np.hypot(rows - 100, cols - 120) < 9
    scene[2, spot], scene[1, spot] = 0.6, 0.2
    light = np.stack([ndimage.gaussian_filter(plane, 1.5) for plane in scene])
    noisy = light + np.random.default_rng(5).normal(0.0, 2e-4, light.shape)

    made = corrected(develop_mosaic(noisy, tmp_path / "x.dng"), Colours((1.5, 1.5, 0.6)), 0.3)

    # what of blue changes from one pixel to the next and back is the mosaic
    spot = made[2, 88:112, 108:132]
    for axis in (0, 1):
        assert np.abs(np.diff(spot, 2, axis=axis)).mean() < 0.2 * spot.mean()


# --- grain ------------------------------------------------------------------------------------------

LIGHT = np.array([0.3, 0.4, 0.2], dtype=np.float32)
SIGMA = np.sqrt(1e-4 * LIGHT + 1e-6)[:, None, None]


def sites(shape: tuple[int, int]) -> np.ndarray:
    """Where each colour of a mosaic was measured, `(3, rows, cols)`."""
    colours = np.tile(((0, 1), (1, 2)), (shape[0] // 2, shape[1] // 2))
    return np.stack([colours == c for c in range(3)])


def demosaiced(mosaic: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Green between its neighbours, the others by their difference from it, as usual."""
    taps = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4.0

    def between(plane: np.ndarray, at: np.ndarray) -> np.ndarray:
        total, count = (ndimage.convolve(p * at, taps, mode="mirror") for p in (plane, np.ones_like(plane)))
        return np.where(at, plane, total / count)

    green = between(mosaic[1], known[1])
    return np.stack([green + between(mosaic[c] - green, known[c]) if c != 1 else green for c in range(3)])


def returned(left: np.ndarray, photo: np.ndarray) -> np.ndarray:
    return added_back(demosaiced(left, sites(photo.shape[1:])), photo)


def added_back(left: np.ndarray, photo: np.ndarray) -> np.ndarray:
    known = sites(photo.shape[1:])
    sensors = [Sensor(NoiseModel(1e-4, 1e-6), 1.0, known[c]) for c in range(3)]
    return spread_grain(photo, left.astype(np.float32), photo >= 1.0, sensors, LIGHT)


def flat(shape: tuple[int, int] = (64, 80)) -> np.ndarray:
    return np.ascontiguousarray(np.broadcast_to(LIGHT[:, None, None], (3, *shape)), dtype=np.float32)


def test_fine_grain_has_no_colour_and_its_own_strength() -> None:
    photo = flat()
    left = SIGMA * np.random.default_rng(0).standard_normal(photo.shape)

    out = returned(left, photo)

    fine = out - np.stack([ndimage.gaussian_filter(plane, 2.0) for plane in out])
    relative = (fine / LIGHT[:, None, None]).reshape(3, -1)
    assert np.corrcoef(relative).min() > 0.6
    seen = [np.tensordot([0.25, 0.6, 0.15], p, 1) for p in (out, demosaiced(left, sites(photo.shape[1:])))]
    for high in (1.0, 2.0):
        kept, before = (np.var(p - ndimage.gaussian_filter(p, high)) for p in seen)
        assert 0.8 < kept / before < 1.1


def test_coarse_grain_has_less_colour_than_it_had() -> None:
    photo = flat()
    left = SIGMA * np.random.default_rng(3).standard_normal(photo.shape)

    colours = [
        np.var(ndimage.gaussian_filter((p / LIGHT[:, None, None])[0] - (p / LIGHT[:, None, None])[2], 2.0))
        for p in (returned(left, photo), demosaiced(left, sites(photo.shape[1:])))
    ]

    assert colours[0] < 0.6 * colours[1]


def test_detail_that_demosaicing_made_does_not_come_back() -> None:
    photo, left = flat(), np.zeros((3, 64, 80))
    left[:, :, 40::2] = 0.05  # columns that no noise explains
    left[sites((64, 80))] = 0.0

    assert np.abs(added_back(left, photo)[:, 8:-8, 48:-8]).max() < 0.002


def test_detail_of_one_colour_stays_in_it() -> None:
    left = np.zeros((3, 64, 80))
    left[2, 20:44, 20:60] = 0.01

    out = returned(left, flat())

    assert out[2, 26:38, 26:54].mean() > 0.009
    assert np.abs(out[:2]).max() < 0.004  # at its edges


def test_what_no_noise_explains_is_not_spread_to_other_colours() -> None:
    left = np.zeros((3, 64, 80))
    left[0, 32, 40] = 0.5  # an error of the kernel beside an edge

    assert np.abs(returned(left, flat())[1:]).max() < 0.03


def test_nothing_is_added_where_the_photo_is_clipped() -> None:
    photo = flat()
    photo[:, 10:20, 10:20] = 1.0
    left = 0.01 * np.random.default_rng(1).standard_normal(photo.shape)

    assert not returned(left, photo)[:, 10:20, 10:20].any()


def test_filters_are_those_of_scipy() -> None:
    plane = np.random.default_rng(2).random((30, 41), dtype=np.float32)
    weights = np.array([0.1, 0.2, 0.4, 0.2, 0.1], dtype=np.float32)
    for wrapped, mode in ((True, "wrap"), (False, "constant")):
        out = smooth(plane, weights, wrapped)
        expected = ndimage.correlate1d(
            ndimage.correlate1d(plane, weights, axis=0, mode=mode), weights, axis=1, mode=mode
        )
        np.testing.assert_allclose(out, expected, atol=1e-6)
