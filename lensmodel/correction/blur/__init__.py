"""Forward models of lens blur with their adjoints."""

from __future__ import annotations

from lensmodel.correction.blur.flow import EfficientFilterFlow
from lensmodel.correction.blur.operator import BlurOperator, crop_to_support, support_radius
from lensmodel.correction.blur.uniform import Drift, UniformBlur
from lensmodel.correction.blur.windows import bartlett_hann, partition

__all__ = [
    "BlurOperator",
    "Drift",
    "EfficientFilterFlow",
    "UniformBlur",
    "bartlett_hann",
    "crop_to_support",
    "partition",
    "support_radius",
]
