"""Camera shake is what these methods were made for: each must recover Levin's measured kernels."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from lab.blind.methods import compared
from lab.cases import scene_of
from lab.kernels import distance
from lensmodel.core.psf import as_kernel, centred, delta
from lensmodel.core.types import Kernel, NoiseModel, Plane

SIGMA = 0.003
SHARP = ("s08_spices", "s19_white_roses")


def motion_kernels(path: Path) -> tuple[Kernel, ...]:
    """Read A. Levin's eight kernels of 2009 from a MATLAB 7.3 file.

    It is an HDF5 file that keeps each kernel as a compact dataset: a layout message of version 3,
    class 0, the size in bytes, then the values, column by column.
    """
    data, found, at = path.read_bytes(), [], 0
    while (at := data.find(b"\x03\x00", at + 1)) >= 0:
        size = struct.unpack_from("<H", data.ljust(at + 4, b"\0"), at + 2)[0]
        side = round((size / 8) ** 0.5)
        if data[at - 8 : at - 6] == b"\x08\x00" and size == 8 * side * side and side % 2 == 1 and side > 8:
            values = np.frombuffer(data, "<f8", side * side, at + 4)
            found.append(centred(as_kernel(values.reshape(side, side).T)))
    return tuple(found)


def shaken(photo: Path, kernel: Kernel, seed: int, side: int = 256) -> Plane:
    margin = kernel.shape[0] - 1
    green = scene_of(photo)[1].astype(np.float64)
    row, col = (green.shape[0] - side - margin) // 2, (green.shape[1] - side - margin) // 2
    sharp = green[row : row + side + margin, col : col + side + margin]
    y = signal.convolve(sharp, kernel, mode="valid", method="direct")
    return (y + np.random.default_rng(seed).normal(0, SIGMA, y.shape)).astype(np.float32)


@pytest.mark.slow
@pytest.mark.tools
@pytest.mark.parametrize(("name", "median", "least"), [("zhang", 0.95, 0.9), ("sun", 0.8, 0.6)])
def test_camera_shake_is_recovered_from_photographs(
    shared_data: Path, name: str, median: float, least: float
) -> None:
    kernels = motion_kernels(shared_data / "psf" / "levin09_motion_kernels.mat")
    assert [kernel.shape[0] for kernel in kernels] == [19, 17, 15, 27, 13, 21, 23, 23]
    similar, nothing = [], []
    for i, kernel in enumerate(kernels):
        y = shaken(shared_data / "sharp" / f"{SHARP[i % 2]}.png", kernel, i)
        found = compared.create(name).estimate([y], [NoiseModel.white(SIGMA)], size=29)
        similar.append(distance(found.kernel, kernel).ncc)
        nothing.append(distance(delta(29), kernel).ncc)

    assert np.median(similar) > median, similar
    assert min(similar) > least, similar
    assert np.median(nothing) < 0.55
