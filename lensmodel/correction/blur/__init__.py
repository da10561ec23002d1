"""Forward models of lens blur with their adjoints."""

from __future__ import annotations

from lensmodel.correction.blur.operator import BlurOperator, crop_to_support, support_radius
from lensmodel.correction.blur.uniform import Drift, UniformBlur

__all__ = [
    "BlurOperator",
    "Drift",
    "UniformBlur",
    "crop_to_support",
    "support_radius",
]
