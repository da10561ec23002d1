"""What lies near clipped light: how far its unknown strength reaches, and how a correction ends there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.blur import UniformBlur
from lensmodel.types import Kernel, Planes

_FADE_PX = 4.0
_RING_REACH = 4.0  # kernel radii about clipped light in which a dark ring is looked for
_DARKEST = np.float32(0.6)  # share of the darkest pixel of the photo nearby that the result keeps there


def light_radius(kernel: Kernel, share: float) -> float:
    """Radius in pixels of the circle about the kernel's middle that holds `share` of its light."""
    half = kernel.shape[0] // 2
    rows, cols = np.ogrid[-half : half + 1, -half : half + 1]
    distance = np.hypot(rows, cols).ravel()
    order = np.argsort(distance, kind="stable")
    light = np.cumsum(kernel.ravel()[order])
    return float(distance[order][min(int(np.searchsorted(light, share * light[-1])), distance.size - 1)])


def spoilt(clipped: NDArray[np.bool_], blurs: Sequence[UniformBlur]) -> NDArray[np.bool_]:
    """Pixels that got most of what a point at a clipped pixel spreads; shape (n, h, w) as `clipped`.

    How bright a clipped light is, the data do not say. Taken as data, the pixels around it would force
    the latent picture to guess, and a wrong guess rings.
    """
    return np.stack(
        [
            ndimage.distance_transform_edt(~plane) <= light_radius(blur.kernel, 0.9) if plane.any() else plane
            for plane, blur in zip(clipped, blurs, strict=True)
        ]
    )


def faded_to(
    photo: Planes, restored: Planes, clipped: NDArray[np.bool_], blurs: Sequence[UniformBlur]
) -> Planes:
    """End the correction where the light of clipped pixels reaches: the photo there, in all colours alike."""
    anywhere = clipped.any(axis=0)
    if not anywhere.any():
        return restored
    inner = max(light_radius(blur.kernel, 0.99) for blur in blurs) + 1.0
    distance = ndimage.distance_transform_edt(~anywhere)
    share = np.clip((distance - inner) / _FADE_PX, 0.0, 1.0)
    # What is left of a ring is a dark one: no scene is that much darker than its blur so near a light.
    darkest = ndimage.minimum_filter(photo, (1, 5, 5), mode="nearest")
    near = distance <= _RING_REACH * inner
    restored = np.where(near, np.maximum(restored, _DARKEST * darkest), restored)
    return np.asarray(photo + share.astype(np.float32) * (restored - photo), dtype=np.float32)
