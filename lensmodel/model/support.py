"""How far a question lies from the samples, in units in which a PSF changes by about as much.

    d^2 = |p - p_i|^2 / 0.2^2 + (stops apart)^2 + (octaves of focal length apart / 0.5)^2
          + (dioptres of focus distance apart / 0.5)^2,        p = r (cos phi, sin phi)

A setting that is unknown, in the question or in the sample, drops out of the sum. The units do not shrink as
samples come, as bandwidths do: what is near stays near.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import PsfSample
from lensmodel.core.types import FieldPosition, LensSettings

VARIABLES: Final = ("place", "aperture_stops", "focal_octaves", "focus_dioptres")
UNITS: Final = np.array([0.2, 0.2, 1.0, 0.5, 0.5])
"""Of x, y, stops, octaves and dioptres (chosen: kernels of usual lenses differ by 0.1 to 0.2 over each)."""

FAR: Final = 2.5  # units: a Gaussian has fallen to 0.04 there (chosen)


@dataclass(frozen=True, slots=True)
class Support:
    """Distance to the nearest sample, and in which variables all samples are far."""

    nearest: float
    beyond: tuple[str, ...]


def point(position: FieldPosition, settings: LensSettings) -> NDArray[np.float64]:
    """Place and settings in units, shape (5,): x, y, stops, octaves, dioptres; NaN = unknown."""
    stops, focal, focus = settings.stops, settings.focal_mm, settings.focus_m
    return (
        np.array(
            [
                *position.xy,
                math.nan if stops is None else stops,
                math.nan if focal is None else math.log2(focal),
                math.nan if focus is None else 1.0 / focus,
            ]
        )
        / UNITS
    )


def points(samples: Sequence[PsfSample]) -> NDArray[np.float64]:
    """Points of samples, shape (n, 5)."""
    return np.array([point(s.position, s.settings) for s in samples]).reshape(-1, len(UNITS))


def support(where: NDArray[np.float64], asked: NDArray[np.float64]) -> Support:
    """Measure how far a point lies from others `(n, 5)`."""
    gaps = np.abs(where - asked)
    gaps[np.isnan(gaps)] = 0.0
    each = np.concatenate([np.hypot(gaps[:, :1], gaps[:, 1:2]), gaps[:, 2:]], axis=1)
    distance = np.sqrt((each**2).sum(axis=1))
    nearest = int(distance.argmin())
    beyond = [name for name, least in zip(VARIABLES, each.min(axis=0), strict=True) if least > FAR]
    if not beyond and distance[nearest] > FAR:
        beyond = [VARIABLES[int(each[nearest].argmax())]]
    return Support(float(distance[nearest]), tuple(beyond))
