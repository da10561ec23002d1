"""Previews of a developed photo, upright, for the pages; made once, when it is developed."""

from __future__ import annotations

import io
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lensmodel.patches import r_map
from lensmodel.photo import LinearPhoto, shown, upright

SIDE: Final = 1600
"""Longer side of a preview in pixels at most (chosen): fills a usual screen."""


def preview(developed: LinearPhoto) -> bytes:
    """Render a whole photo as JPEG."""
    step = _step(developed)
    planes = developed.planes
    height, width = planes.shape[1] // step * step, planes.shape[2] // step * step
    mean = planes[:, :height, :width].reshape(3, height // step, step, width // step, step).mean(axis=(2, 4))
    picture = shown(np.ascontiguousarray(mean, dtype=np.float32), developed.encoding)
    return _encoded(picture, developed, "JPEG", quality=85)


def confidence_map(developed: LinearPhoto) -> bytes:
    """Render the r-map of the green plane as a PNG of the preview's shape: bright at informative edges."""
    step = _step(developed)
    values = r_map(np.ascontiguousarray(developed.planes[1][::step, ::step]))
    scaled = (255 * np.clip(values / max(float(np.quantile(values, 0.99)), 1e-6), 0, 1)).astype(np.uint8)
    heat = np.stack([scaled, scaled // 2, np.zeros_like(scaled)], axis=-1)
    return _encoded(heat, developed, "PNG", compress_level=3)


def _step(developed: LinearPhoto) -> int:
    short, long = sorted((developed.frame.height, developed.frame.width))
    return min(-(-long // SIDE), short // 2)  # at least two rows of a panorama


def _encoded(picture: NDArray[np.uint8], developed: LinearPhoto, kind: str, **options: Any) -> bytes:  # noqa: ANN401 - of PIL
    turned = upright(picture, developed.encoding.orientation)
    out = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(turned)).save(out, kind, **options)
    return out.getvalue()
