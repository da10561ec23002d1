"""A field of kernels: the efficient filter flow; a correction solves in cells of one kernel instead."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import PsfField
from lensmodel.core.types import Channel, Frame, Kernel, Plane
from lensmodel.correction.blur import UniformBlur


@dataclass(frozen=True, slots=True, eq=False)
class EfficientFilterFlow:
    """Blur that changes over the field: y = sum_r place_r(a_r * (w_r . crop_r(x))), sum_r w_r = 1.

    Source: M. Hirsch, S. Sra, B. Schölkopf, S. Harmeling, "Efficient filter flow for space-variant multiframe
    blind deconvolution", CVPR 2010.
    """

    height: int  # size of the frame in pixels
    width: int
    # grid of kernels, row by row, all of one side; `kernels[i][j]` belongs to the centre of window (i, j) of
    # an even partition of the frame
    kernels: tuple[tuple[Kernel, ...], ...]

    @classmethod
    def of_field(
        cls, field: PsfField, frame: Frame, channel: Channel, *, pitch: int = 128, size: int = 55
    ) -> EfficientFilterFlow:
        """Sample a PSF field at window centres about `pitch` pixels apart."""
        rows, cols = max(1, round(frame.height / pitch)), max(1, round(frame.width / pitch))
        centre_rows = (np.arange(rows) + 0.5) * frame.height / rows - 0.5
        centre_cols = (np.arange(cols) + 0.5) * frame.width / cols - 0.5
        kernels = tuple(
            tuple(field.kernel_at(frame.position(float(i), float(j)), channel, size) for j in centre_cols)
            for i in centre_rows
        )
        return cls(frame.height, frame.width, kernels)

    @property
    def reach(self) -> int:
        """By how many pixels the latent plane is wider than the frame on each side."""
        return int(self.kernels[0][0].shape[0] // 2)

    @property
    def latent_shape(self) -> tuple[int, int]:
        """Size of the latent plane in pixels."""
        return self.height + 2 * self.reach, self.width + 2 * self.reach

    def forward(self, latent: Plane) -> Plane:
        """Return F x, `(height, width)`."""
        reach = self.reach
        # Each window lands with a margin of the kernel's half side; the frame is cut out at the end.
        full = np.zeros((latent.shape[0] + 2 * reach, latent.shape[1] + 2 * reach))
        rows, cols = (
            list(_widened(partition(extent, parts), reach))
            for extent, parts in ((self.height, len(self.kernels)), (self.width, len(self.kernels[0])))
        )
        for (i, (top, rise)), (j, (left, run)) in product(enumerate(rows), enumerate(cols)):
            weight = np.outer(rise, run).astype(np.float32)
            part = latent[top : top + len(rise), left : left + len(run)] * weight
            blurred = UniformBlur(self.kernels[i][j]).forward(np.pad(part, 2 * reach))
            full[top : top + blurred.shape[0], left : left + blurred.shape[1]] += blurred
        cut = 2 * reach
        return np.asarray(full[cut : cut + self.height, cut : cut + self.width], dtype=np.float32)


def _widened(
    pieces: tuple[tuple[int, NDArray[np.float64]], ...], margin: int
) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Move windows of the frame onto the latent plane, the outer ones flat over the margin."""
    for i, (start, window) in enumerate(pieces):
        before = margin if i == 0 else 0
        after = margin if i == len(pieces) - 1 else 0
        yield start + margin - before, np.pad(window, (before, after), mode="edge")


def partition(extent: int, parts: int) -> tuple[tuple[int, NDArray[np.float64]], ...]:
    """Cut `extent` pixels into `parts` overlapping windows, (start, weights), that sum to one everywhere."""
    centres = (np.arange(parts) + 0.5) * extent / parts - 0.5
    t = np.arange(extent, dtype=np.float64)
    pieces = []
    for i in range(parts):
        weight = np.ones(extent)
        if i > 0:
            weight *= _rise((t - centres[i - 1]) / (centres[i] - centres[i - 1]))
        if i < parts - 1:
            weight *= 1.0 - _rise((t - centres[i]) / (centres[i + 1] - centres[i]))
        inside = np.flatnonzero(weight > 0.0)
        start, stop = int(inside[0]), int(inside[-1]) + 1
        pieces.append((start, weight[start:stop]))
    return tuple(pieces)


def _rise(s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Left half of the Bartlett-Hann window, stretched onto 0..1, flat outside.

    Of w(s) = 0.62 - 0.48 |s - 1/2| - 0.38 cos(2 pi s): 0 at s = 0, 1 at s = 1, rise(s) + rise(1 - s) = 1.
    """
    half = 0.5 * np.clip(s, 0.0, 1.0)
    return np.asarray(0.62 - 0.48 * (0.5 - half) - 0.38 * np.cos(2.0 * np.pi * half))
