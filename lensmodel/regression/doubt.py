"""How far the kernels of a lens may be too wide, as its patches tell.

A kernel that is too wide ruins a photo, one too narrow only helps less. Where a patch would be hardly less
likely behind a narrower kernel, its scene may be soft by itself and the lens sharper than it seems; where it
would be far less likely, nothing but the blur makes its spectrum fall as it does. The bounds were chosen by
the widths of patches' own kernels behind simulated lenses of development seeds (0, 1, 2, 5 and 7, one photo
each).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from lensmodel.regression.likelihood import surprise
from lensmodel.regression.model import LensModel
from lensmodel.types import FieldPosition, LensSettings

_NARROWER: Final = 0.7  # of the width
_OPEN, _SURE = 4.0, 16.0  # rise of a patch's negative log likelihood behind the narrower kernel
_LEAST: Final = 0.5
_NEIGHBOURS: Final = 8


@dataclass(frozen=True, slots=True, eq=False)
class Doubt:
    """How much of its expected error a lens model has to be corrected carefully for.

    Parameters
    ----------
    model : LensModel
    rises : dict
        By the number of a sample: how much its patch's negative log likelihood rises behind narrower
        kernels; kept since many places ask for the same samples.
    """

    model: LensModel
    rises: dict[int, float] = field(default_factory=dict)

    def share(self, position: FieldPosition, settings: LensSettings) -> float:
        """Share of the expected relative L2 of a kernel that counts, for its place and settings.

        1 where kernels may be too wide or no patch nearby has a spectrum, down to a half where the patches
        nearby exclude it.
        """
        rows, _, weights = self.model.weights(position, settings.with_channel("g"))
        green = [
            (float(weight), int(row))
            for row, weight in zip(rows, weights, strict=True)
            if (sample := self.model.samples[row]).spectrum is not None and sample.settings.channel == "g"
        ]
        nearest = sorted(green, reverse=True)[:_NEIGHBOURS]
        total = sum(weight for weight, _ in nearest)
        if total <= 0.0:
            return 1.0
        # one patch whose zeros fit by chance must not speak for all
        rise = sum(weight * min(self._rise(row), _SURE) for weight, row in nearest) / total
        return float(np.interp(rise, (_OPEN, _SURE), (1.0, _LEAST)))

    def _rise(self, row: int) -> float:
        if row not in self.rises:
            sample = self.model.samples[row]
            # a wavefront of the wrong shape may fit one patch so well that any other width fits worse
            self.rises[row] = min(
                surprise(sample, kernel, _NARROWER) - surprise(sample, kernel)
                for kernel in (self.model.kernel_of(sample), sample.kernel)
            )
        return self.rises[row]
