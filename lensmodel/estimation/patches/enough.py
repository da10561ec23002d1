"""Whether the chosen patches of a photo are enough, and spread out enough, to tell about its lens."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from lensmodel.core.errors import NoUsablePatchesError
from lensmodel.core.geometry import zone_of
from lensmodel.core.types import FieldPosition
from lensmodel.estimation.patches.selector import Patch

LEAST_PATCHES: Final = 6
"""Patches that lie apart. A plane over the field, which is the least that tells a centred lens from a
decentred one, has three unknowns; so many again tell whether the first three agree."""

LEAST_PARTS: Final = 3
"""Parts of the picture that they lie in: three places off one line determine a plane over the field."""

PARTS: Final = 9
"""The center, the four quarters of the picture around it, and the outer end of each."""


def part_of(position: FieldPosition) -> int:
    """Number of the part of the picture that a place lies in, 0 to `PARTS` - 1, the center first."""
    zone = zone_of(position.r)
    if zone == "center":
        return 0
    quarter = math.floor(position.phi / (math.pi / 2.0)) % 4
    return 1 + quarter + (4 if zone == "corner" else 0)


def apart(patches: Sequence[Patch]) -> list[Patch]:
    """Patches half a side or more from each other, taken greedily in their order."""
    kept: list[Patch] = []
    for patch in patches:
        if all(max(abs(patch.row - k.row), abs(patch.col - k.col)) >= patch.size / 2 for k in kept):
            kept.append(patch)
    return kept


def require_enough(patches: Sequence[Patch], *, least: int = LEAST_PATCHES) -> None:
    """Refuse a photo whose detail is too little, or all in one place.

    Parameters
    ----------
    patches : sequence of Patch
        Those that tell about the PSF.
    least : int
        How many that lie apart are needed.

    Raises
    ------
    NoUsablePatchesError
        If there are fewer, or they lie in fewer than three parts of the picture.
    """
    single = apart(patches)
    parts = len({part_of(patch.position) for patch in single})
    if len(single) < least:
        places = "one place" if len(single) == 1 else f"{len(single)} places"
        raise NoUsablePatchesError(
            f"fine detail in focus was found in only {places}, and a photo counts from {least} on; take a "
            "scene full of detail, at a low ISO, and give the photo in its full size"
        )
    if parts < min(LEAST_PARTS, least):
        raise NoUsablePatchesError(
            f"fine detail in focus was found in only {parts} of {PARTS} parts of the picture (the center, "
            f"four quarters and their outer ends), and a photo counts from {LEAST_PARTS} on; take "
            "a scene with detail all over"
        )
