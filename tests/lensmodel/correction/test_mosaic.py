"""Mosaics behind lenses that blur each colour differently."""

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
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, Kernel
from lensmodel.correction import correct_planes
from lensmodel.photo.dng import write_bayer_dng

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
    mosaic = np.empty(SIDES)
    for row, col, channel in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        mosaic[row::2, col::2] = light[channel, row::2, col::2]
    electrons = rng.poisson(np.maximum(mosaic, 0.0) * ELECTRONS) / ELECTRONS
    numbers = np.rint(BLACK + np.minimum(electrons, 1.0) * (WHITE - BLACK)).astype(np.uint16)
    write_bayer_dng(path, numbers, black=BLACK, white=WHITE)
    return photo.develop(path), sharp


@pytest.mark.parametrize("widths", [(1.0, 0.0, 1.0), (2.0, 0.4, 1.4), (0.5, 0.5, 0.5), (1.2, 1.2, 0.3)])
def test_no_colour_falls_below_the_photo_or_the_same_with_a_point(
    tmp_path: Path, widths: tuple[float, float, float]
) -> None:
    lens = Colours(widths)
    developed, sharp = taken(lens, tmp_path / "x.dng")

    def corrected(field: Colours) -> np.ndarray:
        return correct_planes(
            developed.planes,
            field,
            developed.frame,
            noise=developed.correction_noise,
            clip=developed.clip,
            cfa=developed.cfa,
        ).planes

    def levels(planes: np.ndarray) -> np.ndarray:
        return np.array(
            [
                psnr_of(np.square(to_srgb(p) - to_srgb(s))[8:-8, 8:-8].mean())
                for p, s in zip(planes, sharp, strict=True)
            ]
        )

    made = levels(corrected(lens))

    assert (made > levels(developed.planes)).all()
    assert (made > levels(corrected(Colours((0.0, 0.0, 0.0)))) - 0.05).all()


def test_coloured_edges_do_not_show_the_mosaic_where_a_blue_is_thought_too_sharp(tmp_path: Path) -> None:
    scene = np.full((3, *SIDES), 0.03)
    rows, cols = np.indices(SIDES)
    spot = np.hypot(rows - 100, cols - 120) < 9
    scene[2, spot], scene[1, spot] = 0.6, 0.2
    light = np.stack([ndimage.gaussian_filter(plane, 1.5) for plane in scene])
    mosaic = np.empty(SIDES)
    for row, col, channel in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        mosaic[row::2, col::2] = light[channel, row::2, col::2]
    noisy = mosaic + np.random.default_rng(5).normal(0.0, 2e-4, SIDES)
    numbers = np.rint(BLACK + noisy * (WHITE - BLACK)).astype(np.uint16)
    write_bayer_dng(tmp_path / "x.dng", numbers, black=BLACK, white=WHITE)
    developed = photo.develop(tmp_path / "x.dng")

    made = correct_planes(
        developed.planes,
        Colours((1.5, 1.5, 0.6)),
        developed.frame,
        noise=developed.correction_noise,
        clip=developed.clip,
        psf_error=0.3,
        cfa=developed.cfa,
    ).planes

    # what of blue changes from one pixel to the next and back is the mosaic
    spot = made[2, 88:112, 108:132]
    for axis in (0, 1):
        assert np.abs(np.diff(spot, 2, axis=axis)).mean() < 0.2 * spot.mean()
