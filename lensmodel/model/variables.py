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

FALLBACK: Final[Mapping[str, float]] = {
    "aperture_stops": 0.5,
    "wavelength_nm": 20.0,  # red and green differ by 70 nm: 0.2 percent of each other's weight
    "focal_octaves": 0.25,
    "focus_dioptres": 0.5,
}
"""Bandwidths of settings that do not vary among the samples, and upper limits of those that do."""

_CENTER_R = 0.25  # half-diagonals: inside, directions fade, since at the centre there is none (chosen)
_FLOOR_R, _FLOOR_PHI = 0.02, 0.12  # least bandwidths: blur does not change faster over the field (chosen)
_SAME = 1e-6  # equal values have a spread of rounding errors, not of zero
_PLACE_SHARE = 0.45  # of eq. 8: the rule is for densities, a smooth regression wants less


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


def reference_bandwidth(sigma: float, dimensions: int, count: int) -> float:
    """Bandwidth by the normal reference rule, h = sigma (4 / ((d + 2) n))^(1 / (d + 4)), eq. (8)."""
    return sigma * (4.0 / ((dimensions + 2) * max(count, 1))) ** (1.0 / (dimensions + 4))


def bandwidths(where: NDArray[np.float64]) -> dict[str, float]:
    """Bandwidths of place and settings by eq. (8), apart from those of (u, v).

    n counts PSF samples of one channel, not their pixels: a million pixels of one PSF say nothing
    about another place. d counts the place and those settings that vary.
    """
    _, counts = np.unique(where[:, 4], return_counts=True)
    varying = [3, 5, 6]
    spread = {column: float(np.nanstd(_known(where[:, column]))) for column in varying}
    d = 2 + sum(value > _SAME for value in spread.values())
    n = int(counts.max())
    bandwidths = {
        "r": max(_PLACE_SHARE * reference_bandwidth(float(where[:, 0].std()), d, n), _FLOOR_R),
        "phi": max(_PLACE_SHARE * reference_bandwidth(math.sqrt(0.5), d, n), _FLOOR_PHI),
        **FALLBACK,
    }
    for column, sigma in spread.items():
        name = COLUMNS[column]
        if sigma > _SAME:
            bandwidths[name] = min(FALLBACK[name], reference_bandwidth(sigma, d, n))
    return bandwidths


def support_widths(widths: Mapping[str, float]) -> dict[str, float]:
    """Bandwidths of eq. (8) itself: by them one tells near from far, whatever smoothing is best."""
    return {**widths, "r": widths["r"] / _PLACE_SHARE, "phi": widths["phi"] / _PLACE_SHARE}


def scales(widths: Mapping[str, float]) -> NDArray[np.float64]:
    """Bandwidths in the order of `COLUMNS`, shape (7,)."""
    return np.array([widths[name] for name in COLUMNS])


def gaps(
    where: NDArray[np.float64], asked: NDArray[np.float64], scale: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Differences of points `(n, d)` from one point `(d,)` in bandwidths; 0 where either is unknown."""
    gaps = (where - asked) / scale
    gaps[np.isnan(gaps)] = 0.0
    return np.asarray(gaps)


def squared_distances(
    where: NDArray[np.float64], asked: NDArray[np.float64], scale: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Squared distances in bandwidths of points `(n, 7)` from one point `(7,)`; unknowns drop out."""
    gap = gaps(where, asked, scale)
    return np.asarray((gap * gap).sum(axis=-1))


def _known(values: NDArray[np.float64]) -> NDArray[np.float64]:
    known = values[~np.isnan(values)]
    return known if known.size else np.zeros(1)
