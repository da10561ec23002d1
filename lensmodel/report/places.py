"""Places of the field: in plain words, and as grids that stay inside the frame.

Which photo would help most, in plain words.

The error of a mean over photos falls with their number n as 1 / sqrt(n). One more photo that shows
detail at a place is therefore worth::

    gain = e (1 - sqrt(n / (n + 1)))

with e the error predicted there and n the photos that speak for the place; none do where the model
extrapolates, so that its whole error can be gained. The place and aperture of the largest gain wins.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.geometry import CENTER_ZONE_R, CORNER_ZONE_R
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import LensModel

DEFAULT_ASPECT: Final = 1.5
"""Width over height of a 35 mm frame; a profile does not say how wide its photos were."""

NEAR_R: Final = 0.3
"""Distance in half diagonals within which a patch speaks for a place: no spot of the picture is further from
all `landmarks`, and blur changes little over it (chosen)."""

ENOUGH_NEAR: Final = 5
"""Patches near a place that has been seen well: a mean of five is known twice as well as one of them
(chosen)."""

_DIRECTIONS: Final = (
    *("right", "upper right", "top", "upper left"),
    *("left", "lower left", "bottom", "lower right"),
)


def direction_in_words(phi: float) -> str:
    """Name the eighth of the picture that an angle points to."""
    return _DIRECTIONS[round(phi / (math.pi / 4.0)) % 8]


def place_in_words(position: FieldPosition) -> str:
    """Name a place so that somebody can put it into the viewfinder: "the upper left corner"."""
    if position.r < CENTER_ZONE_R:
        return "the centre"
    side = direction_in_words(position.phi)
    if position.r <= CORNER_ZONE_R:
        return f"the {side}"
    return f"the {side} {'corner' if ' ' in side else 'edge'}"


def half_sides(aspect: float) -> tuple[float, float]:
    """Half width and half height of a frame in half diagonals."""
    if not 0.2 <= aspect <= 5.0:
        raise InvalidInputError(f"width over height must lie in 0.2..5, got {aspect}")
    diagonal = math.hypot(aspect, 1.0)
    return aspect / diagonal, 1.0 / diagonal


def grid(rows: int, cols: int, aspect: float) -> tuple[FieldPosition, ...]:
    """Centres of rows x cols equal cells of the picture, row by row from the top left."""
    if not (1 <= rows <= 100 and 1 <= cols <= 100):
        raise InvalidInputError(f"a grid has 1..100 rows and columns, got {rows} x {cols}")
    width, height = half_sides(aspect)
    places = []
    for i in range(rows):
        y = height * (1.0 - (2 * i + 1) / rows)
        for j in range(cols):
            x = width * ((2 * j + 1) / cols - 1.0)
            places.append(FieldPosition(min(math.hypot(x, y), 1.0), math.atan2(y, x)))
    return tuple(places)


def ring(r: float, count: int, aspect: float) -> tuple[FieldPosition, ...]:
    """Places at one radius that lie on the picture, symmetric about both of its axes.

    Angles are drawn evenly from the arcs that the frame cuts from the circle; one place at the centre.
    """
    if r == 0.0:
        return (FieldPosition(0.0, 0.0),)
    width, height = half_sides(aspect)
    low = math.acos(min(width / r, 1.0))
    high = math.asin(min(height / r, 1.0))
    quarter = [low + (high - low) * (k + 0.5) / count for k in range(count)]
    angles = [s * (a if side > 0 else math.pi - a) for s in (1, -1) for side in (1, -1) for a in quarter]
    return tuple(FieldPosition(r, a) for a in angles)


def corner_places(aspect: float) -> tuple[FieldPosition, ...]:
    """The four corners, upper left first, as far out as samples reach."""
    width, height = half_sides(aspect)
    corner = math.atan2(height, width)
    return tuple(FieldPosition(0.9, phi) for phi in (math.pi - corner, corner, corner - math.pi, -corner))


def side_places(aspect: float) -> tuple[FieldPosition, ...]:
    """Left, right, top and bottom, four fifths of the way to the edge."""
    width, height = half_sides(aspect)
    return (
        FieldPosition(0.8 * width, math.pi),
        FieldPosition(0.8 * width, 0.0),
        FieldPosition(0.8 * height, math.pi / 2),
        FieldPosition(0.8 * height, -math.pi / 2),
    )


def landmarks() -> list[FieldPosition]:
    """The centre, the four corners, the four quarters between, and the middles of the four edges."""
    width, height = half_sides(DEFAULT_ASPECT)
    corners = corner_places(DEFAULT_ASPECT)
    return [
        FieldPosition(0.0, 0.0),
        *corners,
        *(FieldPosition(0.5, place.phi) for place in corners),
        *(FieldPosition(0.8 * width, phi) for phi in (0.0, math.pi)),
        *(FieldPosition(0.8 * height, phi) for phi in (math.pi / 2, -math.pi / 2)),
    ]


def little_seen(positions: Iterable[FieldPosition], least: int = ENOUGH_NEAR) -> list[FieldPosition]:
    """Landmarks with too little evidence near them, the emptiest first."""
    points = np.array([(p.r * math.cos(p.phi), p.r * math.sin(p.phi)) for p in positions]).reshape(-1, 2)
    counts = []
    for place in landmarks():
        offset = points - (place.r * math.cos(place.phi), place.r * math.sin(place.phi))
        counts.append((int((np.hypot(*offset.T) <= NEAR_R).sum()), place))
    return [place for count, place in sorted(counts, key=lambda item: item[0]) if count < least]


_SIZE: Final = 15  # pixels (chosen: quick to ask for; the kernel itself plays no part)
_SETTINGS: Final = 12  # settings that are asked about, those of the most samples (chosen: for time)
_SATISFIED: Final = 0.01  # of the kernel's norm: less gain is not worth another photo (chosen)


@dataclass(frozen=True, slots=True)
class Suggestion:
    """One photo that would help."""

    text: str  # what to photograph: "something with fine detail at the upper left corner, at f/2"
    reason: str  # why: what the model knows of that place now
    position: FieldPosition  # where the detail should lie, in sensor orientation
    settings: LensSettings  # aperture and focal length that are short of evidence
    gain: float  # drop of the predicted relative L2 error that one photo is worth


@dataclass(frozen=True, slots=True)
class Advice:
    """What to photograph next."""

    text: str  # one sentence for people
    # at most three, the most helpful first; different places or apertures
    suggestions: tuple[Suggestion, ...]
    # true where no single photo would help much any more, and every part of the picture has patches near it
    # (`places.little_seen`)
    enough: bool


def advice(model: LensModel, settings: LensSettings | None = None) -> Advice:
    """Name the photo that would help a model most."""
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
            f"{'one photo shows' if photos == 1 else f'{photos} photos show'} that place so far, and {error}"
        )
    gain = answer.predicted_error * (1.0 - math.sqrt(photos / (photos + 1.0)))
    return Suggestion(text, reason, place, settings, gain)
