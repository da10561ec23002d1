"""Plain words for states, reasons and figures: the filters of the templates."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, Final, get_args

from app.pages.pictures import turned_box
from app.pages.shown import WaitingGroup
from app.schemas import CorrectionOut, LensOut, PhotoOut, Problem, Working
from lensmodel.cli.console import gain_words
from lensmodel.core.names import full_name
from lensmodel.correction.audit import HELD
from lensmodel.report import caution, sharpness

PHOTO_STATES: Final[Mapping[str, str]] = {
    "received": "In the queue",
    "inspecting": "Reading the file's details",
    "developing": "Developing the photo",
    "selecting": "Looking for parts that show the blur",
    "needs_lens": "Waiting for your answer",
    "stored": "Ready to correct",
    "excluded": "Left out, as you chose",
    "cancelled": "Left out",
}
CORRECTION_STATES: Final[Mapping[str, str]] = {
    "queued": "In the queue",
    "running": "Removing the blur",
    "succeeded": "Done, with version {version} of the lens",
    "failed": "This did not work",
    "cancelled": "Cancelled",
}
FAILURES: Final[Mapping[str, str]] = {
    "no_usable_patches": "nothing in it shows the blur of the lens. A photo with fine detail in focus would",
    "truncated_image": "the file ends too early. Copy it again from the camera or card",
    "raw_decode_failed": "the RAW data cannot be read. It may be damaged, or the camera too new",
    "decompression_bomb": "it would unpack to far more than any photo holds",
    "memory_limit": "it needs more memory than the service may use",
    "time_limit": "it took longer than the service allows. It may fit when the machine has less to do",
    "crashed_repeatedly": "reading it failed again and again. The file is probably damaged",
}
ZONES: Final[Mapping[str, str]] = {"center": "Centre", "mid": "Middle", "corner": "Corners"}
FILES: Final[Mapping[str, str]] = {
    "tiff16": "TIFF, 16 bit",
    "png16": "PNG, 16 bit",
    "png8": "PNG, 8 bit",
    "jpeg": "JPEG",
    "dng": "Linear DNG",
}
ACTIVE: Final = frozenset(get_args(Working))
CHECKS: Final[Mapping[str, str]] = {
    "isolated pixels": "single pixels that stand out",
    "re-blur": "detail that does not match the photo",
    "spectrum": "finer contrast than the photo can have held",
}
LEAST: Final = 0.005  # Share below which a check is not mentioned (chosen): less than can be seen

REASONS: Final[Mapping[str, str]] = {
    "clipped": "too bright: the sensor was saturated",
    "flat": "no detail",
    "dark": "too dark for its noise",
    "one-directional": "detail in one direction only",
    "periodic": "a repeating pattern, which misleads the estimate",
    "jpeg-blocks": "blocks of JPEG compression",
    "border": "too near the edge of the picture",
    "duplicate": "overlaps a better one",
}


def lens_name(lens: LensOut) -> str:
    """Name a lens as its owner would."""
    return lens.label or full_name(lens.maker, lens.model) or "Unnamed lens"


def f_stop(number: float) -> str:
    """Write an aperture as photographers do."""
    return f"f/{number:.3g}"


def plain(sentence: str) -> str:
    """Leave out the figures in brackets: they stand on the page for testers."""
    return re.sub(r" \([^)]*\)", "", sentence)


def photo_state(photo: PhotoOut) -> str:
    """Say where a photo stands."""
    if photo.state == "failed":
        return f"Not used: {failure(photo.error)}"
    if photo.state == "needs_lens" and photo.lens_id is not None:
        return "At which aperture was it?"
    if photo.state == "estimating":
        return f"Measuring blur: {photo.patches.done} of {photo.patches.total} places"
    if photo.state == "counted":
        return f"Used: blur measured at {counted(photo.patches.done, 'place')}"
    return PHOTO_STATES[photo.state]


def failure(error: Problem | None) -> str:
    """Say why something failed: in our own words where we have some, else in those of the error."""
    return FAILURES.get(error.code, error.detail) if error else "the reason was not recorded"


def state_class(photo: PhotoOut) -> str:
    """Name the look of a state."""
    return "busy" if photo.state in ACTIVE else photo.state


def counted(number: int, what: str) -> str:
    """Write a number of things."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def duration(seconds: float) -> str:
    """Write how long something still takes, no more exactly than it is known."""
    if seconds < 10:
        return "a few seconds"
    return f"about {round(seconds, -1):.0f} seconds" if seconds < 90 else f"about {seconds / 60:.0f} minutes"


def correction_state(correction: CorrectionOut) -> str:
    """Say where a correction stands."""
    return CORRECTION_STATES[correction.state].format(version=correction.lens_version)


def file_name(correction: CorrectionOut) -> str:
    """Name the kind of file that a correction makes."""
    return FILES[correction.output["format"]]


