"""Plain words for states, reasons and figures: the filters of the templates."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

from app.schemas import CorrectionOut, LensOut, PatchOut, PhotoOut

PHOTO_STATES: Final[Mapping[str, str]] = {
    "received": "Waiting its turn",
    "inspecting": "Reading what the file says",
    "developing": "Developing to linear light",
    "selecting": "Looking for parts that tell about the blur",
    "needs_lens": "Which lens was it? The file does not say: open it and choose",
    "counted": "Learned from",
    "stored": "Kept, to be corrected",
    "excluded": "Left out of the lens by you",
    "cancelled": "Cancelled",
}
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
    return " ".join(part for part in (lens.maker, lens.model) if part) or "Unnamed lens"


def serial_words(lens: LensOut) -> str:
    """Say how sure it is that all photos are of one copy; the serial is shown shortened."""
    if not lens.serial:
        return "The photos do not say a serial number: all of them must be of one copy."
    return f"Serial ending in {lens.serial[-4:]}."


def f_stop(number: float) -> str:
    """Write an aperture as photographers do."""
    return f"f/{number:.3g}"


def photo_state(photo: PhotoOut) -> str:
    """Say where a photo stands."""
    if photo.state == "failed":
        return f"Not used: {photo.error.detail if photo.error else 'unknown reason'}"
    if photo.state == "estimating":
        return f"Measuring blur: {photo.patches.done} of {photo.patches.total} patches"
    words = PHOTO_STATES.get(photo.state, photo.state)
    if photo.state == "counted":
        return f"{words}: {photo.patches.done} patches used, {photo.patches.rejected} left out"
    return words


def correction_state(correction: CorrectionOut) -> str:
    """Say where a correction stands."""
    return {
        "queued": "Waiting its turn",
        "running": "Removing the blur",
        "succeeded": f"Done, with version {correction.lens_version} of the lens, method {correction.method}",
        "failed": "It did not work",
        "cancelled": "Cancelled",
    }.get(correction.state, correction.state)


def reason_words(reason: str | None) -> str:
    """Say why a window was left out."""
    return REASONS.get(reason or "", reason or "no reason noted")


def patch_words(patch: PatchOut) -> str:
    """Describe one window of the overlay."""
    place = f"{round(100 * patch.r)} % of the way to the corner"
    if patch.state in {"rejected", "failed"}:
        return f"left out: {reason_words(patch.reason)} ({place})"
    return f"used ({place})" if patch.state == "done" else f"{patch.state} ({place})"


def error_words(error: dict[str, Any] | float | None) -> str:
    """Write a held-out error, one figure a zone."""
    if error is None:
        return "not yet known"
    if isinstance(error, Mapping):
        return ", ".join(f"{zone} {figure(value)}" for zone, value in error.items()) or "not yet known"
    return figure(error)


def coverage_words(coverage: dict[str, Any] | None) -> str:
    """Write the samples of each zone."""
    if not coverage:
        return ""
    return ", ".join(str(coverage.get(zone, 0)) for zone in ("center", "mid", "corner"))


def figure(value: object) -> str:
    """Write a number with what digits it deserves."""
    return f"{value:.3g}" if isinstance(value, float) else str(value if value is not None else "")


def active(photo: PhotoOut) -> bool:
    """Whether work on it goes on."""
    return photo.state in ACTIVE


def developed(photo: PhotoOut) -> bool:
    """Whether there may be a picture to show."""
    return photo.state not in UNDEVELOPED


FILTERS: Final[Mapping[str, Callable[..., object]]] = {
    f.__name__: f
    for f in (
        lens_name,
        serial_words,
        f_stop,
        photo_state,
        correction_state,
        reason_words,
        patch_words,
        error_words,
        coverage_words,
        figure,
        active,
        developed,
    )
}
