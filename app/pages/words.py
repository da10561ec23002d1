"""Plain words for states, reasons and figures: the filters of the templates."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from app.schemas import CalibrationOut, CorrectionOut, LensOut, PatchOut, PhotoOut, Problem
from app.words import gain_words
from lensmodel.audit import HELD
from lensmodel.report import little_seen, place_in_words
from lensmodel.types import FieldPosition

PHOTO_STATES: Final[Mapping[str, str]] = {
    "received": "Waiting its turn",
    "inspecting": "Reading what the file says",
    "developing": "Developing to linear light",
    "selecting": "Looking for parts that tell about the blur",
    "needs_lens": "Waiting for you: which lens was it?",
    "counted": "Learned from",
    "stored": "Kept, to be corrected",
    "excluded": "Left out of the lens by you",
    "cancelled": "Cancelled",
}
FAILURES: Final[Mapping[str, str]] = {
    "no_usable_patches": "nothing in it tells about the blur. A photo with fine detail in focus would",
    "truncated_image": "the file ends too early. Copy it again from the camera or card",
    "raw_decode_failed": "the RAW data cannot be read. It may be damaged, or the camera too new",
    "decompression_bomb": "it would unpack to far more than a photo holds",
    "memory_limit": "it needs more memory than the service may use",
    "time_limit": "it took longer than the service allows",
    "crashed_repeatedly": "reading it failed again and again. The file is probably damaged",
}
ZONES: Final[Mapping[str, str]] = {"center": "Center", "mid": "Middle", "corner": "Corners"}
ENOUGH_PLACES: Final = 20
SHOWN_PLACES: Final = 3
FULL_STOPS: Final = (1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.0, 16.0, 22.0)
STOP: Final = 1.45
"""One stop as a factor of the f-number, with room for their rounding."""

NEAR: Final = 0.06
"""Apertures closer than this share are written alike."""
ACTIVE: Final = frozenset({"received", "inspecting", "developing", "selecting", "estimating"})
UNDEVELOPED: Final = frozenset({"received", "inspecting", "developing", "needs_lens", "failed", "cancelled"})
REASONS: Final[Mapping[str, str]] = {
    "clipped": "too bright: the sensor was saturated",
    "flat": "no detail",
    "dark": "too dark for its noise",
    "one-directional": "lines in one direction only",
    "periodic": "a repeating pattern, which misleads the estimate",
    "jpeg-blocks": "blocks of JPEG compression",
    "defocus": "blurrier than its surroundings: probably out of focus",
    "motion": "blurred in one direction: probably shaken",
    "border": "too near the edge of the picture",
    "duplicate": "overlaps a better one",
}


def lens_name(lens: LensOut) -> str:
    """Name a lens as its owner would."""
    if lens.label:
        return lens.label
    maker, model = lens.maker or "", lens.model or ""
    if model.lower().startswith(maker.lower()):
        maker = ""  # "Canon Canon EF 24mm"
    return f"{maker} {model}".strip() or "Unnamed lens"


def serial_words(lens: LensOut) -> str:
    """Say how sure it is that all photos are of one copy; the serial is shown shortened."""
    if not lens.serial:
        return "The photos do not say a serial number: all of them must be of one copy."
    return f"This copy: serial number ending in {lens.serial[-4:]}."


def f_stop(number: float) -> str:
    """Write an aperture as photographers do."""
    return f"f/{number:.3g}"


def f_stops(seen: Sequence[float]) -> list[tuple[float, bool]]:
    """List the apertures to ask a lens for: those of its photos, and full stops within one stop of them.

    Each comes with whether a photo was taken at it: the model answers in between too, and says how
    far it trusts that.
    """
    if not seen:
        return []
    low, high = min(seen) / STOP, max(seen) * STOP
    between = [n for n in FULL_STOPS if low <= n <= high and all(abs(n / a - 1.0) > NEAR for a in seen)]
    return sorted([*((a, True) for a in seen), *((n, False) for n in between)])


def photo_state(photo: PhotoOut) -> str:
    """Say where a photo stands."""
    if photo.state == "failed":
        return f"Not used: {failure(photo.error)}"
    if photo.state == "needs_lens" and photo.lens_id is not None:
        return "Waiting for you: at which aperture was it?"
    if photo.state == "estimating":
        return f"Measuring blur: {photo.patches.done} of {photo.patches.total} places"
    words = PHOTO_STATES.get(photo.state, photo.state)
    if photo.state == "counted":
        return f"{words}, at {counted(photo.patches.done, 'place')}"
    return words


def failure(error: Problem | None) -> str:
    """Say why something failed: in our own words where we have some, else in those of the error."""
    if error is None:
        return "the reason was not noted"
    return FAILURES.get(error.code, error.detail)


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
    return {
        "queued": "Waiting its turn",
        "running": "Removing the blur",
        "succeeded": f"Done, with version {correction.lens_version} of the lens",
        "failed": "This did not work",
        "cancelled": "Cancelled",
    }.get(correction.state, correction.state)


def refusal(status: int, detail: str) -> tuple[str, str]:
    """Write title and text of a page that stands for one that cannot be shown."""
    if status == 404:
        return (
            "Not here",
            "There is nothing at this address. It may have been deleted, or the address was cut.",
        )
    if status < 500:
        return "Not like this", detail
    return "That was our fault", "Something went wrong here; the log says what. Try again in a moment."


def reason_words(reason: str | None) -> str:
    """Say why a window was left out."""
    return REASONS.get(reason or "", reason or "no reason noted")


def patch_words(patch: PatchOut) -> str:
    """Describe one window of the overlay."""
    place = f"{round(100 * patch.r)} % of the way to the corner"
    if patch.state in {"rejected", "failed"}:
        return f"Left out: {reason_words(patch.reason)} ({place})"
    return f"Used ({place})" if patch.state == "done" else f"Still to be measured ({place})"


def error_words(error: dict[str, Any] | float | None) -> str:
    """Write a held-out error, one figure a zone."""
    if isinstance(error, Mapping):
        return ", ".join(figure(error.get(zone)) or "?" for zone in ZONES) if error else "not yet known"
    return figure(error) or "not yet known"


def history_words(history: Sequence[CalibrationOut]) -> str:
    """Say in words what a curve cannot show: fewer than two versions with an error."""
    tested = [event for event in history if event.error]
    if tested:
        found = tested[-1].error
        zones = found if isinstance(found, Mapping) else dict.fromkeys(ZONES, found)
        said = ", ".join(f"{ZONES[zone].lower()} {figure(zones.get(zone)) or '?'}" for zone in ZONES)
        return f"With {counted(tested[-1].photos, 'photo')}: {said}. The curve begins with the next one."
    if history and history[-1].photos > 1:
        return "The photos are being tested on one another."
    return "One photo so far. It is tested on the others once there are some."


def coverage_words(coverage: Mapping[str, Any] | None) -> str:
    """Write the places seen in each zone."""
    return ", ".join(str(coverage.get(zone, 0)) for zone in ZONES) if coverage else ""


@dataclass(frozen=True, slots=True)
class ZoneBar:
    """One zone of the picture in a bar chart; `share` is the length of the bar in percent."""

    name: str
    words: str
    share: int
    count: int = 0
    gain: str = ""


def coverage_bars(coverage: Mapping[str, Any] | None) -> list[ZoneBar]:
    """Compare how many places were seen in each zone."""
    if not coverage:
        return []
    counts = {zone: int(coverage.get(zone, 0)) for zone in ZONES}
    most = max(1, *counts.values())
    return [ZoneBar(zone, ZONES[zone], round(100 * count / most), count) for zone, count in counts.items()]


def coverage_advice(bars: Sequence[ZoneBar], seen: Sequence[FieldPosition]) -> str:
    """Say which photo would teach most.

    Parameters
    ----------
    bars : sequence of ZoneBar
        How many places were seen in each zone.
    seen : sequence of FieldPosition
        Those places: a zone with many may still have a corner with none.
    """
    if not bars:
        return "Not counted yet."
    few = [bar.words.lower() for bar in bars if bar.count < ENOUGH_PLACES]
    few = few or [place_in_words(place) for place in little_seen(seen)[:SHOWN_PLACES]]
    if not few:
        return "Every part of the picture has been seen well."
    return f"Little seen yet of: {', '.join(few)}. A photo with fine detail there, in focus, helps most."


def gain_bars(zones: Mapping[str, Mapping[str, Any]]) -> list[ZoneBar]:
    """Compare the expected gains of the zones."""
    gains = {zone: zones[zone].get("expected_gain_db") for zone in ZONES if zones.get(zone, {}).get("cells")}
    most = max([1.0, *(gain for gain in gains.values() if gain is not None)])
    return [
        ZoneBar(
            zone,
            ZONES[zone],
            round(100 * max(gain or 0.0, 0.0) / most),
            gain=gain_words(gain) + held_words(zones[zone]),
        )
        for zone, gain in gains.items()
    ]


def held_words(zone: Mapping[str, Any]) -> str:
    """Say where much of the correction was held back, and why."""
    held, reasons = zone.get("held_back") or 0.0, zone.get("reasons") or []
    return f", {held:.0%} held back ({', '.join(reasons[:3])})" if held > HELD else ""


def figure(value: object) -> str:
    """Write a number with what digits it deserves."""
    return f"{value:.3g}" if isinstance(value, float) else str(value if value is not None else "")


def active(photo: PhotoOut) -> bool:
    """Whether work on it goes on."""
    return photo.state in ACTIVE


def developed(photo: PhotoOut) -> bool:
    """Whether there may be a picture to show."""
    return photo.state not in UNDEVELOPED


def correctable(photo: PhotoOut) -> bool:
    """Whether it can be corrected now."""
    return photo.state in {"counted", "stored", "excluded"}


FILTERS: Final[Mapping[str, Callable[..., object]]] = {
    f.__name__: f
    for f in (
        lens_name,
        serial_words,
        f_stop,
        f_stops,
        photo_state,
        state_class,
        counted,
        duration,
        correction_state,
        reason_words,
        patch_words,
        error_words,
        history_words,
        coverage_words,
        coverage_advice,
        active,
        developed,
        correctable,
    )
}
