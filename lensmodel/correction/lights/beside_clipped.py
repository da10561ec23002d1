"""Limit results beside clipped light to the range and the hues that the photo shows nearby."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.types import Planes
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.blur.compiled_uniform import CompiledBlur
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.engine import compiled
from lensmodel.correction.lights.clipped import span_around
from lensmodel.correction.lights.saturation import closed, compact, far, positive
from lensmodel.correction.limits.hue import of_known_hue

_UNSURE, _NEAREST, _NEXT = 0.1, 2, 1
"""Error of a kernel at and above which the glow of a light is left alone; how many pixels are then nearby for
the least light, and for the most: specks in a dark glow are seen, darker twigs are not (chosen). An error of
0.1 of a light ten times beyond saturation is as bright as white."""

_EVEN: Final = 1.5
"""Standard deviation in pixels of the means that decide where light comes from: pixel by pixel, noise and the
mosaic would decide, and edges of clipped areas would get ragged (chosen)."""

_BRIGHTER: Final = np.float32(4.0)
"""Brightness of a broad clipped area, in units of saturation: sunlit paint and white skies (chosen)."""

_FADE: Final = 3
"""Pixels over which the bounds end (chosen: at once would draw an edge of its own, wider would bind places
that no light reaches)."""


def held_beside_clipped(
    photo: Planes,
    restored: Planes,
    blurs: Sequence[UniformBlur],
    sensors: Sequence[Sensor],
    errors: Sequence[float],
) -> Planes:
    """Hold a result within the photo's range and hues wherever clipped light reaches.

    How much light a clipped pixel had is not known, and a wrong guess does the worst that a correction can do
    to its neighbours: dark rings and pixels of another colour. So within the kernel's reach of a clipped
    pixel each colour stays between the least and the most that the photo shows nearby, and so does its share
    of the light of all colours. Nearby means within the kernel's reach where the kernel is certain, so that
    the glow of a lamp can be removed; where it is not, it means two pixels for the least and one for the
    most. Clipped areas too broad to be a light spread by the lens stay as they are. Where the kernel is
    uncertain, a pixel keeps its value to the extent that its light comes from such areas.

    Parameters
    ----------
    photo, restored : Planes, shape (channels, rows, cols)
        A tile, and its correction.
    blurs, sensors : sequence
        By colour.
    errors : sequence of float
        Expected relative L2 errors of the kernels.
    """
    clipped = np.stack([closed(p >= np.float32(s.clip)) for p, s in zip(photo, sensors, strict=True)])
    if not clipped.any():
        return restored
    reach = max(far(blur) for blur in blurs)
    anywhere = np.asarray(clipped.any(axis=0))
    rows, cols = (span_around(anywhere, axis, 2 * reach + _FADE + 1) for axis in (0, 1))
    box = (slice(None), rows, cols)
    observed, corrected, lost = photo[box], restored[box].copy(), clipped[box]
    broad = np.stack([mask & ~compact(mask, reach) for mask in lost])
    np.copyto(corrected, observed, where=broad)
    near, next_to = (
        max(round(reach * (1.0 - max(errors) / _UNSURE)), min(n, reach)) for n in (_NEAREST, _NEXT)
    )
    window, bright_window = ((1, 2 * n + 1, 2 * n + 1) for n in (near, next_to))
    low = np.minimum(ndimage.minimum_filter(observed, window, mode="nearest"), observed)
    high = np.where(lost, np.float32(np.inf), ndimage.maximum_filter(observed, bright_window, mode="nearest"))
    held = np.clip(corrected, low, high)
    if len(observed) > 1:
        noise = np.stack([s.variance(p) for p, s in zip(observed, sensors, strict=True)])
        held = np.clip(of_known_hue(observed, held, anywhere[rows, cols], noise, window), low, high)
    trust = 1.0 - min(max(errors) / _UNSURE, 1.0) * _stray_share(broad, observed, blurs, sensors)
    held = np.where(broad, observed, observed + trust * (held - observed))
    distance = ndimage.distance_transform_cdt(~anywhere[rows, cols], "chessboard")
    share = np.clip((reach + _FADE - distance) / np.float32(_FADE), 0.0, 1.0).astype(np.float32)
    result = restored.copy()
    result[box] = restored[box] + share * (held - restored[box])
    return result


def _stray_share(
    broad: NDArray[np.bool_], photo: Planes, blurs: Sequence[UniformBlur], sensors: Sequence[Sensor]
) -> NDArray[np.float32]:
    """Share of each pixel's light that may come from broad clipped areas, the most of all colours, 0 to 1."""
    share = np.zeros(photo.shape[1:], dtype=np.float32)
    for mask, plane, blur, sensor in zip(broad, photo, blurs, sensors, strict=True):
        if mask.any():
            light = np.float32(sensor.clip) * np.pad(mask.astype(np.float32), blur.reach, mode="edge")
            spread = CompiledBlur.of(positive(blur), compiled("auto")).forward(light)
            spread, lit = (ndimage.gaussian_filter(p, _EVEN, mode="nearest") for p in (spread, plane))
            share = np.maximum(share, _BRIGHTER * spread / np.maximum(lit, np.float32(1e-6)))
    return np.clip(share, 0.0, 1.0)
