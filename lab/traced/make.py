"""Grids from traced lenses."""

from __future__ import annotations

import logging
import math
from dataclasses import asdict
from typing import Final

import numpy as np

from lab.traced.designs import designs
from lab.traced.grid import GridField
from lab.traced.image import kernel_of
from lab.traced.lens import TracedLens
from lensmodel.core.psf import distance
from lensmodel.core.types import CHANNELS, FieldPosition, StepHook, ignore_step

logger = logging.getLogger(__name__)

DEFAULT_STEP: Final = 0.1
"""Distance of the nodes in half diagonals, that of `lensmodel.simulate.camera`."""


def make_grid(
    lens: TracedLens,
    f_number: float | None = None,
    *,
    step: float = DEFAULT_STEP,
    size: int = 55,
    pitch_um: float = 4.5,
    on_step: StepHook = ignore_step,
) -> GridField:
    """Trace a lens at the nodes of a grid.

    Parameters
    ----------
    lens : TracedLens
    f_number : float or None
        None means wide open.
    step : float
        Distance of the nodes in half diagonals; it divides 1.
    size : int
        Odd side of the kernels in pixels.
    pitch_um : float
        Pixel pitch.
    on_step : StepHook
        Called after each node.

    Returns
    -------
    GridField

    Notes
    -----
    Cost: 0.2 to 0.7 CPU seconds a node, about 450 nodes. Nodes that no place inside the frame depends
    on repeat a neighbour.
    """
    n = f_number or lens.copy.f_number
    reach = round(1.0 / step) + 1
    axis = np.arange(-reach, reach + 1, dtype=np.float64) * step
    count = axis.size
    kernels = np.zeros((len(CHANNELS), count, count, size, size), dtype=np.float16)
    centers = np.zeros((len(CHANNELS), count, count, 2), dtype=np.float32)
    radius = np.hypot(*np.meshgrid(axis, axis))
    traced = [(int(i), int(j)) for i, j in np.argwhere(radius <= 1.0 + 1.5 * step)]
    stop, limits = lens.stop_radius(n), lens.limits
    misfit = 0.0
    for done, (i, j) in enumerate(traced, start=1):
        h = (float(axis[j]), float(axis[i]))
        pupils = lens.pupils_of_all(h, n)
        if radius[i, j] <= 1.0:
            misfit = max(misfit, *(p.residual_um / wave for c in CHANNELS for p, wave, _ in pupils[c]))
        middles = []
        for c, channel in enumerate(CHANNELS):
            kernel, middle = kernel_of(
                pupils[channel], stop, limits, size=size, pitch_um=pitch_um, focus_um=lens.sensor_um(h)
            )
            kernels[c, i, j] = kernel.astype(np.float16)
            middles.append(np.array(middle))
        centers[:, i, j] = (np.array(middles) - middles[1]) / pitch_um
        on_step(done, len(traced))
    known = np.array(traced)
    for i, j in np.argwhere(radius > 1.0 + 1.5 * step):
        near = known[np.argmin(np.hypot(*(known - (i, j)).T))]
        for values in (kernels, centers):
            values[:, i, j] = values[:, near[0], near[1]]
    facts = {
        **asdict(lens.copy),
        "source": designs.create(lens.copy.design).source,
        "widest": lens.copy.f_number,
        "f_number": n,
        "focal_mm": lens.focal_mm,
        "pitch_um": pitch_um,
        "half_diagonal_mm": lens.copy.half_diagonal_mm,
        "path_misfit_waves": misfit,
    }
    return GridField(axis, kernels, centers, facts)


def interpolation_error(
    lens: TracedLens, grid: GridField, places: int, rng: np.random.Generator
) -> list[float]:
    """Relative L2 distance between the grid's answer and the exact PSF at random places of the frame."""
    found = []
    for _ in range(places):
        place = FieldPosition(math.sqrt(rng.random()), float(rng.uniform(-math.pi, math.pi)))
        channel = CHANNELS[int(rng.integers(3))]
        exact = lens.kernel(place, channel, grid.size, f_number=grid.f_number, pitch_um=grid.pitch_um)
        found.append(distance(grid.kernel_at(place, channel, grid.size), exact).rel_l2)
    return found
