"""The variables that a PSF depends on besides (u, v), and distances between their values.

    d^2 = ((r - r_i) / h_r)^2 + |c(phi) - c(phi_i)|^2 / h_phi^2 + sum over the settings

with c on the unit circle, so that pi and -pi are neighbours: |c - c_i| is the chord 2 sin(d/2).
Near the centre of the image all angles are neighbours, so the circle shrinks with r there. A
setting that is unknown, in the question or in the sample, drops out of the sum.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import PsfSample
from lensmodel.core.types import WAVELENGTH_NM, FieldPosition, LensSettings

COLUMNS: Final = ("r", "phi", "phi", "aperture_stops", "wavelength_nm", "focal_octaves", "focus_dioptres")
"""The variable that each column of a point belongs to; phi takes two, cosine and sine."""

_CENTER_R = 0.25  # half-diagonals: inside, directions fade, since at the centre there is none (chosen)


def point(position: FieldPosition, settings: LensSettings) -> NDArray[np.float64]:
    """Coordinates of a place and settings, shape (7,), in the order of `COLUMNS`; NaN = unknown."""
    share = min(position.r / _CENTER_R, 1.0)
    stops, focal, focus = settings.stops, settings.focal_mm, settings.focus_m
    return np.array(
        [
            position.r,
            share * math.cos(position.phi),
            share * math.sin(position.phi),
            math.nan if stops is None else stops,
            WAVELENGTH_NM[settings.channel],
            math.nan if focal is None else math.log2(focal),
            math.nan if focus is None else 1.0 / focus,
        ]
    )


def points(samples: Sequence[PsfSample]) -> NDArray[np.float64]:
    """Coordinates of samples, shape (n, 7)."""
    return np.array([point(s.position, s.settings) for s in samples]).reshape(len(samples), len(COLUMNS))


def vectors(where: NDArray[np.float64]) -> NDArray[np.float64]:
    """(x, y) to the right and up, in half-diagonals, of points `(n, 7)`, shape (n, 2)."""
    r = where[:, :1]
    return np.asarray(where[:, 1:3] * (r / np.minimum(np.maximum(r, 1e-30) / _CENTER_R, 1.0)))


def scales(widths: Mapping[str, float]) -> NDArray[np.float64]:
    """Bandwidths in the order of `COLUMNS`, shape (7,)."""
    return np.array([widths[name] for name in COLUMNS])


def squared_distances(
    where: NDArray[np.float64], asked: NDArray[np.float64], scale: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Squared distances in bandwidths of points `(n, 7)` from one point `(7,)`; unknowns drop out."""
    gap = (where - asked) / scale
    gap[np.isnan(gap)] = 0.0
    return np.asarray((gap * gap).sum(axis=-1))
