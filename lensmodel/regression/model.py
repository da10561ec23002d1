"""The PSF of one lens as a continuous function of place and settings.

Nadaraya-Watson regression in rotated local frames (paper, section 6.2, eq. 4-8). The weight of a
sample factorises into one of place and settings, common to all its pixels, and one of (u, v). So
the sum over all pixels of all samples is one of kernels::

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

from lensmodel.errors import InvalidInputError
from lensmodel.geometry import zone_of
from lensmodel.psf import PsfField, PsfSample
from lensmodel.regression import learned as memory
from lensmodel.regression import pitch as pitches
from lensmodel.regression import variables as va
from lensmodel.regression.answer import LIKELIEST, MICROMETRE, MIXED, MODES, ModelSettings, PsfAnswer
from lensmodel.regression.experts import Experts, Mixture
from lensmodel.regression.fitting import Fit
from lensmodel.regression.likelihood import Predict, likeliest
from lensmodel.regression.local import Answers
from lensmodel.regression.modes import NEEDING_WAVEFRONT, answered, between
from lensmodel.regression.neighbourhood import Neighbourhood
from lensmodel.regression.robust import Flag
from lensmodel.regression.smoothers import smoothers
from lensmodel.regression.support import field_error, shared_error, standard_error, support
from lensmodel.regression.zoom import nearest
from lensmodel.types import (
    ZONES,
    Channel,
    FieldPosition,
    Kernel,
    LensSettings,
    StepHook,
    Zone,
    ignore_step,
)

_LISTED = 1e-3
_WIDEST = 255
_SMALL = 15
Pixels = dict[str, float | None]
_AROUND = {**va.FALLBACK, "r": 0.15, "phi": 0.5}


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is thought of a lens before its own photos speak: a cold start.

    Parameters
    ----------
    source : LensModel or PsfField
        Usually the model of other copies of the lens, or a published profile.
    strength : float
        Number of samples near the place that it is worth.
    name : str
        What answers call it.
    """

    source: PsfField | LensModel
    strength: float = 2.0
    name: str = "other copies"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.strength) and self.strength > 0):
            raise InvalidInputError(f"the strength of a prior must be positive, got {self.strength}")
        if isinstance(self.source, LensModel) and self.source.prior is not None:
            object.__setattr__(self, "source", self.source.with_prior(None))

    def kernels(
        self, positions: Sequence[FieldPosition], settings: LensSettings, size: int, pixels: Pixels
    ) -> NDArray[np.float64]:
        """What it says of some places, shape (n, size, size)."""
        if isinstance(self.source, LensModel):
            return self.source.kernels(positions, settings, size, **pixels)
        return np.stack([self.source.kernel_at(p, settings.channel, size) for p in positions])

    def error(self, position: FieldPosition, settings: LensSettings) -> float:
        """Relative L2 that it expects of itself; 1 where it cannot tell."""
        if isinstance(self.source, LensModel):
            return self.source.query(position, settings, _SMALL).predicted_error
        return 1.0


