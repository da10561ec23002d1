"""The regression as the equations have it: the reference, and the paper's own form.

Each pixel p of each sample i is a training point with input (u, v, r, phi, Phi) and output P_i[p]::

    f(x) = sum_i sum_p P_i[p] K(x, x_ip) / sum_i sum_p K(x, x_ip)            (paper, eq. 4-7)

`all_pairs` sums over every point. `PaperModel` is what the paper runs: bandwidths of eq. (8) taken to
the letter over a flat cloud of pixels, and the nearest k of them from a kd-tree. With a million pixels
its bandwidth in u and v is some three pixels, which is wider than most PSFs: it is here to be compared
with, not to be used.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lensmodel.core.errors import NoSamplesError
from lensmodel.core.psf import PsfSample, centred
from lensmodel.core.types import Channel, FieldPosition, Kernel, LensSettings
from lensmodel.model import variables as va
from lensmodel.model.bandwidths import reference_bandwidth


def pixel_to_local(
    drow: NDArray[np.floating] | float, dcol: NDArray[np.floating] | float, phi: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Turn pixel offsets into local `(u, v)` at a place of angle `phi`.

    With a = dcol to the right and b = -drow upwards::

        u =  a cos phi + b sin phi        radially outwards
        v = -a sin phi + b cos phi        +90 degrees from u in the sense of phi
    """
    a, b = np.asarray(dcol, dtype=np.float64), -np.asarray(drow, dtype=np.float64)
    c, s = math.cos(phi), math.sin(phi)
    return a * c + b * s, b * c - a * s


PAD = 4
"""Rows and columns of zeros round each sample: a PSF is zero outside its support, not unknown."""


def all_pairs(
    samples: Sequence[PsfSample],
    position: FieldPosition,
    settings: LensSettings,
    size: int,
    *,
    pixel: float,
    widths: Mapping[str, float],
) -> NDArray[np.float64]:
    """Sum over all pixels of all samples for every pixel of the answer, shape (size, size)."""
    t = np.arange(size, dtype=np.float64) - size // 2
    u, v = (a.ravel() for a in pixel_to_local(t[:, None], t[None, :], position.phi))
    above, below = np.zeros(u.size), np.zeros(u.size)
    for sample, weight in zip(samples, _weights(samples, position, settings, widths), strict=True):
        kernel = np.pad(sample.kernel, PAD)
        p = np.arange(kernel.shape[0], dtype=np.float64) - kernel.shape[0] // 2
        pu, pv = (a.ravel() for a in pixel_to_local(p[:, None], p[None, :], sample.position.phi))
        squared = (u[:, None] - pu) ** 2 + (v[:, None] - pv) ** 2
        near = weight * np.exp(-0.5 * squared / pixel**2)
        above += near @ kernel.ravel()
        below += near.sum(axis=1)
    return (above / below).reshape(size, size)


@dataclass(frozen=True, slots=True, eq=False)
class PaperModel:
    """The paper's regression: a flat cloud of pixels, eq. (8) to the letter, k nearest points."""

    tree: cKDTree  # points (u, v, r, cos phi, sin phi, Phi) in bandwidths
    values: NDArray[np.float64]  # intensity of each point
    scale: NDArray[np.float64]  # bandwidths of the columns
    columns: tuple[int, ...]  # which settings vary and take part
    neighbours: int = 200  # k

    @classmethod
    def fit(cls, samples: Sequence[PsfSample], *, neighbours: int = 200) -> PaperModel:
        """Build the tree; that is all the training there is."""
        if not samples:
            raise NoSamplesError("the lens has no PSF samples yet; calibrate it with a photo first")
        where = va.points(samples)
        varying = [c for c in (3, 4, 5, 6) if np.isfinite(where[:, c]).all() and np.ptp(where[:, c]) > 0]
        cloud, values = [], []
        for sample, row in zip(samples, where, strict=True):
            p = np.arange(sample.kernel.shape[0], dtype=np.float64) - sample.kernel.shape[0] // 2
            u, v = pixel_to_local(p[:, None], p[None, :], sample.position.phi)
            angle = sample.position.phi
            rest = np.concatenate([[row[0], np.cos(angle), np.sin(angle)], row[varying]])
            cloud.append(np.column_stack([u.ravel(), v.ravel(), np.tile(rest, (u.size, 1))]))
            values.append(sample.kernel.ravel())
        points = np.concatenate(cloud)
        d, n = 4 + len(varying), len(points)
        sigma = points.std(axis=0)
        sigma[3:5] = np.sqrt((sigma[3:5] ** 2).mean())  # one bandwidth for the circle
        scale = np.array([reference_bandwidth(max(float(s), 1e-6), d, n) for s in sigma])
        return cls(cKDTree(points / scale), np.concatenate(values), scale, tuple(varying), neighbours)

    def kernel_at_settings(self, position: FieldPosition, settings: LensSettings, size: int) -> Kernel:
        """Kernel of odd side `size` at a place, in the image frame; unknown settings count as 0."""
        t = np.arange(size, dtype=np.float64) - size // 2
        u, v = pixel_to_local(t[:, None], t[None, :], position.phi)
        row = np.nan_to_num(va.point(position, settings), nan=0.0)
        rest = np.concatenate([[row[0], np.cos(position.phi), np.sin(position.phi)], row[list(self.columns)]])
        asked = np.column_stack([u.ravel(), v.ravel(), np.tile(rest, (u.size, 1))]) / self.scale
        distance, index = self.tree.query(asked, k=min(self.neighbours, self.tree.n))
        near = np.exp(-0.5 * (distance**2 - (distance**2).min(axis=1, keepdims=True)))
        found = (near * self.values[index]).sum(axis=1) / near.sum(axis=1)
        return centred(found.reshape(size, size))

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Kernel of a channel at settings that do not vary: the model as a `PsfField`."""
        return self.kernel_at_settings(position, LensSettings(channel=channel), size)


def _weights(
    samples: Sequence[PsfSample],
    position: FieldPosition,
    settings: LensSettings,
    widths: Mapping[str, float],
) -> NDArray[np.float64]:
    squared = va.squared_distances(va.points(samples), va.point(position, settings), va.scales(widths))
    return np.array([s.weight for s in samples]) * np.exp(-0.5 * squared)
