"""Conversion of patches between rows, tasks and the library."""

from __future__ import annotations

from collections import Counter
from typing import Any

from app.store import NewPatch
from app.store.tables import PatchRow
from lensmodel.core.types import FieldPosition
from lensmodel.patches import Patch


def plan_of(selection: dict[str, Any]) -> list[NewPatch]:
    """Return the patches and windows of the task `select` as rows to insert."""
    chosen = [
        NewPatch(
            idx=number,
            row=patch["row"],
            col=patch["col"],
            size=patch["size"],
            r=patch["position"]["r"],
            phi=patch["position"]["phi"],
            cell=patch["cell"],
            score=patch["score"],
        )
        for number, patch in enumerate(selection["patches"])
    ]
    rejected = [
        NewPatch(
            idx=len(chosen) + number,
            row=window["row"],
            col=window["col"],
            size=window["size"],
            r=window["r"],
            phi=window["phi"],
            rejected=window["reason"],
        )
        for number, window in enumerate(selection["rejected"])
    ]
    return chosen + rejected


def described(row: PatchRow) -> dict[str, Any]:
    """Return a patch as JSON for a task."""
    place = {"r": row.r, "phi": row.phi}
    score = row.score or 0.0
    return {
        "row": row.row,
        "col": row.col,
        "size": row.size,
        "position": place,
        "score": score,
        "cell": row.cell,
    }


def patch_of(row: PatchRow) -> Patch:
    """Return a patch as a value of the library."""
    return Patch(row.row, row.col, row.size, FieldPosition(row.r, row.phi), row.score or 0.0, row.cell or 0)


def why_not(tried: list[PatchRow], good: int) -> tuple[str, str]:
    """Return why a photo with `good` useful patches does not count: a code and a sentence."""
    failures = Counter(row.reason for row in tried if row.state == "failed")
    if failures and good == 0:
        reason, count = failures.most_common(1)[0]
        text = f"{count} of {len(tried)} patches ended with {reason}; retry, or report the file"
        return reason or "internal_error", text
    return (
        "no_usable_patches",
        f"{good} of {len(tried)} patches gave a PSF: use a photo with more fine detail in focus",
    )
