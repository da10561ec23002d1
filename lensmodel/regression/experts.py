"""Several answers to one question, mixed by how wrong they were near the place.

With e the relative L2 of samples that an expert had not seen, weighed as the question weighs them,
its share is proportional to e^-4: where one is much worse than the others it loses its say by itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lensmodel.psf import as_kernel
from lensmodel.regression import kriging
from lensmodel.regression import variables as va
from lensmodel.regression.judgement import Judgement
from lensmodel.regression.physical import PhysicalMean
from lensmodel.regression.store import KernelStore
from lensmodel.types import FieldPosition, Kernel, LensSettings

_SILENT = 1e-3


@dataclass(frozen=True, slots=True)
class Shares:
    """Weights of the image frame and of the wavefront; the local frame has what is left."""

    image_frame: float = 0.0
    wavefront: float = 0.0


@dataclass(slots=True, eq=False)
class Experts:
    """Experts besides the regression in the local frame.

    Parameters
    ----------
    where : ndarray, shape (n, 7)
        Points of the samples.
    judgement : Judgement
    scale : ndarray, shape (7,)
        Bandwidths.
    pixels : KernelStore or None
        Kernels of the image frame, for kriging; None if it takes no part.
    physical : PhysicalMean or None
        Likewise.
    """

    where: NDArray[np.float64]
    judgement: Judgement
    scale: NDArray[np.float64]
    pixels: KernelStore | None
    physical: PhysicalMean | None
    vectors: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        self.vectors = va.vectors(self.where)

    def mixed(
        self,
        kernel: Kernel,
        held_out: float,
        rows: NDArray[np.intp],
        weight: NDArray[np.float64],
        position: FieldPosition,
        settings: LensSettings,
    ) -> tuple[Kernel, float, Shares]:
        """Mix an answer of the local frame with those of the others.

        Parameters
        ----------
        kernel, held_out
            Answer of the local frame and its squared error near the place.
        rows, weight : ndarray, shape (m,)
            Samples near the place, and weights of sum 1 that say how near.

        Returns
        -------
        kernel, squared error of the mixture, shares
        """
        squared = [held_out, math.inf, math.inf]
        if self.pixels is not None and self.judgement.image_errors is not None:
            squared[1] = float(weight @ self.judgement.image_errors[rows] ** 2)
        if self.physical is not None:
            errors = self.physical.extended_errors(len(self.where))
            squared[2] = math.inf if errors is None else float(weight @ errors[rows] ** 2)
        parts = np.maximum(squared, 1e-15) ** -2.0
        shares = parts / parts.sum()
        shares = np.where(shares < _SILENT, 0.0, shares)
        shares /= shares.sum()
        size = kernel.shape[0]
        light = shares[0] * kernel
        if shares[1] > 0 and self.pixels is not None:
            light = light + shares[1] * self._of_image_frame(self.pixels, position, settings, size)
        if shares[2] > 0 and self.physical is not None:
            light = light + shares[2] * kriging.as_pixels(self.physical.row(position, settings), size)
        error = sum(float(s) * e for s, e in zip(shares, squared, strict=True) if s > 0)
        return as_kernel(light), error, Shares(float(shares[1]), float(shares[2]))

    def _of_image_frame(
        self, pixels: KernelStore, position: FieldPosition, settings: LensSettings, size: int
    ) -> Kernel:
        row = kriging.predict(
            pixels.rows,
            self.vectors,
            self.where,
            self.judgement.votes,
            kriging.field_vector(position),
            va.point(position, settings),
            self.scale,
            self.judgement.nugget,
        )
        return kriging.as_pixels(row, size)
