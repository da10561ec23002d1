"""Grids of PSFs of traced lenses, so that the rest of the laboratory takes photos through them."""

from __future__ import annotations

from typing import Final

import numpy as np

from lab.population.kernels import WAVELENGTHS_UM, kernels_of
from lab.population.prescriptions import PRESCRIPTIONS
from lab.population.traced import TracedLens
from lab.traced import GridField
from lensmodel.neural.network import SIDE

_AT_ONCE: Final = 64  # places whose rays are traced together
_INSIDE: Final = 1.001  # half diagonals: designs are traced no farther out than the corner


def grid_of(
    lens: TracedLens, f_number: float | None = None, *, step: float = 0.1, size: int = 55
) -> GridField:
    """Kernels of odd side `size` of a traced lens at nodes of the field, wide open by default.

    Nodes lie `step` half diagonals apart, which divides 1; those beyond the corner repeat the nearest inside.
    """
    reach = round(1.0 / step) + 1
    axis = np.arange(-reach, reach + 1, dtype=np.float64) * step
    right, up = np.meshgrid(axis, axis)
    radius = np.hypot(right, up)
    inside = np.argwhere(radius <= _INSIDE)
    xy = np.stack([right[tuple(inside.T)], up[tuple(inside.T)]], -1)
    parts = [kernels_of(lens, xy[i : i + _AT_ONCE], f_number) for i in range(0, len(xy), _AT_ONCE)]
    margin = (SIDE - size) // 2
    cut = np.concatenate(parts)[:, :, margin : SIDE - margin, margin : SIDE - margin]
    cut = cut / cut.sum((-1, -2), keepdims=True)
    waves = np.array([wave for pair in WAVELENGTHS_UM.values() for wave in pair])
    shifts = np.concatenate(
        [lens.lateral_um(xy[i : i + _AT_ONCE], waves, f_number) for i in range(0, len(xy), _AT_ONCE)]
    )
    of_colours = shifts.reshape(len(xy), 3, 2, 2).mean(2) / lens.pitch_um
    n = axis.size
    kernels = np.zeros((3, n, n, size, size), np.float16)
    centers = np.zeros((3, n, n, 2), np.float32)
    kernels[:, inside[:, 0], inside[:, 1]] = cut.transpose(1, 0, 2, 3)
    centers[:, inside[:, 0], inside[:, 1]] = (of_colours - of_colours[:, 1:2]).transpose(1, 0, 2)
    for i, j in np.argwhere(radius > _INSIDE):
        near = inside[np.argmin(np.hypot(*(inside - (i, j)).T))]
        kernels[:, i, j], centers[:, i, j] = kernels[:, near[0], near[1]], centers[:, near[0], near[1]]
    facts = {
        "design": lens.design,
        "source": PRESCRIPTIONS[lens.design].source,
        "widest": lens.f_number,
        "f_number": f_number or lens.f_number,
        "focal_mm": lens.focal_mm,
        "pitch_um": lens.pitch_um,
        "half_diagonal_mm": lens.half_diagonal_mm,
    }
    return GridField(axis, kernels, centers, facts)
