"""Inputs and results of the checks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import CHANNELS, NoiseModel, Plane, Planes
from lensmodel.correction.audit import blocks
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.engine import Engine, compiled_checks

LEAST_VARIANCE: Final = 1e-12
"""Least variance, given even to black without read noise: keeps divisions finite."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What is known of a tile apart from its pixels.

    Parameters
    ----------
    noise : sequence of NoiseModel
        One per channel; that of the measured pixels if `measured` is given, else of every pixel.
    clip : sequence of float
        Level per channel at and above which a value of the photo is only a lower bound.
    blurs : sequence of UniformBlur or None
        PSF of each channel, lateral shift included; None if unknown, and nothing is re-blurred.
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

    @property
    def mosaic(self) -> bool:
        """Whether the sensor measured a colour at some of the pixels only."""
        return any(measured is not None for measured in self.measured)


@dataclass(frozen=True, slots=True, eq=False)
class TilePair:
    """A tile of a photo and its correction, with what several checks need.

    Parameters
    ----------
    original, corrected : Planes, shape (3, rows, cols)
        Linear light, saturation 1; the correction no brighter than what the file can hold.
    sigma : Planes
        Standard deviation of the photo's noise at each pixel.
    evidence : Evidence
        What else is known.
    luma : ndarray of float32, shape (2, rows, cols)
        Mean of the colours, of the photo and of the correction.
    loops : module or None
        `lensmodel.correction.audit.compiled`, or None for NumPy.
    memo : dict
        Results of one check that another may use.
    """

    original: Planes
    corrected: Planes
    sigma: Planes
    evidence: Evidence
    luma: NDArray[np.float32]
    loops: ModuleType | None = None
    memo: dict[str, Any] = field(default_factory=dict, init=False)

    @classmethod
    def of(
        cls, original: Planes, corrected: Planes, evidence: Evidence, *, engine: Engine = "auto"
    ) -> TilePair:
        """Check that the planes belong together.

        Light above the photo's clipping level is written as that level, so it is also judged as that.

        Raises
        ------
        InvalidInputError
            If they are not three planes of one size.
        """
        if original.shape != corrected.shape or original.ndim != 3 or original.shape[0] != len(CHANNELS):
            raise InvalidInputError(
                f"original and correction must be (3, rows, cols) of one size, got {original.shape} and "
                f"{corrected.shape}"
            )
        loops = compiled_checks(engine)
        if loops is not None:
            return cls._compiled(original, corrected, evidence, loops)
        top = np.asarray(evidence.clip, dtype=np.float32)[:, None, None]
        sigma = [
            np.sqrt(np.maximum(n.variance(y), LEAST_VARIANCE))
            for n, y in zip(evidence.noise, original, strict=True)
        ]
        written = np.minimum(corrected, top)
        third = np.float32(1.0 / 3.0)
        luma = np.stack([(p[0] + p[1] + p[2]) * third for p in (original, written)])
        return cls(original, written, np.asarray(sigma, dtype=np.float32), evidence, luma)

    @classmethod
    def _compiled(
        cls, original: Planes, corrected: Planes, evidence: Evidence, loops: ModuleType
    ) -> TilePair:
        y, x = (np.ascontiguousarray(p, dtype=np.float32) for p in (original, corrected))
        written, sigma = np.empty_like(y), np.empty_like(y)
        luma = np.empty((2, *y.shape[1:]), dtype=np.float32)
        noise = np.array([[n.shot, n.read] for n in evidence.noise])
        clip, luma_sigma = np.asarray(evidence.clip, dtype=np.float32), np.empty_like(luma[0])
        loops.prepared(y, x, clip, noise, LEAST_VARIANCE, written, sigma, luma, luma_sigma)
        pair = cls(y, written, sigma, evidence, luma, loops)
        pair.memo["luma_sigma"] = luma_sigma
        return pair

    @property
    def luma_sigma(self) -> Plane:
        """Standard deviation of the noise of the mean of the colours."""
        if "luma_sigma" not in self.memo:
            variance = np.square(self.sigma).sum(axis=0)
            self.memo["luma_sigma"] = np.sqrt(variance) * np.float32(1.0 / 3.0)
        return np.asarray(self.memo["luma_sigma"])

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.original.shape[1], self.original.shape[2]


@dataclass(frozen=True, slots=True, eq=False)
class Severity:
    """How many times its limit a check found, on a grid of places; 1 and less is fine.

    Parameters
    ----------
    values : ndarray of float32, shape (down, across)
        One for each place.
    step : int
        Pixels from one place to the next; 1 for every pixel.
    first : float
        Pixel of the first place, in rows and in columns.
    """

    values: NDArray[np.float32]
    step: int = 1
    first: float = 0.0

    @classmethod
    def none(cls) -> Severity:
        """No fault anywhere."""
        return cls.of_blocks(np.zeros((1, 1), dtype=np.float32))

    @classmethod
    def of_blocks(cls, values: NDArray[np.float32]) -> Severity:
        """Figures of `blocks`, each at the middle of its block."""
        return cls(values, blocks.SIDE, (blocks.SIDE - 1) / 2.0)

    def part(self, inner: tuple[slice, slice], shape: tuple[int, int]) -> tuple[slice, slice]:
        """Places of the grid that lie in a part of a tile of `shape`; the nearest one if none does."""
        slices = []
        for part, extent, count in zip(inner, shape, self.values.shape, strict=True):
            start, stop, _ = part.indices(extent)
            low = int(np.clip(np.ceil((start - self.first) / self.step), 0, count - 1))
            high = int(np.clip(np.floor((stop - 1 - self.first) / self.step), low, count - 1))
            slices.append(slice(low, high + 1))
        return slices[0], slices[1]


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
        The largest multiple of the limit.
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
    held_back : float
        Mean share of the correction that is held back.
    """

    keep: Plane
    findings: tuple[Finding, ...]
    held_back: float

    @classmethod
    def of(cls, keep: Plane, findings: tuple[Finding, ...]) -> TileAudit:
        """Take the mean of a map.

        Parameters
        ----------
        keep : Plane
            Share of the correction to keep, 0..1.
        findings : tuple of Finding

        Returns
        -------
        TileAudit
        """
        return cls(keep, findings, float(1.0 - keep.mean(dtype=np.float64)))

    def without_map(self) -> TileAudit:
        """Return the figures alone, for a report: the maps of all tiles are as large as a photo's plane.

        Returns
        -------
        TileAudit
        """
        return replace(self, keep=np.zeros((0, 0), dtype=np.float32))

    @property
    def reasons(self) -> tuple[str, ...]:
        """Names of the checks that held something back, the strictest first."""
        at_fault = [finding for finding in self.findings if finding.held_back > 0.0]
        return tuple(f.check for f in sorted(at_fault, key=lambda f: -f.held_back))