class LensModel:
    """PSF samples of one lens as a continuous function of place and settings.

    Models are values: `added` and `without_photo` return new ones and leave this one as it was.
    """

    def __init__(
        self,
        samples: tuple[PsfSample, ...],
        settings: ModelSettings,
        fit: Fit,
        *,
        prior: Prior | None = None,
    ) -> None:
        self.samples = samples
        self.settings = settings
        self.prior = prior
        self._fit = fit
        scale = va.scales(fit.bandwidth)
        self._neighbourhood = Neighbourhood(
            fit.index, fit.judgement.votes, scale, smoothers.create(settings.method)
        )
        self._experts = Experts(fit.judgement, scale, fit.physical)

    # --- building -------------------------------------------------------------------------------

    @classmethod
    def fit(
        cls,
        samples: Sequence[PsfSample],
        settings: ModelSettings | None = None,
        *,
        prior: Prior | None = None,
    ) -> LensModel:
        """Build a model from samples.

        Raises
        ------
        NoSamplesError
            If there are none, or none may vote.
        UnknownMethodError
            If `settings.method` is in no registry.
        """
        settings, kept = settings or ModelSettings(), tuple(samples)
        return cls(kept, settings, Fit.of(kept, settings), prior=prior)

    def added(self, samples: Sequence[PsfSample]) -> LensModel:
        """Return the model with more samples.

        A handful is put in place without touching the others: bandwidths, widths and cross-validated
        factors stay until the model has grown by a twentieth; then all is fitted anew, and wants to be
        `warmed` again.
        """
        new = tuple(samples)
        if not new:
            return self
        if not self._fit.takes(new):
            return self.refitted((*self.samples, *new))
        fit = self._fit.extended(new, self.settings)
        return LensModel((*self.samples, *new), self.settings, fit, prior=self.prior)

    def refitted(self, samples: Sequence[PsfSample]) -> LensModel:
        """Return a model of other samples with the settings and prior of this one."""
        return LensModel.fit(samples, self.settings, prior=self.prior)

    @classmethod
    def restored(
        cls,
        samples: Sequence[PsfSample],
        learned: bytes,
        settings: ModelSettings | None = None,
        *,
        prior: Prior | None = None,
    ) -> LensModel:
        """Build the model that `learned` was taken from, without fitting anything.

        Raises
        ------
        InvalidInputError
            If `learned` is damaged, or belongs to other samples, settings or another version.
        """
        settings, kept = settings or ModelSettings(), tuple(samples)
        return cls(kept, settings, memory.load(learned, kept, settings), prior=prior)

    def learned(self) -> bytes:
        """What was learned from the samples, the wavefront included if `warm`; see `restored`."""
        return memory.dump(self._fit, self.samples, self.settings)

    @property
    def warm(self) -> bool:
        """Whether nothing is left for `warmed` to do."""
        if self.prior is not None and isinstance(self.prior.source, LensModel) and not self.prior.source.warm:
            return False
        mixed = self.settings.mode == MIXED and self._neighbourhood.smoother.physical
        return self._fit.physical is not None or not (mixed or self.settings.mode in NEEDING_WAVEFRONT)

    def warmed(self, on_step: StepHook = ignore_step) -> LensModel:
        """Return the model with the wavefront fitted to its samples, if its method or mode has one.

        That takes some seconds of CPU, and the answers are good without it, so it is not done behind
        anybody's back: call it once when the samples are complete. The same samples give the same model.
        The mode "likeliest" is chosen here too, which takes up to three such fits more.
        """
        if self.warm:
            return self
        prior = self.prior
        if prior is not None and isinstance(prior.source, LensModel):
            prior = replace(prior, source=prior.source.warmed())
        fit = self._fit.warmed(self.samples, on_step)
        if self.settings.mode == LIKELIEST:
            voting = [s for s, vote in zip(self.samples, fit.judgement.votes, strict=True) if vote > 0]
            fit = replace(fit, mode=likeliest(voting, self._by_mode))
        return LensModel(self.samples, self.settings, fit, prior=prior)

    def without_photo(self, photo: str) -> LensModel:
        """Return the model without the samples of one photo."""
        return self.refitted([s for s in self.samples if s.photo != photo])

    def excluding(self, *photos: str) -> LensModel:
        """Return the model in which these photos stay listed but do not vote."""
        names = tuple(sorted({*self.settings.excluded, *photos}))
        return LensModel.fit(self.samples, replace(self.settings, excluded=names), prior=self.prior)

    def answering(self, *, mode: str | None = None, unit: str | None = None) -> LensModel:
        """Return the model of the same samples in another mode or unit; None keeps what it has."""
        chosen = replace(self.settings, mode=mode or self.settings.mode, unit=unit or self.settings.unit)
        return self if chosen == self.settings else LensModel.fit(self.samples, chosen, prior=self.prior)

    def including(self, *photos: str) -> LensModel:
        """Return the model in which these photos vote again."""
        names = tuple(name for name in self.settings.excluded if name not in photos)
        return LensModel.fit(self.samples, replace(self.settings, excluded=names), prior=self.prior)

    def with_prior(
        self, source: PsfField | LensModel | None, strength: float = 2.0, name: str = "other copies"
    ) -> LensModel:
        """Return the model that leans on a prior where it has seen little; None switches it off.

        Parameters
        ----------
        source : LensModel or PsfField
            Usually the model of other copies of the lens. A prior that it has itself does not count.
        strength : float
            Number of samples that the prior is worth.
        name : str
            What answers call it.
        """
        prior = None if source is None else Prior(source, strength, name)
        return LensModel(self.samples, self.settings, self._fit, prior=prior)

    # --- asking ---------------------------------------------------------------------------------

    def query(
        self,
        position: FieldPosition,
        settings: LensSettings,
        size: int = 55,
        *,
        pitch_um: float | None = None,
        half_diagonal_px: float | None = None,
    ) -> PsfAnswer:
        """Return the PSF at a place, with the evidence behind it.

        Parameters
        ----------
        position : FieldPosition
        settings : LensSettings
            Unknown settings take no part.
        size : int
            Odd side in pixels.
        pitch_um : float, optional
            Size of a pixel of the body that asks, in micrometres; that of the samples if unknown.
        half_diagonal_px : float, optional
            Half the diagonal of its frame in pixels, which counts where the unit is the half-diagonal.
        """
        pixel = self._pixel(pitch_um, half_diagonal_px)
        inside = self._inner_size(size, pixel)
        answers, mixture, prior_shares = self._asked([position], settings, inside)
        fit = self._fit
        physical = fit.physical_at(settings)
        agreed = fit.mode in {MIXED, "wavefront"} and physical is not None and physical.agreed
        rows, weight = answers.rows, np.maximum(answers.weights, 0.0)
        weight /= weight.sum()
        per_photo = np.bincount(fit.roster.photo[rows], weight)
        independent = 1.0 / float((per_photo**2).sum())
        nearest, beyond = support(fit.index.points[rows], va.point(position, settings), fit.rule)
        # how well the nearest samples agree says nothing of a place without samples
        noise = float(weight @ fit.judgement.noise[rows])
        far = 1.0 + 0.5 * max(nearest - 1.0, 0.0)
        shared = shared_error(float(weight @ fit.told[rows]), noise)

        def expected(held_out: float) -> float:
            return math.hypot(field_error(held_out, noise, independent) * far, shared)

        error = expected(float(mixture.usual if beyond else mixture.squared[0]))
        share = float(prior_shares[0])
        if agreed:
            error = math.sqrt(float(mixture.squared[0])) * far
        if mixture.shares[0, 2] > 0.0:
            # a wavefront that cannot bend as the lens does agrees with itself all over the field: it is
            # never surer than the kernels would be, nor than it agrees with them
            usual = float(np.mean(fit.judgement.errors**2))
            averaged = expected(usual if beyond else float(mixture.averaged[0]))
            error = max(error, averaged, float(mixture.apart[0]))
        if self.prior is not None and share > _LISTED:
            error = math.sqrt((1.0 - share) * error**2 + share * self.prior.error(position, settings) ** 2)

        def scatter() -> NDArray[np.float64]:
            apart = fit.local.apart(rows, position.phi, np.array(fit.widths.at(position, settings)), inside)
            return standard_error(self._at_pixel(apart, size, pixel), weight)

        return PsfAnswer(
            kernel=self._at_pixel(mixture.kernels, size, pixel)[0],
            effective_samples=1.0 / float((weight**2).sum()),
            photos=int(np.count_nonzero(per_photo > _LISTED)),
            extrapolated=bool(beyond),
            predicted_error=min(error, 1.0),
            bandwidth=dict(fit.bandwidth),
            shared_error=shared,
            beyond=beyond,
            nearest=nearest,
            prior="" if self.prior is None else self.prior.name,
            prior_share=share,
            image_frame_share=float(mixture.shares[0, 1]),
            wavefront_share=float(mixture.shares[0, 2]),
            scatter=scatter,
            mode=fit.mode,
        )

    def kernels(
        self,
        positions: Sequence[FieldPosition],
        settings: LensSettings,
        size: int = 55,
        *,
        pitch_um: float | None = None,
        half_diagonal_px: float | None = None,
    ) -> NDArray[np.float64]:
        """Return the PSFs of many places at one setting, shape (n, size, size).

        The same numbers as of `query`, several times faster: for grids and maps.
        """
        if not positions:
            return np.empty((0, size, size))
        pixel = self._pixel(pitch_um, half_diagonal_px)
        _, mixture, _ = self._asked(positions, settings, self._inner_size(size, pixel))
        return self._at_pixel(mixture.kernels, size, pixel)

    def kernel_of(self, sample: PsfSample) -> Kernel:
        """Return the PSF at the place and settings of a sample, in its pixels and of its size."""
        found = self.kernels(
            [sample.position],
            sample.settings,
            sample.kernel.shape[0],
            pitch_um=sample.pixel_pitch_um,
            half_diagonal_px=sample.half_diagonal_px,
        )
        return np.asarray(found[0])

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
            Those that hardly weigh anything are left out.
        """
        near = self._neighbourhood.near([position], settings)
        asked, scale = va.point(position, settings), va.scales(self._fit.bandwidth)
        return near.rows, va.gaps(self._fit.index.points[near.rows], asked, scale), near.weights

    def field(
        self, settings: LensSettings, *, pitch_um: float | None = None, half_diagonal_px: float | None = None
    ) -> ModelField:
        """Return the PSF of every place and channel at these settings, for pixels of some size."""
        return ModelField(self, settings, pitch_um, half_diagonal_px)

    # --- what it is made of ---------------------------------------------------------------------

    @property
    def bandwidth(self) -> dict[str, float]:
        """Bandwidths in use, by variable."""
        return self._fit.bandwidth

    @property
    def pitch_um(self) -> float | None:
        """Pixel pitch that answers are for unless another is asked for; None where no sample knows."""
        fit = self._fit
        return fit.pixel if fit.unit == MICROMETRE else pitches.usual_pixel(self.samples, MICROMETRE)

    @property
    def mode(self) -> str:
        """Which of `MODES` answers: that of the settings, or the one that `warmed` found likeliest."""
        return self._fit.mode

    @property
    def votes(self) -> NDArray[np.float64]:
        """Votes of the samples after robust weighting, shape (n,); 0 of photos that are excluded."""
        return self._fit.judgement.votes

    def flags(self) -> tuple[Flag, ...]:
        """Photos and samples that count less than they claim, with reasons."""
        return self._fit.judgement.flags

    def coverage(self) -> dict[Zone, int]:
        """Number of green samples in each zone."""
        zones = [zone_of(s.position.r) for s in self.samples if s.settings.channel == "g"]
        return {zone: zones.count(zone) for zone in ZONES}

    def cross_validate(self) -> dict[Zone, float]:
        """Median relative L2 of green samples against a model of the other photos, by zone.

        Empty with fewer than two photos.
        """
        if len(self._fit.roster.numbers) < 2:
            return {}
        found: dict[Zone, list[float]] = {zone: [] for zone in ZONES}
        for sample, error in zip(self.samples, self._fit.judgement.errors, strict=True):
            if sample.settings.channel == "g" and sample.photo not in self.settings.excluded:
                found[zone_of(sample.position.r)].append(float(error))
        return {zone: float(np.median(values)) for zone, values in found.items() if values}

    @property
    def nbytes(self) -> int:
        """Bytes of stored kernels, those of the samples included."""
        return self._fit.nbytes + sum(s.kernel.nbytes for s in self.samples)

    # --- inside ---------------------------------------------------------------------------------

    def _asked(
        self, positions: Sequence[FieldPosition], settings: LensSettings, size: int
    ) -> tuple[Answers, Mixture, NDArray[np.float64]]:
        """Answers at the pitch of the samples, and the shares of the prior in them."""
        fit = self._fit
        near = self._neighbourhood.near(positions, settings)
        widths = fit.widths.over(np.array([va.point(p, settings) for p in positions]))
        end, share = nearest(fit.ends, settings)

        def told(experts: Experts) -> Mixture:
            return answered(
                fit.mode, experts, fit.local, fit.statistics, near, positions, settings, widths, size
            )

        mixture = told(self._experts) if end is None or share < 1.0 else None
        if end is not None:
            own = told(replace(self._experts, physical=end.physical))
            mixture = own if mixture is None else between(own, mixture, share)
        assert mixture is not None
        shares = np.zeros(len(positions))
        if self.prior is not None:
            shares = self.prior.strength / (self._seen(positions, settings) + self.prior.strength)
            other = self.prior.kernels(positions, settings, size, self._own_pixels())
            part = shares[:, None, None]
            mixture = replace(mixture, kernels=(1.0 - part) * mixture.kernels + part * other)
        return near, mixture, shares

    def _by_mode(self, samples: Sequence[PsfSample]) -> dict[str, Predict]:
        """Predictors by mode, learned from some of the samples."""
        seen = tuple(samples)
        fit = Fit.of(seen, self.settings).warmed(seen)
        open_ = {"evidence": fit.statistics is not None, "wavefront": fit.physical is not None}

        def told_by(mode: str) -> Predict:
            model = LensModel(seen, self.settings, replace(fit, mode=mode))
            return model.kernel_of

        return {mode: told_by(mode) for mode in MODES if mode != LIKELIEST and open_.get(mode, True)}

    def _seen(self, positions: Sequence[FieldPosition], settings: LensSettings) -> NDArray[np.float64]:
        """How many samples speak of each place, by distances that do not shrink as samples come in."""
        points, votes, scale = self._fit.index.points, self._fit.judgement.votes, va.scales(_AROUND)
        gaps = [va.squared_distances(points, va.point(place, settings), scale) for place in positions]
        return np.array([float(votes @ np.exp(-0.5 * gap)) for gap in gaps])

    def _pixel(self, pitch_um: float | None, half_diagonal_px: float | None) -> float | None:
        """Pixel of who asks, in the unit of the model."""
        for name, value in (("pixel pitch", pitch_um), ("half diagonal", half_diagonal_px)):
            if value is not None and not (math.isfinite(value) and value > 0):
                unit = "micrometres" if name == "pixel pitch" else "pixels"
                raise InvalidInputError(f"the {name} must be positive {unit}, got {value}")
        if self._fit.unit == MICROMETRE:
            return pitch_um
        return None if half_diagonal_px is None else 1.0 / half_diagonal_px

    def _own_pixels(self) -> Pixels:
        """How to ask another model for answers in the pixels of this one."""
        own = self._fit.pixel
        if self._fit.unit == MICROMETRE:
            return {"pitch_um": own}
        return {"half_diagonal_px": None if own is None else 1.0 / own}

    def _inner_size(self, size: int, pixel: float | None) -> int:
        """Side in the pixels of the samples that holds an answer of side `size`."""
        if size < 1 or size % 2 == 0:
            raise InvalidInputError(f"size must be odd and positive, got {size}")
        own = self._fit.pixel
        if own is None or pixel is None or pitches.alike(own, pixel):
            return size
        return min(2 * math.ceil(size / 2 * pixel / own) + 1, max(_WIDEST, size))

    def _at_pixel(self, kernels: NDArray[np.float64], size: int, pixel: float | None) -> NDArray[np.float64]:
        own = self._fit.pixel
        if own is None or pixel is None or pitches.alike(own, pixel):
            return kernels
        return np.stack([pitches.rescaled(kernel, own, pixel, size) for kernel in kernels])


@dataclass(frozen=True, slots=True, eq=False)
class ModelField:
    """The PSF field of a model at one setting."""

    model: LensModel
    settings: LensSettings
    pitch_um: float | None = None
    half_diagonal_px: float | None = None

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel of odd side `size` at a field position, in the image frame."""
        return np.asarray(self.kernels_at([position], channel, size)[0])

    def kernels_at(
        self, positions: Sequence[FieldPosition], channel: Channel, size: int
    ) -> NDArray[np.float64]:
        """Return the kernels of many places, shape (n, size, size), faster than one by one."""
        settings = self.settings.with_channel(channel)
        return self.model.kernels(
            positions, settings, size, pitch_um=self.pitch_um, half_diagonal_px=self.half_diagonal_px
        )
