"""Two copies of a lens, or two apertures of one, beside each other."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

from lensmodel.core.types import ZONES, Zone
from lensmodel.report.lens_report import ApertureReport

SURE: Final = 2.0
"""Standard errors by which two places must differ to be called different (chosen: chance
does it in one of twenty)."""

_ALIKE: Final = 0.05
"""Share by which zones may differ and still be called alike: less is not seen (chosen)."""

_NAMES: Final[dict[Zone, str]] = {"center": "in the centre", "mid": "halfway out", "corner": "in the corners"}


@dataclass(frozen=True, slots=True)
class Side:
    """One of two that are compared: what to call it, what was found, and what that rests on."""

    name: str
    found: ApertureReport
    facts: str = ""


@dataclass(frozen=True, slots=True)
class ZoneChange:
    """How the second differs from the first in one zone: MTF50 in cycles/pixel."""

    zone: Zone
    first: float
    second: float
    error: float | None  # standard error of their difference; None where one of them has none

    @property
    def share(self) -> float:
        """Difference over the first."""
        return (self.second - self.first) / self.first

    @property
    def words(self) -> str:
        """The same for people."""
        place = _NAMES[self.zone]
        if abs(self.share) < _ALIKE:
            return f"about the same {place}"
        if self.error is not None and abs(self.second - self.first) <= SURE * self.error:
            return f"not to be told apart {place}"
        return f"{abs(self.share):.0%} {'sharper' if self.share > 0 else 'softer'} {place}"


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two reports beside each other."""

    first: Side
    second: Side
    verdict: str
    zones: tuple[ZoneChange, ...]


def compare(first: Side, second: Side) -> Comparison:
    """Compare two copies at one aperture, or two apertures of one copy; those of one name are numbered."""
    if first.name == second.name:
        first, second = (
            replace(side, name=f"{side.name} ({k})") for k, side in enumerate((first, second), 1)
        )
    errors = [side.found.zone_errors for side in (first, second)]
    zones = tuple(
        ZoneChange(
            zone,
            first.found.zones[zone],
            second.found.zones[zone],
            None if None in errors else math.hypot(*(known[zone] for known in errors if known)),
        )
        for zone in ZONES
    )
    *some, last = (change.words for change in zones)
    verdict = f"Compared with {first.name}, {second.name} is {', '.join(some)} and {last}."
    return Comparison(first, second, verdict, zones)
