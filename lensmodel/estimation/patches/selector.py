"""What patch selection returns, and what a selector must be able to do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, TypeAlias, get_args

from lensmodel.core.types import FieldPosition

Reason: TypeAlias = Literal[
    "border",
    "clipped",
    "dark",
    "flat",
    "one-directional",
    "periodic",
    "jpeg-blocks",
    "defocus",
    "duplicate",
]
"""Why a window was not taken; `duplicate` means that a better one lies too near or the quota is full."""

MAX_REJECTIONS: Final = 2000
"""A photo has ten thousand windows; a report needs no more than this."""

REASONS: Final[tuple[Reason, ...]] = get_args(Reason)


@dataclass(frozen=True, slots=True)
class Patch:
    """A window of a photo that tells about the PSF.

    Parameters
    ----------
    row, col : int
        Top-left pixel.
    size : int
        Side in pixels.
    position : FieldPosition
        Of the window's centre.
    score : float
        How much it tells, 0 to 1.
    cell : int
        Number of the field cell; patches of one cell may share one kernel.
    """

    row: int
    col: int
    size: int
    position: FieldPosition
    score: float
    cell: int


@dataclass(frozen=True, slots=True)
class Rejection:
    """A window that was not taken, and why."""

    row: int
    col: int
    size: int
    reason: Reason


@dataclass(frozen=True, slots=True)
class Selection:
    """The outcome of patch selection on one plane.

    Parameters
    ----------
    patches : tuple of Patch
        Ordered by cell, the best of each cell first.
    rejected : tuple of Rejection
        At most `MAX_REJECTIONS` of them, spread evenly over the photo and the reasons.
    counts : mapping of str to int
        How many windows every reason holds for, complete.
    warnings : tuple of str
        What concerns the photo as a whole, in words for the user.
    """

    patches: tuple[Patch, ...]
    rejected: tuple[Rejection, ...]
    counts: Mapping[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
