"""What one asks a lens model for and what it answers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError, UnknownMethodError
from lensmodel.core.types import Kernel
from lensmodel.model.variables import Support

PAPER: Final = "paper"
MODES: Final = ("default", PAPER)  # ways to answer from samples, see `ModelSettings.mode`

AnsweredBy: TypeAlias = Literal["network", "regression", "network and regression", "paper"]
"""What made an answer."""


@dataclass(frozen=True, slots=True)
class ModelSettings:
    """Choices of the model [1]_; None means automatic.

    Parameters
    ----------
    r, phi, stops : float or None
        Bandwidths of the regression in half-diagonals, chord of the unit circle, and stops. Automatic:
        eq. (8) of the paper [1]_, and from three photos on the factors on it with the least
        leave-one-photo-out error.
    mode : {"default", "paper"}
        "default": attention over the encoded patches of photos, and regression over the samples that were
        measured or estimated otherwise, each with the weight of its expected error. "paper": the regression
        of the paper over all kernels and nothing else, to compare with.

    Raises
    ------
    InvalidInputError
        If a value is out of its range.
    UnknownMethodError
        If there is no such mode.

    References
    ----------
    .. [1] M. Hirsch, B. Schölkopf, "Self-Calibration of Optical Lenses", ICCV 2015, section 6.2.
    """

    r: float | None = None
    phi: float | None = None
    stops: float | None = None
    mode: str = "default"

    def __post_init__(self) -> None:
        for name in ("r", "phi", "stops"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InvalidInputError(
                    f"bandwidth {name} must be positive, or None for automatic, got {value}"
                )
        if self.mode not in MODES:
            raise UnknownMethodError(
                f"no mode {self.mode!r} of the lens model; choose one of {', '.join(MODES)}"
            )


@dataclass(frozen=True, slots=True, eq=False)
class PsfAnswer:
    """A PSF with what stands behind it.

    Parameters
    ----------
    kernel : Kernel, float64, shape (size, size)
        In the image frame, centred, sum 1.
    predicted_error : float
        Expected relative L2 of the kernel, 0..1.
    effective_samples : float
        1 / sum W^2 of the samples' weights W in the answer, of sum 1.
    photos : int
        Photos of these samples.
    nearest : float
        Distance to the nearest sample, see `lensmodel.model.variables.Support`.
    beyond : tuple of str
        Variables in which the question lies far from all samples.
    answered_by : {"network", "regression", "network and regression", "paper"}
        What made the answer.
    weights : str
        Fingerprint of the network's weights; empty where no network took part.
    ring_error : ndarray of float64, shape (8,), or None
        Expected r.m.s. error of the transfer function in rings of frequency; None where no network took part.
    """

    kernel: Kernel
    predicted_error: float
    effective_samples: float
    photos: int
    nearest: float
    beyond: tuple[str, ...]
    answered_by: AnsweredBy
    weights: str = ""
    ring_error: NDArray[np.float64] | None = None

    @property
    def extrapolated(self) -> bool:
        """Whether no sample is near."""
        return bool(self.beyond)


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """What one way of answering says: the network or the regression."""

    kernel: Kernel
    error: float  # expected relative L2
    weights: NDArray[np.float64]  # (n,), of the samples in the answer, of sum 1
    photos: NDArray[np.object_]  # (n,), of these samples
    support: Support
    ring_error: NDArray[np.float64] | None = None
