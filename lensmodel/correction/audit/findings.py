"""Findings of the audit in a whole photo, by zone of the field."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from lensmodel.core.types import ZONES, Zone
from lensmodel.correction.audit.check import TileAudit

HELD: Final = 0.1
"""Share of a correction; a tile of which more was held back counts as held back (chosen: a hundredth, which
is only just seen, would count nearly every tile with a fault at its rim, a half only what is spoilt)."""
MAPPED: Final = 0.01
"""Least share held back at which a tile is on the map: less is not seen (chosen)."""
PLACES: Final = 12
"""Number of worst places to name (chosen: as many as a person looks at; the map shows all)."""


@dataclass(frozen=True, slots=True)
class Place:
    """A place where a check objects.

    Parameters
    ----------
    check : str
        Name of the check.
    row, col : int
        Pixel of the photo, in sensor orientation.
    zone : {"center", "mid", "corner"}
        Zone of the tile.
    severity : float
        Multiple of the limit, above 1.
    held_back : float
        Mean share of the correction that the check alone holds back in its tile.
    """

    check: str
    row: int
    col: int
    zone: Zone
    severity: float
    held_back: float


@dataclass(frozen=True, slots=True)
class HeldTile:
    """A tile of the photo, by its first pixel, and the share of its correction that was held back."""

    row: int
    col: int
    held_back: float


@dataclass(frozen=True, slots=True)
class ZoneAudit:
    """What was held back in one zone.

    Parameters
    ----------
    tiles : int
        How many were audited.
    tiles_held : int
        Those of which more than a tenth was held back.
    held_back : float
        Mean share of the correction that was held back, 0 to 1.
    checks : Mapping[str, float]
        The same by check, each as if alone; those that held nothing back are left out.
    """

    tiles: int
    tiles_held: int
    held_back: float
    checks: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class AuditReport:
    """What the audit of a photo held back, why, and where most.

    Parameters
    ----------
    zones : Mapping[Zone, ZoneAudit]
        Zones without a tile are left out.
    worst : tuple of Place
        The worst first, at most one of a check in a tile.
    tiles : tuple of HeldTile
        The map: those of which at least a hundredth was held back.
    tile_side : int
        Side of the square in pixels that a tile stands for; 0 where it is not known.
    """

    zones: Mapping[Zone, ZoneAudit]
    worst: tuple[Place, ...]
    tiles: tuple[HeldTile, ...] = ()
    tile_side: int = 0

    @property
    def held_back(self) -> float:
        """Mean share of the correction that was held back, all tiles together."""
        tiles = sum(zone.tiles for zone in self.zones.values())
        return sum(zone.tiles * zone.held_back for zone in self.zones.values()) / tiles if tiles else 0.0


def pooled(audits: Iterable[tuple[Zone, tuple[int, int], TileAudit]], tile_side: int = 0) -> AuditReport:
    """Pool the audits of tiles.

    Parameters
    ----------
    audits : iterable of (zone, (row, col), TileAudit)
        Zone of each tile and its first pixel in the photo.
    tile_side : int
        Side of the square in pixels that a tile stands for.

    Returns
    -------
    AuditReport
    """
    listed = list(audits)
    zones: dict[Zone, ZoneAudit] = {}
    for zone in ZONES:
        in_zone = [audit for name, _, audit in listed if name == zone]
        if in_zone:
            zones[zone] = _zone(in_zone)
    places = [
        Place(f.check, top + f.at[0], left + f.at[1], zone, f.worst, f.held_back)
        for zone, (top, left), audit in listed
        for f in audit.findings
        if f.held_back > 0.0
    ]
    places.sort(key=lambda place: (-place.held_back, -place.severity, place.row, place.col))
    held = tuple(
        HeldTile(top, left, audit.held_back) for _, (top, left), audit in listed if audit.held_back >= MAPPED
    )
    return AuditReport(zones, tuple(places[:PLACES]), held, tile_side)


def _zone(audits: list[TileAudit]) -> ZoneAudit:
    shares = [audit.held_back for audit in audits]
    checks: dict[str, float] = {}
    for audit in audits:
        for finding in audit.findings:
            checks[finding.check] = checks.get(finding.check, 0.0) + finding.held_back / len(audits)
    return ZoneAudit(
        len(audits),
        sum(share > HELD for share in shares),
        float(np.mean(shares)),
        {name: share for name, share in checks.items() if share > 0.0},
    )
