"""Which photo would help most, in plain words.

The error of a mean over photos falls with their number n as 1 / sqrt(n). One more photo that shows
detail at a place is therefore worth::

    gain = e (1 - sqrt(n / (n + 1)))

with e the error predicted there and n the photos that speak for the place; none do where the model
extrapolates, so that its whole error can be gained. The place and setting of the largest gain wins.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import Final

from lensmodel.core.types import CHANNELS, Channel, FieldPosition, LensSettings
from lensmodel.model import LensModel, PsfAnswer
from lensmodel.report.places import landmarks, little_seen, place_in_words

_SIZE: Final = 15  # pixels (chosen: quick to ask for; the kernel itself plays no part)
_SETTINGS: Final = 24  # settings that are asked about, those of the most samples (chosen: for time)
_SATISFIED: Final = 0.01  # of the kernel's norm: less gain is not worth another photo (chosen)
_WEIGHT: Final[dict[Channel, float]] = {"g": 1.0, "r": 0.5, "b": 0.5}
"""Sharpness is seen in luminance, to which red and blue together give about as much as green
(chosen: round numbers)."""

_COLOURS: Final[dict[Channel, str]] = {
    "g": "fine detail",
    "r": "fine detail in red or neutral colours",
    "b": "fine detail in blue or neutral colours",
}


@dataclass(frozen=True, slots=True)
class Suggestion:
    """One photo that would help.

    Parameters
    ----------
    text : str
        What to photograph: "something with fine detail at the upper left corner, at f/2".
    reason : str
        Why: what the model knows of that place now.
    position : FieldPosition
        Where the detail should lie, in sensor orientation.
    settings : LensSettings
        Aperture, focal length and channel that are short of evidence.
    gain : float
        Drop of the predicted relative L2 error that one photo is worth, red and blue at half weight.
    predicted_error : float
        Expected relative L2 there now.
    effective_samples : float
    photos : int
        Photos that speak for the place now; 0 where the model extrapolates.
    extrapolated : bool
    """

    text: str
    reason: str
    position: FieldPosition
    settings: LensSettings
    gain: float
    predicted_error: float
    effective_samples: float
    photos: int
    extrapolated: bool


@dataclass(frozen=True, slots=True)
class Advice:
    """What to photograph next.

    Parameters
    ----------
    text : str
        One sentence for people.
    suggestions : tuple of Suggestion
        At most three, the most helpful first; different places or apertures.
    enough : bool
        True where no single photo would help much any more, and every part of the picture has patches
        near it (`places.little_seen`).
    """

    text: str
    suggestions: tuple[Suggestion, ...]
    enough: bool


def advice(model: LensModel, settings: LensSettings | None = None) -> Advice:
    """Name the photo that would help a model most.

    Parameters
    ----------
    model : LensModel
    settings : LensSettings, optional
        Settings that the owner cares for; None looks at all settings that any photo had. The
        channel plays no part: a photo tells about all three.

    Returns
    -------
    Advice
        The same for the same model, whatever the order of its samples.
    """
    wanted = _settings(model) if settings is None else [replace(settings, channel="g")]
    shots = [
        _suggestion(model, place, each.with_channel(channel))
        for each in wanted
        for channel in CHANNELS
        for place in landmarks()
    ]
    # green before red and blue, near before far, right before left: ties must not depend on anything else
    shots.sort(
        key=lambda w: (
            -round(w.gain, 6),
            w.settings.channel != "g",
            w.settings.stops or 0.0,
            w.position.r,
            abs(w.position.phi),
            w.position.phi,
        )
    )
    best: list[Suggestion] = []
    for suggestion in shots:
        known = {(w.position, w.settings.aperture) for w in best}
        if len(best) < 3 and (suggestion.position, suggestion.settings.aperture) not in known:
            best.append(suggestion)
    satisfied = best[0].gain < _SATISFIED
    dark = little_seen(_estimated_places(model)) if satisfied else []
    enough = satisfied and not dark
    if dark:
        first = next(w for w in shots if w.position == dark[0])
        text = f"Most useful next: a photo of {first.text}. Little fine detail was seen there yet."
    elif enough:
        text = (
            "The photos cover the picture well; another one would change little. "
            f"If you add one, make it {best[0].text}."
        )
    else:
        text = f"Most useful next: a photo of {best[0].text}, because {best[0].reason}."
    return Advice(text, tuple(best), enough)


def _estimated_places(model: LensModel) -> list[FieldPosition]:
    """Where patches of photos that vote gave a PSF."""
    voting = (s for s in model.samples if s.photo not in model.settings.excluded)
    return [s.position for s in voting if s.settings.channel == "g"]


def _settings(model: LensModel) -> list[LensSettings]:
    """Settings of the photos that vote, each once, in order; the most used where there are many."""
    count = Counter(
        replace(s.settings, channel="g") for s in model.samples if s.photo not in model.settings.excluded
    )
    ordered = sorted(count.items(), key=lambda item: (-item[1], _order(item[0])))
    return sorted((settings for settings, _ in ordered[:_SETTINGS]), key=_order)


def _order(settings: LensSettings) -> tuple[float, float, float]:
    return settings.aperture or 0.0, settings.focal_mm or 0.0, settings.focus_m or 0.0


def _suggestion(model: LensModel, place: FieldPosition, settings: LensSettings) -> Suggestion:
    answer = model.query(place, settings, _SIZE)
    photos = 0 if answer.extrapolated else answer.photos
    gain = answer.predicted_error * (1.0 - math.sqrt(photos / (photos + 1.0)))
    return Suggestion(
        text=_text(place, settings),
        reason=_reason(answer, photos),
        position=place,
        settings=settings,
        gain=_WEIGHT[settings.channel] * gain,
        predicted_error=answer.predicted_error,
        effective_samples=answer.effective_samples,
        photos=photos,
        extrapolated=answer.extrapolated,
    )


def _text(place: FieldPosition, settings: LensSettings) -> str:
    words = f"something with {_COLOURS[settings.channel]} at {place_in_words(place)}"
    if settings.aperture is not None:
        words += f", at f/{settings.aperture:g}"
    if settings.focal_mm is not None:
        words += f", at {settings.focal_mm:g} mm"
    return words


def _reason(answer: PsfAnswer, photos: int) -> str:
    error = f"its blur is expected to be wrong by {100 * answer.predicted_error:.0f} %"
    if photos == 0:
        return f"no photo shows that place at these settings yet, and {error}"
    some = "one photo speaks" if photos == 1 else f"{photos} photos speak"
    return f"{some} for that place, and {error}"
