"""Answers in the pixels of who asks, where kernels are kept in those of the samples."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.model import pitch as pitches
from lensmodel.model.answer import MICROMETRE

# Pixels along a side of the widest kernel that is made for coarser pixels to be asked for: memory
_WIDEST = 255


@dataclass(frozen=True, slots=True)
class Pixels:
    """The pixels of a model and the unit in which bodies agree.

    Parameters
    ----------
    unit : str
        Of `answer.UNITS`.
    own : float or None
        Size of a pixel of the samples in that unit; None where no sample knows.
    """

    unit: str
    own: float | None

    def asked(self, pitch_um: float | None, half_diagonal_px: float | None) -> float | None:
        """Size of a pixel of who asks, in the unit of the model.

        Raises
        ------
        InvalidInputError
            If a size is not positive.
        """
        for name, value in (("pixel pitch", pitch_um), ("half diagonal", half_diagonal_px)):
            if value is not None and not (math.isfinite(value) and value > 0):
                unit = "micrometres" if name == "pixel pitch" else "pixels"
                raise InvalidInputError(f"the {name} must be positive {unit}, got {value}")
        if self.unit == MICROMETRE:
            return pitch_um
        return None if half_diagonal_px is None else 1.0 / half_diagonal_px

    @property
    def as_question(self) -> tuple[float | None, float | None]:
        """Pixel pitch and half diagonal with which another model answers in these pixels."""
        if self.unit == MICROMETRE:
            return self.own, None
        return None, None if self.own is None else 1.0 / self.own

    def inner_size(self, size: int, pixel: float | None) -> int:
        """Side in the pixels of the samples that holds an answer of side `size`.

        Raises
        ------
        InvalidInputError
            If `size` is even or not positive.
        """
        if size < 1 or size % 2 == 0:
            raise InvalidInputError(f"size must be odd and positive, got {size}")
        if self.own is None or pixel is None or pitches.alike(self.own, pixel):
            return size
        return min(2 * math.ceil(size / 2 * pixel / self.own) + 1, max(_WIDEST, size))

    def resampled(self, kernels: NDArray[np.float64], size: int, pixel: float | None) -> NDArray[np.float64]:
        """Kernels `(n, inner, inner)` in pixels of another size, shape (n, size, size)."""
        if self.own is None or pixel is None or pitches.alike(self.own, pixel):
            return kernels
        return np.stack([pitches.rescaled(kernel, self.own, pixel, size) for kernel in kernels])
