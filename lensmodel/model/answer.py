"""What one asks a lens model for and what it answers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError, UnknownMethodError
from lensmodel.core.types import Kernel
from lensmodel.model.field.smoothers import smoothers

BOTH: Final = "both"
KERNELS: Final = "kernels"
WAVEFRONT: Final = "wavefront"
PAPER: Final = "paper"
MODES: Final = (BOTH, KERNELS, WAVEFRONT, PAPER)
"""What can be made of the neighbours of a question; `modes` tells what they are."""

FORMER_MODES: Final = frozenset({"evidence", "likeliest", "mixed"})
"""Modes that profiles of earlier versions may name; the usual one answers then."""

MICROMETRE: Final = "micrometre"
HALF_DIAGONAL: Final = "half-diagonal"
UNITS: Final = (MICROMETRE, HALF_DIAGONAL)
"""In what kernels of bodies with different pixels agree; see `pitch`."""


@dataclass(frozen=True, slots=True)
class ModelSettings:
    """Choices of the regression [1]_; None means automatic.

    Parameters
    ----------
    r, phi, stops : float or None
        Bandwidths in half-diagonals, chord of the unit circle, and stops. Automatic: eq. (8) of the paper
        [1]_, and from three photos on the factors on it with the least leave-one-photo-out error.
    method : str
        Name in `smoothers`.
    rotational : float or None
        Strength of rotational symmetry: 0 none, 1 all angles count alike. None: by cross-validation.
    mirror : float or None
        Weight of each sample's mirror image about the meridional plane, 0..1. None: same.
    robust : bool
        Whether photos and samples that do not fit the others count less.
    excluded : tuple of str
        Photos whose samples do not vote; they stay listed.
    mode : {"both", "kernels", "wavefront", "paper"}
        What is made of the neighbours. "both": their kernels averaged, with the wavefront that the spectra of
        all patches agree on where there is one. "kernels": without it, for lenses that no such wavefront
        describes. "wavefront": it alone, wherever one could be fitted. "paper": the kernels averaged and
        nothing else, to compare with.
    unit : {"micrometre", "half-diagonal"}
        In what (u, v) are the same for all bodies.

    Raises
    ------
    InvalidInputError
        If a value is out of its range.
    UnknownMethodError
        If there is no such regression, mode or unit.

    Notes
    -----
    Symmetry, robustness, the factors on eq. (8) and the wavefront are this project's own; the mode "paper"
    leaves them out.

    References
    ----------
    .. [1] M. Hirsch, B. Schölkopf, "Self-Calibration of Optical Lenses", ICCV 2015, section 6.2.
    """

    r: float | None = None
    phi: float | None = None
    stops: float | None = None
    method: str = "combined"
    rotational: float | None = None
    mirror: float | None = None
    robust: bool = True
    excluded: tuple[str, ...] = ()
    mode: str = BOTH
    unit: str = MICROMETRE

    def __post_init__(self) -> None:
        for name in ("r", "phi", "stops"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InvalidInputError(
                    f"bandwidth {name} must be positive, or None for automatic, got {value}"
                )
        for name in ("rotational", "mirror"):
            value = getattr(self, name)
            if value is not None and not 0.0 <= value <= 1.0:
                raise InvalidInputError(f"{name} symmetry must lie in 0..1, or None, got {value}")
        smoothers.create(self.method)  # refuses a name that there is not
        if self.mode not in MODES:
            why = "is gone" if self.mode in FORMER_MODES else "is not known"
            raise UnknownMethodError(
                f"the mode {self.mode!r} of the lens model {why}; choose one of {', '.join(MODES)}"
            )
        if self.unit not in UNITS:
            raise UnknownMethodError(f"no unit {self.unit!r} of the lens model; known: {', '.join(UNITS)}")
        object.__setattr__(self, "excluded", tuple(str(name) for name in self.excluded))

    @property
    def regression(self) -> ModelSettings:
        """The choices that hold: the mode "paper" leaves none but those of bandwidths and photos."""
        if self.mode != PAPER:
            return self
        return replace(self, method="nadaraya-watson", mirror=0.0, robust=False)


@dataclass(frozen=True, slots=True, eq=False)
class PsfAnswer:
    """A PSF with how much stands behind it.

    The kernel is that of the regression [1]_ or of a wavefront; the other figures are this project's own.

    Parameters
    ----------
    kernel : Kernel, float64, shape (size, size)
        In the image frame, centered, sum 1.
    effective_samples : float
        1 / sum W^2 of the samples' parts in the answer, see `provenance`.
    photos : int
        Photos of these samples.
    extrapolated : bool
        True where no sample is near.
    predicted_error : float
        Expected relative L2, from the held-out errors of the neighbours and `shared_error`; at most 1.
    shared_error : float
        The part of it that all samples share, which no number of them makes smaller: what their estimators
        expect beyond what their scatter shows. 0 where they expect nothing.
    bandwidth : mapping of str to float
        Bandwidths that were used, in the units of `ModelSettings`.
    beyond : tuple of str
        Variables in which the question lies outside the samples.
    nearest : float
        Distance to the nearest sample, in bandwidths of eq. (8) of the paper [1]_.
    prior : str
        Name of the prior that the model leans on where it has seen little; empty without one.
    prior_share : float
        Weight of the prior in the kernel, 0..1; 0 without a prior.
    wavefront_share : float
        Weight of the fitted wavefront, 0..1.
    far_light : float
        Share of the kernel's light that lies far from its core as shadows of the photos allow, 0..1, see
        `far_light`; 0 where none speaks of it.
    answered_by : str
        Which model answered: "regression", "wavefront and regression", "wavefront" or "paper".
    reason : str
        Why that one.
    scatter : callable or None
        Computes `std`, float64 of the shape of the kernel.

    References
    ----------
    .. [1] M. Hirsch, B. Schölkopf, "Self-Calibration of Optical Lenses", ICCV 2015, section 6, eq. 4 to 8.
    """

    kernel: Kernel
    effective_samples: float
    photos: int
    extrapolated: bool
    predicted_error: float
    bandwidth: Mapping[str, float]
    shared_error: float = 0.0
    beyond: tuple[str, ...] = ()
    nearest: float = 0.0
    prior: str = ""
    prior_share: float = 0.0
    wavefront_share: float = 0.0
    far_light: float = 0.0
    answered_by: str = ""
    reason: str = ""
    scatter: Callable[[], NDArray[np.float64]] | None = field(default=None, repr=False)

    @property
    def std(self) -> NDArray[np.float64] | None:
        """Standard error of each pixel from the scatter of the samples, float64 of shape (size, size).

        Computed when it is read: each neighbour is turned to the place alone. None where the model that made
        the answer is not at hand.
        """
        return None if self.scatter is None else self.scatter()
