"""What others need of a lens model: a prior, a field at fixed settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.types import Channel, FieldPosition, Kernel, LensSettings
from lensmodel.model.answer import PsfAnswer


@runtime_checkable
class AnsweringModel(Protocol):
    """A lens model that answers; `LensModel` is one."""

    @property
    def warm(self) -> bool:
        """Whether nothing is left for `warmed` to do."""

    def warmed(self) -> AnsweringModel:
        """Return the model with its wavefront."""

    def without_prior(self) -> AnsweringModel:
        """Return the model that leans on nothing but its own samples."""

    def query(self, position: FieldPosition, settings: LensSettings, size: int = ...) -> PsfAnswer:
        """Return the PSF at a place."""

    def kernels(
        self,
        positions: Sequence[FieldPosition],
        settings: LensSettings,
        size: int = ...,
        *,
        pitch_um: float | None = ...,
        half_diagonal_px: float | None = ...,
    ) -> NDArray[np.float64]:
        """Return the PSFs of many places, shape (n, size, size)."""


@dataclass(frozen=True, slots=True, eq=False)
class ModelField:
    """The PSF field of a model at one setting."""

    model: AnsweringModel
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
