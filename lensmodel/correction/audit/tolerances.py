"""How much of each figure is allowed before a check holds something back."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from lensmodel.core.files import fitted

LIMITS: Final[Mapping[str, float]] = MappingProxyType(fitted("correction")["limits"])
"""Limit of each check, in the unit of its own equation.

`python -m lab.correction.audit_table --limits` prints the limits at which less than a tenth of
every sound block is held back. The first 347, of half the photographs, needed 0.29 by dark, 0.645, 1.01,
1.39, 1.49, 3.3, 4.8, 13.0, 0.82 and 3.1 in this order. The limits lie a quarter above, since a dozen
photographs are not all. Re-blur is newer: all but one of 152 sound blocks that got their texture back needed
at most 1.15, yet a limit of 1.4 held back a third of sound corrections around clipped lamps; 2.6 holds back
none of them. Spectrum: points of light have a flat one, which in the higher band lies at 5.5 by the predicted
slope; lights at night reach 8.3, where chance leaves the lower band less.
"""

MOSAIC: Final[Mapping[str, float]] = MappingProxyType(fitted("correction")["mosaic"])
"""Factor on the limit for a mosaic.

There two colours of three at each pixel are means of neighbours, so that the photo shows less light and dark
and fewer hues than the sensor saw. Of the same 152 blocks those of planes needed 0.17, 0.50, 0.41 and 0.93 at
most in this order, those of mosaics 0.31, 1.29, 2.4 and 2.9.
"""


def limit(check: str, *, mosaic: bool) -> float:
    """Limit of a check, of planes or of a mosaic."""
    return LIMITS[check] * (MOSAIC.get(check, 1.0) if mosaic else 1.0)
