"""The PSF of one lens as a continuous function of place and settings."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from lensmodel.core.errors import InvalidInputError, NoSamplesError
from lensmodel.core.psf import PsfSample, as_kernel
from lensmodel.core.types import ZONES, Channel, FieldPosition, Kernel, LensSettings, Zone, zone_of
from lensmodel.model import camera_bodies
from lensmodel.model.learned_field import LearnedField
from lensmodel.model.query import FAR, MODES, PAPER, Array, PsfAnswer
from lensmodel.model.regression import Regression

_LEAST_ERROR: Final = 0.01  # relative L2 below which no part of an answer is believed (chosen)
_LISTED: Final = 1e-3  # share of the weight from which on a photo is counted: less shows in no digit (chosen)

_ZONE_RADII: Final = ((0.1, 0.25), (0.4, 0.6), (0.8, 0.95))  # in the order of `ZONES`
_ZONE_ANGLES: Final = np.arange(4) * np.pi / 2.0 + 0.6  # towards the corners of most pictures


class LensModel:
    """PSF samples of one lens as a continuous function: a value, which `added` keeps.

    Encoded patches of photos are attended to by the network (`learned_field`); kernels that were measured,
    or estimated otherwise, are averaged by the regression of the paper (`regression`). Where there are both,
    each part counts with the inverse of its squared expected error::

        K = (K_a / e_a^2 + K_b / e_b^2) / (1 / e_a^2 + 1 / e_b^2),    1 / e^2 = 1 / e_a^2 + 1 / e_b^2

    In the mode "paper" all kernels are averaged by the regression and nothing else is done.
    """

    def __init__(self, samples: tuple[PsfSample, ...], mode: str, before: Regression | None = None) -> None:
        if mode not in MODES:
            raise InvalidInputError(f"no mode {mode!r} of the lens model; choose one of {', '.join(MODES)}")
        if not samples:
            raise NoSamplesError("the lens has no PSF samples yet; calibrate it with a photo first")
        self.samples, self.mode = samples, mode
        encoded, kernels = _parted(samples, mode)
        self._attention = LearnedField(encoded) if encoded else None
        self._regression = before if before is not None and before.samples == kernels else None
        if kernels and self._regression is None:
            self._regression = Regression(kernels, mode)
        # Fingerprint of the weights of the network, empty where none takes part
        self.weights = "" if self._attention is None else self._attention.network.name
        # Of the pixels that answers are for unless others are asked for, None where no sample knows
        self.pitch_um = camera_bodies.usual_pitch(samples)
        self._answering = [part for part in (self._attention, self._regression) if part is not None]

    @classmethod
    def fit(cls, samples: Sequence[PsfSample], mode: str = "default") -> LensModel:
        """Build a model from samples."""
        return cls(camera_bodies.on_one_circle(samples), mode)

    def added(self, samples: Sequence[PsfSample]) -> LensModel:
        """Return the model with more samples; a regression is fitted anew where these are of its kind."""
        if not samples:
            return self
        placed = camera_bodies.on_one_circle((*self.samples, *samples))
        return LensModel(placed, self.mode, self._regression)

    def query(
        self, position: FieldPosition, settings: LensSettings, size: int = 55, pitch_um: float | None = None
    ) -> PsfAnswer:
        """Return the PSF at a place, of odd side `size`, with what stands behind it.

        Unknown settings take no part; `pitch_um` is that of the body that asks, by default of the samples.
        """
        pitch_um = self._asked(size, pitch_um)
        parts = [part.ask(position, settings, size, pitch_um) for part in self._answering]
        precision = np.array([max(part.error, _LEAST_ERROR) ** -2 for part in parts])
        shares = precision / precision.sum()
        kernel = parts[0].kernel
        if len(parts) > 1:
            kernel = as_kernel(sum(share * part.kernel for share, part in zip(shares, parts, strict=True)))
        weights = np.concatenate([s * part.weights for s, part in zip(shares, parts, strict=True)])
        photos = np.concatenate([part.photos for part in parts])
        names, number = np.unique(photos, return_inverse=True)
        return PsfAnswer(
            kernel=kernel,
            predicted_error=min(float(precision.sum() ** -0.5), 1.0),
            effective_samples=1.0 / float(weights @ weights),
            photos=int(np.count_nonzero(np.bincount(number, weights, len(names)) > _LISTED)),
            extrapolated=min(part.nearest for part in parts) > FAR,
            weights=self.weights,
            ring_error=parts[0].ring_error if len(parts) == 1 else None,
        )

    def kernels(
        self,
        positions: Sequence[FieldPosition],
        settings: LensSettings,
        size: int = 55,
        pitch_um: float | None = None,
    ) -> Array:
        """Return the kernels of `query` of many places, (n, size, size); a regression alone is faster."""
        pitch_um = self._asked(size, pitch_um)
        if not positions:
            return np.empty((0, size, size))
        if self._attention is None and self._regression is not None:
            return self._regression.kernels(positions, settings, size, pitch_um)
        return np.stack([self.query(place, settings, size, pitch_um=pitch_um).kernel for place in positions])

    def _asked(self, size: int, pitch_um: float | None) -> float | None:
        """The pitch of an answer, after refusing questions that have none."""
        if size < 1 or size % 2 == 0:
            raise InvalidInputError(f"size must be odd and positive, got {size}")
        if pitch_um is not None and not (math.isfinite(pitch_um) and pitch_um > 0):
            raise InvalidInputError(f"the pixel pitch must be positive micrometres, got {pitch_um}")
        return self.pitch_um if pitch_um is None else pitch_um

    def coverage(self) -> dict[Zone, int]:
        """Number of green samples in each zone."""
        zones = [zone_of(s.position.r) for s in self.samples if s.settings.channel == "g"]
        return {zone: zones.count(zone) for zone in ZONES}

    def expected_errors(self) -> dict[Zone, float]:
        """Mean error that green answers expect of themselves in each zone, at the commonest settings."""
        kinds = [s.settings.with_channel("g") for s in self.samples]
        settings = max(dict.fromkeys(kinds), key=kinds.count)

        def expected(r: float) -> list[float]:
            places = [FieldPosition(r, float(phi)) for phi in _ZONE_ANGLES]
            return [self.query(place, settings, 15).predicted_error for place in places]

        pairs = zip(ZONES, _ZONE_RADII, strict=True)
        return {zone: float(np.mean([expected(r) for r in radii])) for zone, radii in pairs}

    @property
    def nbytes(self) -> int:
        """Bytes kept, the kernels of the samples included."""
        return sum(p.nbytes for p in self._answering) + sum(s.kernel.nbytes for s in self.samples)


@dataclass(frozen=True, slots=True, eq=False)
class ModelField:
    """The PSF field of a model at one setting, and the error that it expects: what a correction needs."""

    model: LensModel
    settings: LensSettings
    pitch_um: float | None = None

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel of odd side `size` at a field position, in the image frame."""
        return self.answer_at(position, channel, size).kernel

    def answer_at(self, position: FieldPosition, channel: Channel, size: int) -> PsfAnswer:
        """Return the kernel of odd side `size` at a field position, with what is expected of its error."""
        settings = self.settings.with_channel(channel)
        return self.model.query(position, settings, size, pitch_um=self.pitch_um)


def _parted(samples: Sequence[PsfSample], mode: str) -> tuple[list[PsfSample], list[PsfSample]]:
    """One sample of each encoded patch, and those whose kernels are averaged."""
    if mode == PAPER:
        return [], list(samples)
    encoded: dict[Hashable, PsfSample] = {}
    for sample in samples:
        if sample.encoded is not None:
            place = sample.photo, sample.position, sample.settings.with_channel("g")
            encoded.setdefault(place, sample)
    return list(encoded.values()), [s for s in samples if s.encoded is None]
