"""What the audit of a correction held back: in words, and as places of the upright photo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from app.pages.pictures import upright_point

CHECKS: Final[Mapping[str, str]] = {
    "too dark": "darker than anything nearby",
    "too bright": "brighter than anything nearby",
    "isolated pixels": "single pixels that stand out",
    "hue, spots": "spots of a colour that the photo does not have there",
    "hue, area": "a tint that the photo does not have there",
    "re-blur": "detail that does not match the photo",
    "spectrum": "sharper than this lens allows",
    "comb": "lines beside lines",
    "ringing": "rings beside edges",
    "grain": "grain beyond that of the photo",
}
LEAST: Final = 0.005
"""Share below which a check is not mentioned (chosen): less than can be seen."""

MAX_PLACES: Final = 6
"""Places that are listed (chosen): the worst ones."""

SQUARE: Final = 96
"""Side of a square in photo pixels for audits without `tile_side` (chosen): large enough to
find in the picture."""


@dataclass(frozen=True, slots=True)
class MarkedPlace:
    """A place of the upright photo in its pixels, with a caption."""

    x: int
    y: int
    words: str


@dataclass(frozen=True, slots=True)
class HeldBack:
    """What was held back: a sentence, the reasons, and the worst places."""

    words: str
    reasons: list[str]
    places: list[MarkedPlace]


def check_words(name: str) -> str:
    """Return what a check objects to, in words."""
    return CHECKS.get(name, name)


def held_places(audit: Mapping[str, Any], height: int, width: int, orientation: int) -> HeldBack | None:
    """Return what was held back of a correction; None where nothing was checked."""
    zones = audit.get("zones") or {}
    tiles = sum(zone["tiles"] for zone in zones.values())
    if not tiles:
        return None
    share = sum(zone["tiles"] * zone["held_back"] for zone in zones.values()) / tiles
    checks: dict[str, float] = {}
    for zone in zones.values():
        for name, part in zone["checks"].items():
            checks[name] = checks.get(name, 0.0) + part * zone["tiles"] / tiles
    listed = sorted(checks.items(), key=lambda item: -item[1])
    reasons = [f"{check_words(name)}: {part:.1%}" for name, part in listed if part >= LEAST]
    words = (
        "Applied almost in full."
        if share < LEAST
        else f"{share:.0%} of the correction was held back over the whole photo."
    )
    places = []
    worst = audit.get("worst", []) if share >= LEAST else []  # less cannot be seen
    for place in worst[:MAX_PLACES]:
        y, x = upright_point(place["row"], place["col"], height, width, orientation)
        places.append(MarkedPlace(x, y, f"{place['held_back']:.0%}: {check_words(place['check'])}"))
    return HeldBack(words, reasons, places)


def held_squares(
    audit: Mapping[str, Any], height: int, width: int, orientation: int
) -> dict[str, Any] | None:
    """Return the tiles with something held back as squares of the upright photo."""
    tiles = audit.get("tiles") or []
    if not tiles:
        return None
    side = int(audit.get("tile_side") or SQUARE)
    squares = []
    for tile in tiles:
        middle = (tile["row"] + side / 2, tile["col"] + side / 2)
        y, x = upright_point(*middle, height, width, orientation)
        squares.append({"x": round(x - side / 2), "y": round(y - side / 2), "held": tile["held_back"]})
    return {"tiles": squares, "side": side, "most": max(tile["held_back"] for tile in tiles)}
