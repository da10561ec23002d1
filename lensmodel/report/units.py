"""Frequencies in the units that people use: cycles/pixel, line pairs per picture height and per mm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

Unit = Literal["c/px", "lp/ph", "lp/mm"]
UNIT_NAMES: Final[dict[Unit, str]] = {"c/px": "c/px", "lp/ph": "LP/PH", "lp/mm": "lp/mm"}

NYQUIST: Final = 0.5
"""Cycles/pixel: beyond it a sensor shows no finer lines, and a measured MTF50 says only "at least"."""


@dataclass(frozen=True, slots=True)
class SensorGeometry:
    """What turns cycles/pixel into other units.

    Parameters
    ----------
    pixel_pitch_um : float or None
        Micrometres from pixel to pixel.
    height_px : int or None
        Pixels of the shorter side of the picture.
    """

    pixel_pitch_um: float | None = None
    height_px: int | None = None

    def factor(self, unit: Unit) -> float | None:
        """What a value in cycles/pixel is multiplied with; None where the sensor is not known well enough.

        A pixel is 1/H of the picture's height H, and p/1000 mm wide::

            LP/PH = H f,    lp/mm = 1000 f / p
        """
        if unit == "lp/mm":
            return None if self.pixel_pitch_um is None else 1000.0 / self.pixel_pitch_um
        if unit == "lp/ph":
            return None if self.height_px is None else float(self.height_px)
        return 1.0

    @property
    def units(self) -> tuple[Unit, ...]:
        """The units that are known."""
        return tuple(unit for unit in UNIT_NAMES if self.factor(unit) is not None)

    def words(self, frequency: float, unit: Unit = "c/px") -> str:
        """Write a frequency given in cycles/pixel; beyond the Nyquist frequency only "at least" it."""
        factor = self.factor(unit)
        if factor is None:
            return "unknown"
        value = min(frequency, NYQUIST) * factor
        digits = f"{value:.3f}".removeprefix("0") if unit == "c/px" else f"{value:.0f}"
        return f"at least {digits}" if frequency >= NYQUIST else digits
