"""Windows of a photo that were rejected before estimation: one compact value, not thousands of rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from app.store.tables import PatchRow

DIGITS: Final = 4
"""Decimals of r and phi (chosen): they round to 0.2 pixels at most in a photo of 24 megapixels, whose half
diagonal is 3,600 pixels."""


@dataclass(frozen=True, slots=True)
class NewPatch:
    """A window that was chosen, or rejected with a reason."""

    idx: int
    row: int
    col: int
    size: int
    r: float
    phi: float
    cell: int | None = None
    score: float | None = None
    rejected: str | None = None


def packed(rejected: Sequence[NewPatch]) -> dict[str, Any]:
    """Return windows as one value that JSON can hold; each reason is stored once."""
    reasons = sorted({patch.rejected or "" for patch in rejected})
    numbers = {reason: number for number, reason in enumerate(reasons)}
    listed = [
        [
            *(patch.idx, patch.row, patch.col, patch.size),
            *(round(patch.r, DIGITS), round(patch.phi, DIGITS), numbers[patch.rejected or ""]),
        ]
        for patch in rejected
    ]
    return {"reasons": reasons, "windows": listed}


def unpacked(stored: dict[str, Any] | None) -> list[PatchRow]:
    """Return the windows of `packed` as rows that belong to no table."""
    if stored is None:
        return []
    return [
        PatchRow(
            idx=idx,
            row=row,
            col=col,
            size=size,
            r=r,
            phi=phi,
            state="rejected",
            reason=stored["reasons"][reason],
        )
        for idx, row, col, size, r, phi, reason in stored["windows"]
    ]
