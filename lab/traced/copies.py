"""Copies of the designs that the project is developed on.

Shifts of 14 to 29 micrometres and tilts of up to 0.07 degrees of one or two elements, and a sensor tilted
by 7 to 20 micrometres over half the diagonal, make the highest and the lowest peak of one lens's corners
differ by a factor of 1.2 to 2, and hardly in the aspheric one (chosen: tested copies differ by up to two,
and no table of faults is public). The samples are opened by a quarter of a stop to more than a stop beyond
their own aperture, as far as they form an image there; patented lenses that are fast already stay near
theirs, on a larger sensor.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import Final

from lab.traced.lens import Copy
from lab.traced.rays import Fault

copies: Final = MappingProxyType(
    {
        "heliar": Copy(
            "heliar",
            3.5,
            faults=(Fault(1, (18.0, -9.0), (0.03, 0.02)),),
            sensor_tilt_um=(6.0, -4.0),
            corner_light=0.55,
        ),
        "telephoto": Copy(
            "telephoto",
            5.0,
            faults=(Fault(1, (-14.0, 20.0), (-0.02, 0.04)),),
            sensor_tilt_um=(-5.0, 8.0),
            corner_light=0.6,
        ),
        "reverse-telephoto": Copy(
            "reverse-telephoto",
            4.5,
            faults=(Fault(3, (25.0, 15.0), (0.05, -0.05)),),
            sensor_tilt_um=(12.0, 16.0),
            corner_light=0.45,
        ),
        "field-corrector": Copy(
            "field-corrector",
            3.0,
            faults=(Fault(1, (10.0, -12.0), (0.02, 0.02)),),
            sensor_tilt_um=(8.0, 5.0),
            corner_light=0.45,
        ),
        "tronnier": Copy(
            "tronnier",
            1.8,
            faults=(Fault(1, (16.0, 10.0), (0.04, -0.03)), Fault(-1, (-10.0, 12.0))),
            sensor_tilt_um=(8.0, -6.0),
            corner_light=0.4,
        ),
        "retrofocus": Copy(
            "retrofocus",
            2.0,
            faults=(Fault(2, (12.0, 8.0), (0.03, -0.02)),),
            sensor_tilt_um=(8.0, -6.0),
            corner_light=0.35,
        ),
        "aspheric": Copy(
            "aspheric",
            1.84,
            half_diagonal_mm=14.2,
            faults=(Fault(3, (12.0, -8.0), (0.03, 0.03)),),
            sensor_tilt_um=(-8.0, 6.0),
            corner_light=0.3,
        ),
        "noct": Copy(
            "noct",
            1.2,
            half_diagonal_mm=19.3,
            faults=(Fault(2, (12.0, -9.0), (0.02, -0.03)),),
            sensor_tilt_um=(6.0, 9.0),
            corner_light=0.3,
        ),
    }
)
"""Copies by name."""
