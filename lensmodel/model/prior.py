"""What is thought of a lens before its own photos speak: a cold start."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfField
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model.answering import AnsweringModel

_SMALL = 15  # pixels along a side of a kernel that is asked for its error alone (chosen: small)


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Another source of PSFs, on which a model leans where it has seen little.

    Parameters
    ----------
    source : LensModel or PsfField
        Usually the model of other copies of the lens, or a published profile. A prior that it has itself does
        not count.
    strength : float
        Number of samples near the place that it is worth.
    name : str
        What answers call it.
    """

    source: PsfField | AnsweringModel
    strength: float = 2.0
    name: str = "other copies"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.strength) and self.strength > 0):
            raise InvalidInputError(f"the strength of a prior must be positive, got {self.strength}")
        if isinstance(self.source, AnsweringModel):
            object.__setattr__(self, "source", self.source.without_prior())

    @property
    def warm(self) -> bool:
        """Whether nothing is left for `warmed` to do."""
        return not isinstance(self.source, AnsweringModel) or self.source.warm

    def warmed(self) -> Prior:
        """Return the prior with the wavefront of its model, fitted if need be."""
        if not isinstance(self.source, AnsweringModel):
            return self
        return Prior(self.source.warmed(), self.strength, self.name)

    def share(self, samples: NDArray[np.float64]) -> NDArray[np.float64]:
        """Its weight, strength / (samples + strength).

        Parameters
        ----------
        samples : ndarray of float64, shape (n,)
            Samples that speak at each place.

        Returns
        -------
        ndarray of float64, shape (n,)
            In 0..1.
        """
        return self.strength / (samples + self.strength)

    def kernels(
        self,
        positions: Sequence[FieldPosition],
        settings: LensSettings,
        size: int,
        *,
        pitch_um: float | None = None,
        half_diagonal_px: float | None = None,
    ) -> NDArray[np.float64]:
        """What it says of some places.

        Parameters
        ----------
        positions : sequence of FieldPosition
        settings : LensSettings
        size : int
            Odd side, pixels.
        pitch_um, half_diagonal_px : float, optional
            As of `LensModel.query`.

        Returns
        -------
        ndarray of float64, shape (n, size, size)
        """
        if isinstance(self.source, AnsweringModel):
            return self.source.kernels(
                positions, settings, size, pitch_um=pitch_um, half_diagonal_px=half_diagonal_px
            )
        return np.stack([self.source.kernel_at(p, settings.channel, size) for p in positions])

    def error(self, position: FieldPosition, settings: LensSettings) -> float:
        """Relative L2 that it expects of itself at a place and settings; 1 where it cannot tell."""
        if isinstance(self.source, AnsweringModel):
            return self.source.query(position, settings, _SMALL).predicted_error
        return 1.0
