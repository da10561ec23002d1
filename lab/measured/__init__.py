"""How well each way of measuring a PSF does, on simulated photos whose truth is known."""

from lab.measured.run import KINDS, WayResult, measured, table
from lab.measured.shots import Bench, camera_of, take, third_order, traced

__all__ = ["KINDS", "Bench", "WayResult", "camera_of", "measured", "table", "take", "third_order", "traced"]
