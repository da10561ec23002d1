"""Which photo would help most, in plain words.

The error of a mean over photos falls with their number n as 1 / sqrt(n). One more photo that shows
detail at a place is therefore worth::

    gain = e (1 - sqrt(n / (n + 1)))

with e the error predicted there and n the photos that speak for the place; none do where the model
extrapolates, so that its whole error can be gained. The place and aperture of the largest gain wins.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import Final

from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import LensModel
from lensmodel.report.places import landmarks, little_seen, place_in_words

_SIZE: Final = 15  # pixels (chosen: quick to ask for; the kernel itself plays no part)
_SETTINGS: Final = 12  # settings that are asked about, those of the most samples (chosen: for time)
_SATISFIED: Final = 0.01  # of the kernel's norm: less gain is not worth another photo (chosen)


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
        Aperture and focal length that are short of evidence.
    gain : float
        Drop of the predicted relative L2 error that one photo is worth.
    """

    text: str
    reason: str
    position: FieldPosition
    settings: LensSettings
    gain: float


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
        Settings that the owner cares for; None looks at those that photos had.

    Returns
    -------
    Advice
        The same for the same model, whatever the order of its samples.
    """
    own = [s for s in model.samples if s.photo not in model.settings.excluded and s.settings.channel == "g"]
    count = Counter(s.settings for s in own)
    ordered = sorted(count, key=lambda asked: (-count[asked], _order(asked)))
    wanted = ordered[:_SETTINGS] if settings is None else [replace(settings, channel="g")]
    shots = [_suggestion(model, place, asked) for asked in wanted for place in landmarks()]
    # near before far, right before left: ties must not depend on anything else
    shots.sort(
        key=lambda s: (
            -round(s.gain, 6),
            _order(s.settings),
            s.position.r,
            abs(s.position.phi),
            s.position.phi,
        )
    )
    best: list[Suggestion] = []
    for shot in shots:
        known = {(s.position, s.settings.aperture) for s in best}
        if len(best) < 3 and (shot.position, shot.settings.aperture) not in known:
            best.append(shot)
    if best[0].gain >= _SATISFIED:
        return Advice(
            f"Next, a photo of {best[0].text}, because {best[0].reason}.", tuple(best), enough=False
        )
    if unseen := little_seen(s.position for s in own):
        shot = _suggestion(model, unseen[0], wanted[0])
        text = f"Next, a photo of {shot.text}, because little is seen of that place."
        others = sorted((shot, *best[:2]), key=lambda each: -each.gain)
        return Advice(text, tuple(others), enough=False)
    return Advice("The lens is well known by now; another photo would add little.", tuple(best), enough=True)


def _order(settings: LensSettings) -> tuple[float, float, float]:
    return settings.aperture or 0.0, settings.focal_mm or 0.0, settings.focus_m or 0.0


def _suggestion(model: LensModel, place: FieldPosition, settings: LensSettings) -> Suggestion:
    answer = model.query(place, settings, _SIZE)
    photos = 0 if answer.extrapolated else answer.photos
    text = f"something with fine detail at {place_in_words(place)}"
    if settings.aperture is not None:
        text += f", at f/{settings.aperture:g}"
    if settings.focal_mm is not None:
        text += f", at {settings.focal_mm:g} mm"
    error = f"its blur is expected to be wrong by {answer.predicted_error:.0%}"
    if photos == 0:
        reason = f"no photo shows that place at these settings yet, and {error}"
    else:
        reason = (
            f"{'one photo speaks' if photos == 1 else f'{photos} photos speak'} for that place, and {error}"
        )
    gain = answer.predicted_error * (1.0 - math.sqrt(photos / (photos + 1.0)))
    return Suggestion(text, reason, place, settings, gain)
