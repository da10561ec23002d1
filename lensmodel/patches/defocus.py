"""Tell blur of the scene and of the hand from blur of the lens, as far as one photo allows."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.patches.windows import Windows

RINGS: Final = 8
ENVELOPE_PERCENTILE: Final = 15.0
ENVELOPE_RATIO: Final = 1.25
CORNER_ALLOWANCE: Final = 0.2
"""The allowed ratio grows with r²: copies of a lens differ, and a decentred one is not out of focus."""
GROWTH: Final = 4.0
QUARTER_ALLOWANCE: Final = 1.2
"""A quarter of a window has fewer edges, its width a larger error."""
SHARP_PX: Final = 0.6
"""Edges of a sharp photo measure about this wide; below it the width says nothing."""
MIN_IN_RING: Final = 4

MOTION_LIMIT: Final = 0.45
MIN_FOR_MOTION: Final = 6


def width_envelope(windows: Windows) -> NDArray[np.float64]:
    """Smallest consistent edge width at each window's r.

    Defocus can only widen, so that the lower envelope over a ring of the field is the width of
    the lens in focus. The rings' 15th percentiles become an envelope by two facts about lenses:
    it does not fall outwards, so that a ring holds at most what every ring further out holds;
    and it grows by no more than the factor 1 + 4 r², so that a background far out of focus does
    not pass for a soft corner.

    Returns
    -------
    ndarray of float64, shape (n,)
        In pixels, at least `SHARP_PX`; infinite where no ring has enough edges.
    """
    known = np.isfinite(windows.width)
    ring = np.minimum((windows.r * RINGS).astype(np.intp), RINGS - 1)
    members = [windows.width[known & (ring == k)] for k in range(RINGS)]
    used = [k for k in range(RINGS) if members[k].size >= MIN_IN_RING]
    if not used:
        return np.full(len(windows), np.inf)
    low = np.array([np.percentile(members[k], ENVELOPE_PERCENTILE) for k in used])
    level = np.maximum(np.minimum.accumulate(low[::-1])[::-1], SHARP_PX)
    centres = (np.array(used) + 0.5) / RINGS
    most = level[0] * (1.0 + GROWTH * windows.r**2)
    return np.minimum(np.interp(windows.r, centres, level), most)


def defocus_excess(windows: Windows) -> NDArray[np.float64]:
    """Width over the envelope's limit: above 1 the window counts as defocused; 0 where unknown."""
    envelope = width_envelope(windows)
    limit = envelope * ENVELOPE_RATIO * (1.0 + CORNER_ALLOWANCE * windows.r**2)
    worst = np.fmax(windows.width, windows.widest / QUARTER_ALLOWANCE)
    return np.nan_to_num(worst / limit)


def motion(windows: Windows) -> tuple[float, float]:
    """Elongation of the blur that all windows share in image axes, and its direction in degrees.

    The blur of a lens turns with the field, that of the hand does not. The relative elongation
    vectors (over twice the angle) are fitted by a constant plus a term that turns with phi::

        e_i = c + k r_i² (cos 2 phi_i, -sin 2 phi_i)

    Returns
    -------
    tuple of float
        |c|, 0 where fewer than `MIN_FOR_MOTION` windows tell, and the direction counter-clockwise
        from the right, -90 to 90.
    """
    known = np.any(windows.elongation != 0.0, axis=1)
    if int(known.sum()) < MIN_FOR_MOTION:
        return 0.0, 0.0
    e = windows.elongation[known]
    square, double = windows.r[known] ** 2, 2.0 * windows.phi[known]
    # Image axes have rows growing downwards, phi grows towards row 0: hence the minus.
    turning = np.stack([square * np.cos(double), -square * np.sin(double)], axis=1)
    ones, zeros = np.ones_like(square), np.zeros_like(square)
    basis = np.concatenate(
        [
            np.stack([ones, zeros, turning[:, 0]], axis=1),
            np.stack([zeros, ones, turning[:, 1]], axis=1),
        ]
    )
    target = np.concatenate([e[:, 0], e[:, 1]])
    fit = np.linalg.lstsq(basis, target, rcond=None)[0]
    return math.hypot(fit[0], fit[1]), -math.degrees(math.atan2(fit[1], fit[0])) / 2.0
