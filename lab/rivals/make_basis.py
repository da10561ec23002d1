"""Make the stored basis of lens PSFs: simulated lenses of development seeds.

Run as ``python -m lab.rivals.make_basis``; takes a few minutes and writes
data/rival_basis.npz of the benchmark.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from lab.rivals.basis import STORED, principal, save_basis
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.simulate import draw_lens

SEEDS: Final = range(100)  # those of development
RADII: Final = (0.0, 0.25, 0.5, 0.7, 0.85, 1.0)  # half diagonals (chosen): denser outwards
QUARTERS: Final = (0, 1, 2, 3)
"""Directions of the field in quarter turns: only these take a kernel to the local frame exactly."""

SIDE: Final = 31  # pixels of a kernel: that of an estimate
COMPONENTS: Final = 32  # kept in the basis (chosen)
_STOPS: Final = (1.0, math.sqrt(2.0))  # factors on the f-number (chosen): wide open, and one stop closed


def main() -> None:
    """Draw the lenses, take their kernels in the local frame, and store the principal components."""
    fields = []
    for seed in SEEDS:
        lens = draw_lens(seed)
        for stop in _STOPS:
            settings = LensSettings(aperture=lens.optics[0].f_number * stop, focal_mm=lens.focal_mm[0])
            for quarter in QUARTERS:
                places = [FieldPosition(r, quarter * math.pi / 2.0) for r in RADII]
                kernels = [lens.kernel(place, settings, SIDE) for place in places]
                fields.append([np.rot90(kernel, -quarter) for kernel in kernels])
    save_basis(principal(np.array(fields), RADII, COMPONENTS), STORED)


if __name__ == "__main__":
    main()
