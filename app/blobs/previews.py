"""The r-map of a developed photo, upright, for the pages; made once, when it is developed."""

from __future__ import annotations

import io
from typing import Final

import numpy as np
from PIL import Image

from lensmodel.patches import r_map
from lensmodel.photo import LinearPhoto, upright

SIDE: Final = 1600
"""Longer side of the picture in pixels at most (chosen): fills a usual screen."""


def confidence_map(developed: LinearPhoto) -> bytes:
    """Render the r-map of the green plane as a PNG: bright at informative edges."""
    step = _step(developed)
    values = r_map(np.ascontiguousarray(developed.planes[1][::step, ::step]))
    scaled = (255 * np.clip(values / max(float(np.quantile(values, 0.99)), 1e-6), 0, 1)).astype(np.uint8)
    heat = np.stack([scaled, scaled // 2, np.zeros_like(scaled)], axis=-1)
    out = io.BytesIO()
    turned = upright(heat, developed.encoding.orientation)
    Image.fromarray(np.ascontiguousarray(turned)).save(out, "PNG", compress_level=3)
    return out.getvalue()


def _step(developed: LinearPhoto) -> int:
    short, long = sorted((developed.frame.height, developed.frame.width))
    return min(-(-long // SIDE), short // 2)  # at least two rows of a panorama
