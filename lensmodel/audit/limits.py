"""How much of each figure is allowed before a check holds something back."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

LIMITS: Final[Mapping[str, float]] = MappingProxyType(
    {
        "too dark": 0.3,
        "too bright": 0.75,
        "isolated pixels": 8.0,
        "hue": 1.0,
        "re-blur": 2.0,
        "spectrum": 3.0,
        "comb": 10.0,
        "ringing": 0.5,
        "grain": 3.0,
    }
)
"""Limit of each check, in the unit of its own equation."""