def correction_name(correction: CorrectionOut) -> str:
    """Name a correction by how it differs from others."""
    strength = f"strength {percent(correction.strength)}" if correction.strength < 1 else ""
    return ", ".join(filter(None, (correction.method.capitalize(), strength, file_name(correction))))


def group_name(group: WaitingGroup) -> str:
    """Say what the photos of a group have in common."""
    body, focal = group.told
    parts = filter(None, (group.camera or "Unknown camera", body, group.lens_model, focal))
    return f"{', '.join(parts)}: {counted(len(group.photos), 'photo')}"


def reason_words(reason: str | None) -> str:
    """Say why a window was left out."""
    return REASONS.get(reason or "", reason or "no reason noted")


def error_words(error: Mapping[str, float | None] | None) -> str:
    """Write a held-out error in percent, one figure a zone."""
    return ", ".join(percent(error.get(zone)) for zone in ZONES) if error else "not yet known"


def percent(share: float | None) -> str:
    """Write a share in percent."""
    return "not known" if share is None else f"{100 * share:.0f} %"


def coverage_words(coverage: Mapping[str, Any] | None) -> str:
    """Write the places seen in each zone."""
    return ", ".join(str(coverage.get(zone, 0)) for zone in ZONES) if coverage else ""


def gain_bars(zones: Mapping[str, Mapping[str, Any]]) -> tuple[list[tuple[str, int, str]], int]:
    """Return name, length in percent and words of a bar for each zone, and the decibels at their end."""
    known = {name: zones[zone] for zone, name in ZONES.items() if zones.get(zone, {}).get("cells")}
    gains = {name: zone.get("expected_gain_db") for name, zone in known.items()}
    most = math.ceil(max([3.0, *(gain for gain in gains.values() if gain is not None)]))
    return [
        (name, round(100 * max(gain or 0.0, 0.0) / most), gain_words(gain) + held_words(known[name]))
        for name, gain in gains.items()
    ], most


def nothing_words(kind: str) -> str:
    """Say why a photo is left as it is."""
    if kind == "jpeg":
        return (
            "The camera has sharpened and compressed this JPEG, and removing what blur is left would not "
            "make it visibly better; the RAW file of the same shot would gain more."
        )
    return "Removing the blur would not make it visibly better, or the lens is not known well enough yet."


def held_words(zone: Mapping[str, Any]) -> str:
    """Say where much of the correction was held back, and why."""
    held, reasons = zone.get("held_back") or 0.0, zone.get("reasons") or []
    return f", {percent(held)} held back ({', '.join(reasons[:3])})" if held > HELD else ""


def held_back(audit: Mapping[str, Any]) -> tuple[str, list[str]] | None:
    """Say how much of a correction was held back, and why; None where nothing was checked."""
    zones = (audit.get("zones") or {}).values()
    tiles = sum(zone["tiles"] for zone in zones)
    if not tiles:
        return None
    checks: Counter[str] = Counter()
    for zone in zones:
        checks.update({name: part * zone["tiles"] / tiles for name, part in zone["checks"].items()})
    share = sum(zone["tiles"] * zone["held_back"] for zone in zones) / tiles
    words = f"{percent(share)} of the correction was held back over the whole photo."
    return (
        "Applied almost in full." if share < LEAST else words,
        [
            f"{CHECKS.get(name, name)}: {100 * part:.1f} %"
            for name, part in checks.most_common()
            if part >= LEAST
        ],
    )


def held_map(
    audit: Mapping[str, Any], height: int, width: int, orientation: int
) -> list[tuple[int, int, int, int, float]]:
    """Return the tiles that were held back in the upright photo: left, top, width, height, and the share.

    They reach into their neighbours; what is drawn of each is its part of a lattice without gaps.
    """
    side, found = audit.get("tile_side") or 1, []
    rise, run = (extent / max(1, round(extent / side)) for extent in (height, width))
    for tile in audit.get("tiles") or []:
        row, col = round(tile["row"] / rise), round(tile["col"] / run)
        ends = (round(row * rise), round(col * run), round((row + 1) * rise), round((col + 1) * run))
        top, left, down, across = turned_box(*ends, height, width, orientation)
        found.append((left, top, across, down, tile["held_back"]))
    return found


def active(photo: PhotoOut) -> bool:
    """Whether work on it goes on."""
    return photo.state in ACTIVE


def correctable(photo: PhotoOut) -> bool:
    """Whether it can be corrected now."""
    return photo.state in {"counted", "stored", "excluded"}


# Templates use all of these as filters
FILTERS: Final[Mapping[str, Callable[..., object]]] = {
    "sharpness": sharpness,
    "caution": caution,
    **{name: made for name, made in globals().items() if getattr(made, "__module__", "") == __name__},
}
