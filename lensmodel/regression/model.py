"""Nadaraya-Watson regression of the PSF in rotated local frames (paper, section 6.2, eq. 4-8).

The weight of a sample factorises into one of place and settings, common to all its pixels, and
one of (u, v). So the sum over all pixels of all samples is one product of weights and kernels::

    f(u, v) = sum_i W_i C_i(u, v) / sum_i W_i

with C_i the sample's kernel in its own radial frame.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lensmodel.errors import NoSamplesError
from lensmodel.geometry import zone_of
from lensmodel.psf import PsfSample, distance
from lensmodel.regression.canonical import from_canonical, to_canonical
from lensmodel.types import WAVELENGTH_NM, ZONES, Channel, FieldPosition, Kernel, LensSettings, Zone

_REACH = 4.0
_CHANNEL_BANDWIDTH_NM = 20.0


@dataclass(frozen=True, slots=True)
class ModelSettings:
    """Choices of the regression; None means automatic.

    Parameters
    ----------
    r, phi, stops : float or None
        Bandwidths in half-diagonals, chord of the unit circle, and stops.
    """

    r: float | None = None
    phi: float | None = None
    stops: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PsfAnswer:
    """A PSF with how much stands behind it."""

    kernel: Kernel
    effective_samples: float
    photos: int
    extrapolated: bool
    predicted_error: float
    bandwidth: Mapping[str, float]


class LensModel:
    """PSF samples of one lens as a continuous function of place and settings."""

    def __init__(self, samples: Sequence[PsfSample], settings: ModelSettings) -> None:
        if not samples:
            raise NoSamplesError("the lens has no PSF samples yet; calibrate it with a photo first")
        self.samples = tuple(samples)
        self.settings = settings
        self._half = max(s.kernel.shape[0] for s in samples) // 2
        self._stack = np.stack([to_canonical(s.kernel, s.position.phi, self._half) for s in samples])
        self._weight = np.array([s.weight for s in samples])
        self._photo = np.unique([s.photo for s in samples], return_inverse=True)[1]
        self.bandwidth = self._bandwidths()
        self._points = np.array([self._scaled(s.position, s.settings) for s in samples])
        self._tree = cKDTree(self._points)
        self._spread = self._spreads()

    @classmethod
    def fit(cls, samples: Sequence[PsfSample], settings: ModelSettings | None = None) -> LensModel:
        """Build a model from samples."""
        return cls(samples, settings or ModelSettings())

    def added(self, samples: Sequence[PsfSample]) -> LensModel:
        """Return the model with more samples."""
        return LensModel((*self.samples, *samples), self.settings)

    def without_photo(self, photo: str) -> LensModel:
        """Return the model without the samples of one photo."""
        return LensModel([s for s in self.samples if s.photo != photo], self.settings)

    def _bandwidths(self) -> dict[str, float]:
        green = [s for s in self.samples if s.settings.channel == "g"] or list(self.samples)
        n = max(len(green), 2)
        rule = (4.0 / (4.0 * n)) ** (1.0 / 6.0)  # eq. 8 with d = 2: the place in the field
        r = np.array([s.position.r for s in green])
        return {
            "r": self.settings.r or max(float(r.std()) * rule * 0.6, 0.04),
            "phi": self.settings.phi or max(0.707 * rule, 0.25),
            "aperture_stops": self.settings.stops or 0.6,
        }

    def _scaled(self, position: FieldPosition, settings: LensSettings) -> list[float]:
        # near the centre all angles are neighbours: the chord shrinks with r
        share = min(position.r / 0.25, 1.0)
        stops = settings.stops
        return [
            position.r / self.bandwidth["r"],
            share * math.cos(position.phi) / self.bandwidth["phi"],
            share * math.sin(position.phi) / self.bandwidth["phi"],
            0.0 if stops is None else stops / self.bandwidth["aperture_stops"],
            WAVELENGTH_NM[settings.channel] / _CHANNEL_BANDWIDTH_NM,
        ]

    def _neighbours(
        self, position: FieldPosition, settings: LensSettings
    ) -> tuple[NDArray[np.intp], NDArray[np.float64], float]:
        point = np.array(self._scaled(position, settings))
        index = np.array(self._tree.query_ball_point(point, _REACH), dtype=np.intp)
        nearest = float(self._tree.query(point)[0])
        if index.size == 0:
            index = np.atleast_1d(self._tree.query(point, k=min(8, len(self.samples)))[1])
        gap = ((self._points[index] - point) ** 2).sum(axis=1)
        weight = self._weight[index] * np.exp(-0.5 * (gap - gap.min()))
        if weight.sum() <= 0:
            weight = np.ones(index.size)
        return index, weight, nearest

    def query(self, position: FieldPosition, settings: LensSettings, size: int = 55) -> PsfAnswer:
        """Return the PSF at a place, with the evidence behind it."""
        index, weight, nearest = self._neighbours(position, settings)
        share = weight / weight.sum()
        fine = np.tensordot(share, self._stack[index], axes=1)
        photos = np.unique(self._photo[index])
        per_photo = np.array([weight[self._photo[index] == p].sum() for p in photos])
        effective = float(weight.sum() ** 2 / (weight**2).sum())
        spread = float((share * self._spread[index]).sum())
        groups = float(per_photo.sum() ** 2 / (per_photo**2).sum())
        return PsfAnswer(
            kernel=from_canonical(fine, position.phi, size),
            effective_samples=effective,
            photos=int(photos.size),
            extrapolated=nearest > 2.0,
            predicted_error=spread * math.sqrt(1.0 + 1.0 / max(groups, 1.0)) / math.sqrt(2.0),
            bandwidth=dict(self.bandwidth),
        )

    def field(self, settings: LensSettings) -> _Field:
        """Return the PSF of every place and channel at these settings."""
        return _Field(self, settings)

    def _spreads(self) -> NDArray[np.float64]:
        spread = np.empty(len(self.samples))
        for i, sample in enumerate(self.samples):
            index, weight, _ = self._neighbours(sample.position, sample.settings)
            other = index != i
            if not other.any():
                spread[i] = 0.5
                continue
            share = weight[other] / weight[other].sum()
            mean = np.tensordot(share, self._stack[index[other]], axes=1)
            spread[i] = np.linalg.norm(self._stack[i] - mean) / max(float(np.linalg.norm(mean)), 1e-12)
        return np.minimum(spread, 1.0)

    def coverage(self) -> dict[Zone, int]:
        """Number of green samples in each zone."""
        zones = [zone_of(s.position.r) for s in self.samples if s.settings.channel == "g"]
        return {zone: zones.count(zone) for zone in ZONES}

    def cross_validate(self) -> dict[Zone, float]:
        """Median relative L2 of samples against a model of the other photos, by zone."""
        found: dict[Zone, list[float]] = {zone: [] for zone in ZONES}
        photos = sorted({s.photo for s in self.samples})
        if len(photos) < 2:
            return {}
        for photo in photos:
            rest = self.without_photo(photo)
            for sample in self.samples:
                if sample.photo != photo or sample.settings.channel != "g":
                    continue
                answer = rest.query(sample.position, sample.settings, sample.kernel.shape[0])
                found[zone_of(sample.position.r)].append(distance(answer.kernel, sample.kernel).rel_l2)
        return {zone: float(np.median(values)) for zone, values in found.items() if values}


class _Field:
    def __init__(self, model: LensModel, settings: LensSettings) -> None:
        self._model, self._settings = model, settings

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel at a field position, in the image frame."""
        return self._model.query(position, self._settings.with_channel(channel), size).kernel
