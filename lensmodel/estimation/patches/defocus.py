"""Tell blur of the scene and of the hand from blur of the lens, as far as one photo allows."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.estimation.patches.blocks import BLOCKS_A_SIDE
from lensmodel.estimation.patches.windows import Windows

RINGS: Final = 8
"""Of equal width in r: blur changes little within one, and each holds windows enough (chosen)."""
ENVELOPE_PERCENTILE: Final = 15.0
"""Of a ring's widths, see `width_envelope`: lower is a single window's error, higher needs more of the photo
in focus (chosen)."""
ENVELOPE_RATIO: Final = 1.25
"""Of width to envelope, above which a window is defocused: widths scatter by some of it in focus, and a
quarter wider harms a kernel (chosen)."""
CORNER_ALLOWANCE: Final = 0.2
"""The allowed ratio grows with r²: copies of a lens differ, and a decentred one is not out of focus."""
GROWTH: Final = 4.0
"""Of the envelope with r², see `width_envelope`: corners five times as wide as the centre are as bad as
lenses get (chosen)."""
SURFACE_LIMIT: Final = 0.19
"""Of the log width, see `smooth_widths`: less and no real photo is smooth, more and depths pass for a lens
(chosen)."""
JUMP_SHARE: Final = 0.5
"""Of the range of log widths, see `smooth_widths`: a slope takes a sixth of it, a step of depth all
(chosen)."""
SURFACE_STEPS: Final = 12  # of reweighting, each a small system: later ones change less (chosen)
MIN_FOR_SURFACE: Final = 40  # windows, for six coefficients: fewer let a surface follow the scene (chosen)
QUARTER_ALLOWANCE: Final = 1.2
"""A quarter of a window has fewer edges, its width a larger error: 1 would call windows defocused by chance
(chosen)."""
SHARP_PX: Final = 0.6
"""Edges of a sharp photo measure about this wide; a smaller width carries no information."""
MIN_IN_RING: Final = 4  # windows (chosen): fewer have no median worth the name

MOTION_LIMIT: Final = 0.45
"""Relative elongation above which `select` warns: that of a lens averages out over the field, a scene of one
direction has some (chosen)."""
MIN_FOR_MOTION: Final = 6  # windows: twice the three unknowns of the fit (chosen)


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


def smooth_widths(windows: Windows) -> NDArray[np.float64]:
    """Widths that a decentred or tilted lens would have, NaN where the photo does not look like one.

    Such a lens is soft on one side, which the rings of `width_envelope` would take for defocus.
    But its blur changes smoothly over the field, while a scene has depth steps. So the logarithm
    of the width is fitted by a quadratic surface, robustly. The surface is accepted if four
    windows in five follow it to within 19 percent, and if the width does not jump: over a sixth
    of the frame, 95 of 100 changes stay below half of the range that it has in the photo.

    Returns
    -------
    ndarray of float64, shape (n,)
        In pixels.
    """
    known = np.isfinite(windows.width)
    if int(known.sum()) < MIN_FOR_SURFACE:
        return np.full(len(windows), np.nan)
    x, y = windows.r * np.cos(windows.phi), windows.r * np.sin(windows.phi)
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    target, part = np.log(np.maximum(windows.width[known], SHARP_PX)), basis[known]
    weight = np.ones_like(target)
    residual = target
    for _ in range(SURFACE_STEPS):
        fit = np.linalg.lstsq(part * weight[:, None], target * weight, rcond=None)[0]
        residual = np.abs(target - part @ fit)
        # Least absolute deviations by reweighting; the floor is the measurement error.
        weight = 1.0 / np.sqrt(np.maximum(residual, 0.03))
    believed = float(np.quantile(residual, 0.8)) < SURFACE_LIMIT and not _jumps(windows)
    return np.exp(basis @ fit) if believed else np.full(len(windows), np.nan)


def _jumps(windows: Windows) -> bool:
    rows, row_at = np.unique(windows.rows, return_inverse=True)
    cols, col_at = np.unique(windows.cols, return_inverse=True)
    grid = np.full((rows.size, cols.size), np.nan)
    grid[row_at, col_at] = np.log(np.maximum(windows.width, SHARP_PX))
    lag = max(BLOCKS_A_SIDE, cols.size // 6)
    steps = np.abs(
        np.concatenate([(grid[lag:] - grid[:-lag]).ravel(), (grid[:, lag:] - grid[:, :-lag]).ravel()])
    )
    steps = steps[np.isfinite(steps)]
    if steps.size < MIN_FOR_SURFACE:
        return True
    low, high = np.nanquantile(grid, (0.1, 0.9))
    return float(np.quantile(steps, 0.95)) > JUMP_SHARE * float(high - low)


def defocus_excess(windows: Windows) -> NDArray[np.float64]:
    """Width over the envelope's limit: above 1 the window counts as defocused; 0 where unknown."""
    envelope = np.fmax(width_envelope(windows), smooth_widths(windows))
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
