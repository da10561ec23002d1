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

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.geometry import zone_of
from lensmodel.core.psf import PsfField, PsfSample
from lensmodel.core.types import ZONES, FieldPosition, Kernel, LensSettings, StepHook, Zone, ignore_step
from lensmodel.model import learned as memory
from lensmodel.model import pitch as pitches
from lensmodel.model import variables as va
from lensmodel.model.answer import MICROMETRE, WAVEFRONT, ModelSettings, PsfAnswer
from lensmodel.model.answering import AnsweringModel, ModelField
from lensmodel.model.field.robust import Flag
from lensmodel.model.fitting import GROWTH, INCREMENT, Fit
from lensmodel.model.predictor import Predictor
from lensmodel.model.prior import Prior
from lensmodel.model.provenance import provenance
from lensmodel.model.trust.expected_error import forecast
from lensmodel.model.trust.misleading_photos import without_misleading
from lensmodel.model.trust.support import standard_error
from lensmodel.model.wavefront.physical_mean import Physics


class LensModel:
    """PSF samples of one lens as a continuous function: a value, which `added` and the like keep.

    Made by `fit` or `restored`, which say what samples, settings and prior are; `fit` is what was learned.
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
        self._predictor = Predictor(fit, settings.regression.method, prior)

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

        Parameters
        ----------
        samples : sequence of PsfSample
        settings : ModelSettings, optional
        prior : Prior, optional
            What answers lean on where there are few samples.

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

        A handful is put in place without touching the others, until the model has grown by a twentieth; then
        all is fitted anew, and wants to be `warmed` again: that begins where this fit ended, too.
        """
        return self._with(samples, INCREMENT)

    def grown(self, samples: Sequence[PsfSample]) -> LensModel:
        """Return the model with more samples in place, for answers until it has been fitted anew elsewhere.

        As `added`, but up to twice the samples that it was fitted to: from the second photo on only the trees
        and the store of kernels grow.
        """
        return self._with(samples, GROWTH)

    def _with(self, samples: Sequence[PsfSample], increment: float) -> LensModel:
        new = tuple(samples)
        if not new:
            return self
        if not self._fit.takes(new, increment):
            every = (*self.samples, *new)
            fit = Fit.of(every, self.settings).begun_with(self._fit)
            return LensModel(every, self.settings, fit, prior=self.prior)
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

    def begun_with(self, learned: bytes) -> LensModel:
        """Return the model whose fit begins where `learned` of fewer samples ended, besides all other places.

        Bytes that are damaged or of another version are no beginning.
        """
        fit = replace(self._fit, former=memory.fronts(learned))
        return LensModel(self.samples, self.settings, fit, prior=self.prior)

    def learned(self) -> bytes:
        """What was learned from the samples, the wavefront included if `warm`; see `restored`."""
        return memory.dump(self._fit, self.samples, self.settings)

    @property
    def warm(self) -> bool:
        """Whether nothing is left for `warmed` to do."""
        if self.prior is not None and not self.prior.warm:
            return False
        return self._fit.physical is not None or not self._wants_wavefront

    @property
    def _wants_wavefront(self) -> bool:
        """Whether answers need a wavefront, or patches can judge it as a second opinion."""
        if self.settings.mode == WAVEFRONT:
            return True
        return self._predictor.smoother.physical and any(s.spectrum is not None for s in self.samples)

    def warmed(self, on_step: StepHook = ignore_step) -> LensModel:
        """Return the model with the wavefront fitted to its samples, if its method or mode has one.

        That takes seconds of CPU, and the answers are good without it: call it once when the samples are
        complete. The same samples give the same model, if none of them was fitted before. A correction hears
        the wavefront as a second opinion (`witness`). Photos that make the patches of the others less likely
        lose their votes here (`misleading`).
        """
        if self.warm:
            return self
        prior = None if self.prior is None else self.prior.warmed()
        judged = without_misleading(self._fit, self.samples, self.settings)
        fit = judged.warmed(self.samples, on_step)
        return LensModel(self.samples, self.settings, fit, prior=prior)

    def answering(self, *, mode: str | None = None, unit: str | None = None) -> LensModel:
        """Return the model of the same samples in another mode or unit; None keeps what it has."""
        chosen = replace(self.settings, mode=mode or self.settings.mode, unit=unit or self.settings.unit)
        return self if chosen == self.settings else LensModel.fit(self.samples, chosen, prior=self.prior)

    def opinion(self, mode: str) -> LensModel | None:
        """Return the model of the same fit that answers in another mode; None without a wavefront for it."""
        if mode == WAVEFRONT and self._fit.physical is None:
            return None
        return LensModel(self.samples, self.settings, replace(self._fit, mode=mode), prior=self.prior)

    def hearing(self, patches: Sequence[PsfSample]) -> LensModel:
        """Return the model that also heeds how dark a photo gets, which is to be corrected: `Fit.heard`."""
        fit = replace(self._fit, heard=tuple(patches))
        return LensModel(self.samples, self.settings, fit, prior=self.prior)

    def with_prior(
        self, source: PsfField | AnsweringModel | None, strength: float = 2.0, name: str = "other copies"
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

    def without_prior(self) -> LensModel:
        """Return the model that leans on nothing but its own samples."""
        return self if self.prior is None else self.with_prior(None)

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
        pixel = self._predictor.pixels.asked(pitch_um, half_diagonal_px)
        inside = self._predictor.pixels.inner_size(size, pixel)
        answers, mixture, prior_shares = self._predictor.ask([position], settings, inside)
        fit = self._fit
        share, wavefront_share = float(prior_shares[0]), float(mixture.shares[0])
        prior = None if self.prior is None else (self.prior, share)
        expected = forecast(fit, answers, mixture, position, settings, prior)
        takes = self._predictor.smoother.physical
        made = provenance(fit, answers, wavefront_share, settings, takes_wavefront=takes)

        def scatter() -> NDArray[np.float64]:
            widths = np.array(fit.widths.at(position, settings))
            apart = fit.local.apart(answers.rows, position.phi, widths, inside)
            return standard_error(self._predictor.pixels.resampled(apart, size, pixel), answers.shares)

        return PsfAnswer(
            kernel=self._predictor.pixels.resampled(mixture.kernels, size, pixel)[0],
            effective_samples=made.effective_samples,
            photos=made.photos,
            extrapolated=bool(expected.beyond),
            predicted_error=min(expected.error, 1.0),
            bandwidth=dict(fit.bandwidth),
            shared_error=expected.shared,
            beyond=expected.beyond,
            nearest=expected.nearest,
            prior="" if self.prior is None else self.prior.name,
            prior_share=share,
            wavefront_share=wavefront_share,
            far_light=float(mixture.far_light[0]),
            answered_by=made.answered_by,
            reason=made.reason,
            scatter=scatter,
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
        """Return the PSFs of many places at one setting, float64 of shape (n, size, size).

        The same numbers as of `query`, whose parameters it takes, several times faster: for grids and maps.
        """
        if not positions:
            return np.empty((0, size, size))
        pixel = self._predictor.pixels.asked(pitch_um, half_diagonal_px)
        inside = self._predictor.pixels.inner_size(size, pixel)
        _, mixture, _ = self._predictor.ask(positions, settings, inside)
        return self._predictor.pixels.resampled(mixture.kernels, size, pixel)

    def kernel_of(self, sample: PsfSample) -> Kernel:
        """Return the PSF at the place and settings of a sample, in its pixels and of its size."""
        pixels = {"pitch_um": sample.pixel_pitch_um, "half_diagonal_px": sample.half_diagonal_px}
        size = sample.kernel.shape[0]
        return np.asarray(self.kernels([sample.position], sample.settings, size, **pixels)[0])

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
        near = self._predictor.near([position], settings)
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
        """Which of `MODES` answers."""
        return self._fit.mode

    @property
    def physical(self) -> Physics | None:
        """The wavefront that was fitted to the samples; None before `warmed`, or if it takes no part."""
        return self._fit.physical

    @property
    def votes(self) -> NDArray[np.float64]:
        """Votes of the samples after robust weighting, shape (n,); 0 of photos that are excluded."""
        return self._fit.validation.votes

    def flags(self) -> tuple[Flag, ...]:
        """Photos and samples that count less than they claim, with reasons."""
        return self._fit.validation.flags

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
        errors: dict[Zone, list[float]] = {zone: [] for zone in ZONES}
        for sample, error in zip(self.samples, self._fit.validation.errors, strict=True):
            if sample.settings.channel == "g" and sample.photo not in self.settings.excluded:
                errors[zone_of(sample.position.r)].append(float(error))
        return {zone: float(np.median(values)) for zone, values in errors.items() if values}

    @property
    def nbytes(self) -> int:
        """Bytes of stored kernels, those of the samples included."""
        return self._fit.nbytes + sum(s.kernel.nbytes for s in self.samples)
