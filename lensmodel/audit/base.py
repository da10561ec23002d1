"""What the checks are given, and what comes out of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.blur import UniformBlur
from lensmodel.errors import InvalidInputError
from lensmodel.types import CHANNELS, NoiseModel, Plane, Planes

LEAST_VARIANCE: Final = 1e-12
"""Variance that even black without read noise is given."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What is known of a tile apart from its pixels.

    Parameters
    ----------
    noise : sequence of NoiseModel
        One per channel; of what was measured where `measured` says so, else of every pixel.
    clip : sequence of float
        Level per channel from which on a value of the photo is only a lower bound.
    blurs : sequence of UniformBlur or None
        PSF of each channel, lateral shift included; None where it is not known, and nothing is re-blurred.
    psf_errors : sequence of float
        Expected relative L2 error of each PSF.
    measured : sequence of (ndarray of bool or None)
        Per channel where the sensor measured it, `(rows, cols)`; None for everywhere.
    """

    noise: Sequence[NoiseModel]
    clip: Sequence[float] = (1.0, 1.0, 1.0)
    blurs: Sequence[UniformBlur] | None = None
    psf_errors: Sequence[float] = (0.0, 0.0, 0.0)
    measured: Sequence[NDArray[np.bool_] | None] = (None, None, None)

    def __post_init__(self) -> None:
        counts = [len(self.noise), len(self.clip), len(self.psf_errors), len(self.measured)]
        if self.blurs is not None:
            counts.append(len(self.blurs))
        if any(count != len(CHANNELS) for count in counts):
            raise InvalidInputError(f"every kind of evidence needs one entry per channel, got {counts}")


@dataclass(frozen=True, slots=True, eq=False)
class Fault:
    """What one check found in a tile.

    Parameters
    ----------
    check : str
        Name of the check, as in `checks`.
    severity : Plane, shape (rows, cols)
        How many times what is allowed was found, at each pixel; 1 and less is in order.
    """

    check: str
    severity: Plane


@dataclass(frozen=True, slots=True)
class Finding:
    """What one check held back of a tile.

    Parameters
    ----------
    check : str
        Name of the check.
    held_back : float
        Mean share of the correction that it alone would hold back, 0 to 1.
    area : float
        Share of the pixels of which it would hold back more than a half.
    worst : float
        The largest multiple of what is allowed.
    at : tuple of int
        Pixel `(row, col)` of the tile where that is.
    """

    check: str
    held_back: float
    area: float
    worst: float
    at: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class TileAudit:
    """Verdict on one tile.

    Parameters
    ----------
    keep : Plane, shape (rows, cols)
        Share of the correction that is kept, 0 to 1; 1 everywhere on a sound tile.
    findings : tuple of Finding
        One for each check that ran, in their order.
    """

    keep: Plane
    findings: tuple[Finding, ...]

    @property
    def held_back(self) -> float:
        """Mean share of the correction that is held back."""
        return float(1.0 - self.keep.mean(dtype=np.float64))

    @property
    def reasons(self) -> tuple[str, ...]:
        """Names of the checks that held something back, the one that held back most first."""
        at_fault = [finding for finding in self.findings if finding.held_back > 0.0]
        return tuple(f.check for f in sorted(at_fault, key=lambda f: -f.held_back))


def sigma_of(noise: NoiseModel, plane: Plane) -> Plane:
    """Standard deviation of the noise at each pixel of the photo."""
    return np.sqrt(np.maximum(noise.variance(plane), LEAST_VARIANCE)).astype(np.float32)


def check_pair(original: Planes, corrected: Planes) -> None:
    """Refuse planes that do not belong together.

    Raises
    ------
    InvalidInputError
        If they are no three planes of one size.
    """
    if original.shape != corrected.shape or original.ndim != 3 or original.shape[0] != len(CHANNELS):
        raise InvalidInputError(
            f"original and correction must be (3, rows, cols) of one size, got {original.shape} and "
            f"{corrected.shape}"
        )
