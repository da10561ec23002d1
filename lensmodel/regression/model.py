"""The PSF of one lens as a continuous function of place and settings.

Nadaraya-Watson regression in rotated local frames (paper, section 6.2, eq. 4-8). The weight of a
sample factorises into one of place and settings, common to all its pixels, and one of (u, v). So
the sum over all pixels of all samples is one product of weights and kernels::

    f(u, v) = sum_i W_i C_i(u, v) / sum_i W_i

with C_i the sample's kernel in its own radial frame. Departures from the paper: n in eq. (8) counts
PSFs, not pixels; the smoothing over (u, v) is that of the spline, because a bandwidth of pixels
would widen the PSF; kernels are scaled to the width of the place before averaging (`transport`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lensmodel.errors import InvalidInputError, NoSamplesError
from lensmodel.geometry import zone_of
from lensmodel.psf import PsfField, PsfSample, as_kernel
from lensmodel.regression import kriging
from lensmodel.regression import variables as va
from lensmodel.regression.answer import ModelSettings, PsfAnswer
from lensmodel.regression.experts import Experts
from lensmodel.regression.index import SampleIndex
from lensmodel.regression.judgement import (
    Judgement,
    bandwidth,
    grid_of,
    judge,
    pixel_store,
    row_of,
    with_votes,
)
from lensmodel.regression.physical import PhysicalMean
from lensmodel.regression.robust import Flag
from lensmodel.regression.smoothers import Neighbours, Smoother, smoothers
from lensmodel.regression.store import KernelStore
from lensmodel.regression.support import field_error, standard_error, support
from lensmodel.regression.transport import WidthField
from lensmodel.types import ZONES, Channel, FieldPosition, Kernel, LensSettings, Zone

_INCREMENT = 0.05
_DROPPED = 1e-3
_FEW = 8


class LensModel:
    """PSF samples of one lens as a continuous function of place and settings.

    Models are values: `added` and `without_photo` return new ones and leave this one as it was.
    """

    def __init__(
        self,
        samples: tuple[PsfSample, ...],
        settings: ModelSettings,
        widths: WidthField,
        store: KernelStore,
        judgement: Judgement,
        *,
        index: SampleIndex | None = None,
        prior: tuple[PsfField | LensModel, float] | None = None,
        pixels: KernelStore | None = None,
        physical: PhysicalMean | None = None,
    ) -> None:
        self.samples = samples
        self.settings = settings
        self.widths = widths
        self.prior = prior
        self._smoother: Smoother = smoothers.create(settings.method)
        self._grid = grid_of(samples, settings, self._smoother)
        self._store, self._judgement, self._pixels = store, judgement, pixels
        self._where = va.points(samples) if index is None else index.points
        self._photos, self._photo = np.unique([s.photo for s in samples], return_inverse=True)
        self._rule = va.bandwidths(self._where)
        self.bandwidth = bandwidth(self._rule, settings, judgement.choice)
        self._scale = va.scales(self.bandwidth)
        self._index = SampleIndex.of(self._where) if index is None else index
        if physical is None and self._smoother.physical:
            several = len(self._photos) >= 2
            groups = self._photo if several else np.arange(len(samples))
            physical = PhysicalMean(samples, judgement.votes, groups, self._scale)
        self._physical = physical
        self._experts = Experts(self._where, judgement, self._scale, pixels, physical)

    # --- building -------------------------------------------------------------------------------

    @classmethod
    def fit(
        cls,
        samples: Sequence[PsfSample],
        settings: ModelSettings | None = None,
        *,
        prior: tuple[PsfField | LensModel, float] | None = None,
    ) -> LensModel:
        """Build a model from samples.

        Raises
        ------
        NoSamplesError
            If there are none, or none may vote.
        UnknownMethodError
            If `settings.method` is in no registry.
        """
        settings = settings or ModelSettings()
        kept = tuple(samples)
        if not kept:
            raise NoSamplesError("the lens has no PSF samples yet; calibrate it with a photo first")
        voting = [s.weight > 0 and s.photo not in settings.excluded for s in kept]
        if not any(voting):
            raise NoSamplesError(f"none of the {len(kept)} samples may vote; include a photo again")
        smoother = smoothers.create(settings.method)
        grid = grid_of(kept, settings, smoother)
        base = np.array([s.weight if ok else 0.0 for s, ok in zip(kept, voting, strict=True)])
        widths = WidthField.fit(with_votes(kept, base)) if smoother.transport else WidthField()
        store = KernelStore(grid.side**2).extended((row_of(grid, widths, s) for s in kept), len(kept))
        pixels = pixel_store(kept) if smoother.blend else None
        judgement = judge(kept, settings, grid, store, base, pixels)
        if smoother.transport and any(flag.sample is None for flag in judgement.flags):
            # a spoilt photo has bent the widths too: fit them again without its voice
            widths = WidthField.fit(with_votes(kept, judgement.votes))
            store = KernelStore(grid.side**2).extended((row_of(grid, widths, s) for s in kept), len(kept))
            judgement = judge(kept, settings, grid, store, base, pixels)
        return cls(kept, settings, widths, store, judgement, prior=prior, pixels=pixels)

    def added(self, samples: Sequence[PsfSample]) -> LensModel:
        """Return the model with more samples.

        A handful is put in place without touching the others: bandwidths follow eq. (8), widths and
        cross-validated factors stay until the model has grown by a twentieth; then all is fitted anew.
        """
        new = tuple(samples)
        if not new:
            return self
        largest = max(s.kernel.shape[0] for s in new)
        if len(new) > _INCREMENT * len(self.samples) or largest > self._grid_source:
            return self.refitted((*self.samples, *new))
        store = self._store.extended((row_of(self._grid, self.widths, s) for s in new), len(new))
        old = self._judgement
        votes = [0.0 if s.photo in self.settings.excluded else s.weight for s in new]
        judgement = replace(
            old,
            votes=np.concatenate([old.votes, votes]),
            errors=np.concatenate([old.errors, np.full(len(new), float(np.median(old.errors)))]),
        )
        if old.image_errors is not None:
            usual = np.full(len(new), float(np.median(old.image_errors)))
            judgement = replace(judgement, image_errors=np.concatenate([old.image_errors, usual]))
        pixels = self._pixels
        if pixels is not None:
            pixels = pixels.extended(kriging.pixel_rows(new, self._grid_source), len(new))
        index = self._index.extended(va.points(new))
        return LensModel(
            (*self.samples, *new),
            self.settings,
            self.widths,
            store,
            judgement,
            index=index,
            prior=self.prior,
            pixels=pixels,
            physical=self._physical,
        )

    def refitted(self, samples: Sequence[PsfSample]) -> LensModel:
        """Return a model of other samples with the settings and prior of this one."""
        return LensModel.fit(samples, self.settings, prior=self.prior)

    def without_photo(self, photo: str) -> LensModel:
        """Return the model without the samples of one photo."""
        return self.refitted([s for s in self.samples if s.photo != photo])

    def excluding(self, *photos: str) -> LensModel:
        """Return the model in which these photos stay listed but do not vote."""
        names = tuple(sorted({*self.settings.excluded, *photos}))
        return LensModel.fit(self.samples, replace(self.settings, excluded=names), prior=self.prior)

    def including(self, *photos: str) -> LensModel:
        """Return the model in which these photos vote again."""
        names = tuple(name for name in self.settings.excluded if name not in photos)
        return LensModel.fit(self.samples, replace(self.settings, excluded=names), prior=self.prior)

    def with_prior(self, prior: PsfField | LensModel | None, strength: float = 2.0) -> LensModel:
        """Return the model that leans on a prior where it has seen little; None switches it off.

        Parameters
        ----------
        prior : LensModel or PsfField
            Usually the model of other copies of the lens.
        strength : float
            Number of samples that the prior is worth.
        """
        if not (math.isfinite(strength) and strength > 0):
            raise InvalidInputError(f"the strength of a prior must be positive, got {strength}")
        return LensModel(
            self.samples,
            self.settings,
            self.widths,
            self._store,
            self._judgement,
            index=self._index,
            prior=None if prior is None else (prior, strength),
            pixels=self._pixels,
            physical=self._physical,
        )

    # --- asking ---------------------------------------------------------------------------------

    def query(
        self, position: FieldPosition, settings: LensSettings, size: int = 55, *, std: bool = False
    ) -> PsfAnswer:
        """Return the PSF at a place, with the evidence behind it.

        Parameters
        ----------
        position : FieldPosition
        settings : LensSettings
            Unknown settings take no part.
        size : int
            Odd side in pixels.
        std : bool
            Whether to return the standard error of each pixel as well.
        """
        if size < 1 or size % 2 == 0:
            raise InvalidInputError(f"size must be odd and positive, got {size}")
        rows, gaps, weight = self.weights(position, settings)
        photos = self._photo[rows]
        found = self._store.rows[rows]
        mean = weight.astype(np.float32) @ found
        width = self.widths.at(position, settings)
        kernel = self._grid.kernel(self._mirrored(mean), position.phi, width, size)
        positive = np.maximum(weight, 0.0)
        positive /= positive.sum()
        per_photo = np.bincount(photos, positive)
        independent = 1.0 / float((per_photo**2).sum())
        nearest, beyond = support(self._where[rows], va.point(position, settings), self._rule)
        held_out = float(positive @ self._judgement.errors[rows] ** 2)
        kernel, held_out, shares = self._experts.mixed(kernel, held_out, rows, positive, position, settings)
        error = field_error(held_out, found, mean, positive, independent)
        error *= 1.0 + 0.5 * max(nearest - 1.0, 0.0)
        share = 0.0
        if self.prior is not None:
            kernel, share = self._blended(kernel, gaps, position, settings)
        return PsfAnswer(
            kernel=kernel,
            effective_samples=1.0 / float((positive**2).sum()),
            photos=int(np.count_nonzero(per_photo > _DROPPED)),
            extrapolated=bool(beyond),
            predicted_error=min(error, 1.0),
            bandwidth=dict(self.bandwidth),
            beyond=beyond,
            nearest=nearest,
            prior_share=share,
            image_frame_share=shares.image_frame,
            wavefront_share=shares.wavefront,
            std=standard_error(self._grid, found, positive, position.phi, width, size) if std else None,
        )

    def weights(
        self, position: FieldPosition, settings: LensSettings
    ) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
        """Weights of sum 1 that a question gives to samples.

        Returns
        -------
        rows : ndarray of int, shape (m,)
            Samples that take part.
        gaps : ndarray, shape (m, 7)
            Their distances in bandwidths, by variable.
        weights : ndarray, shape (m,)
            Those that together weigh less than a thousandth are left out.
        """
        asked = va.point(position, settings)
        rows = self._index.near(asked, self._smoother.reach, self._scale)
        rows = rows[self._judgement.votes[rows] > 0]
        if rows.size < _FEW:
            squared = va.squared_distances(self._where, asked, self._scale)
            squared[self._judgement.votes <= 0] = np.inf
            rows = np.argsort(squared, kind="stable")[:_FEW]
            rows = rows[np.isfinite(squared[rows])]
        gaps = np.nan_to_num((self._where[rows] - asked) / self._scale, nan=0.0)
        weight = self._smoother.weights(Neighbours(gaps, self._judgement.votes[rows]))
        order = np.argsort(np.abs(weight), kind="stable")
        kept = order[np.cumsum(np.abs(weight[order])) > _DROPPED]
        return rows[kept], gaps[kept], weight[kept] / weight[kept].sum()

    def field(self, settings: LensSettings) -> ModelField:
        """Return the PSF of every place and channel at these settings."""
        return ModelField(self, settings)

    def flags(self) -> tuple[Flag, ...]:
        """Photos and samples that count less than they claim, with reasons."""
        return self._judgement.flags

    def coverage(self) -> dict[Zone, int]:
        """Number of green samples in each zone."""
        zones = [zone_of(s.position.r) for s in self.samples if s.settings.channel == "g"]
        return {zone: zones.count(zone) for zone in ZONES}

    def cross_validate(self) -> dict[Zone, float]:
        """Median relative L2 of green samples against a model of the other photos, by zone.

        Empty with fewer than two photos.
        """
        if len(self._photos) < 2:
            return {}
        found: dict[Zone, list[float]] = {zone: [] for zone in ZONES}
        for sample, error in zip(self.samples, self._judgement.errors, strict=True):
            if sample.settings.channel == "g" and sample.photo not in self.settings.excluded:
                found[zone_of(sample.position.r)].append(float(error))
        return {zone: float(np.median(values)) for zone, values in found.items() if values}

    @property
    def nbytes(self) -> int:
        """Bytes of stored kernels, those of the samples included."""
        stored = self._store.rows.nbytes + (0 if self._pixels is None else self._pixels.rows.nbytes)
        return stored + sum(s.kernel.nbytes for s in self.samples)

    # --- inside ---------------------------------------------------------------------------------

    @property
    def _grid_source(self) -> int:
        return max(s.kernel.shape[0] for s in self.samples)

    def _mirrored(self, mean: NDArray[np.floating]) -> NDArray[np.floating]:
        share = self._judgement.choice.mirror
        if share == 0.0:
            return mean
        square = mean.reshape(self._grid.side, self._grid.side)
        return np.asarray((square + share * square[::-1]) / (1.0 + share)).ravel()

    def _blended(
        self, kernel: Kernel, gaps: NDArray[np.float64], position: FieldPosition, settings: LensSettings
    ) -> tuple[Kernel, float]:
        assert self.prior is not None
        prior, strength = self.prior
        near = float(np.exp(-0.5 * (gaps**2).sum(axis=1)).sum())
        share = strength / (near + strength)
        source = prior.field(settings) if isinstance(prior, LensModel) else prior
        other = source.kernel_at(position, settings.channel, kernel.shape[0])
        return as_kernel((1.0 - share) * kernel + share * other), share


@dataclass(frozen=True, slots=True, eq=False)
class ModelField:
    """The PSF field of a model at one setting."""

    model: LensModel
    settings: LensSettings

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel of odd side `size` at a field position, in the image frame."""
        return self.model.query(position, self.settings.with_channel(channel), size).kernel
