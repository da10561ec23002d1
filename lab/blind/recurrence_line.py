"""Fit the expected error of patch recurrence: `recurrence_error` in lensmodel/blind/data/fitted.json.

    lensmodel bench blind --photos sharp/ --methods michaeli-irani --half dev --noise 0.01 --cases 24
    python -m lab.blind.recurrence_line bench-output/blind.json

Or of cases that were stored before, all or those of a half:

    python -m lab.blind.recurrence_line docs/lab/blind-cases.jsonl.xz --half dev

How far the halves of a patch disagree is read back from the error that the method predicted, by the line in
use. Where that was held at 1 nothing can be read, and such cases are left out. Printed are the line of least
squares through the true errors, its standard errors, and the line in use.
"""

from __future__ import annotations

import argparse
import json
import lzma
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lab.cases import photo_half, psf_half
from lensmodel.blind.patch_recurrence import PatchRecurrence
from lensmodel.core.files import fitted

_USED: Final[Mapping[str, float]] = fitted("blind")["recurrence_error"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RecurrenceLine:
    """error = at_agreement + by_disagreement * disagreement, all relative L2 distances."""

    at_agreement: float
    by_disagreement: float
    spread: tuple[float, float]  # standard errors of the two


def line_through(disagreement: Floats, error: Floats) -> RecurrenceLine:
    """Fit the line of least squares."""
    design = np.stack([np.ones_like(disagreement), disagreement], axis=1)
    (at, by), *_ = np.linalg.lstsq(design, error, rcond=None)
    left = error - design @ (at, by)
    variance = np.linalg.inv(design.T @ design) * (left @ left) / (len(error) - 2)
    return RecurrenceLine(float(at), float(by), (math.sqrt(variance[0, 0]), math.sqrt(variance[1, 1])))


def rows_of(path: Path) -> list[dict[str, Any]]:
    """Read the cases of patch recurrence from a report, or from lines of stored cases, packed or not."""
    if path.suffix == ".json":
        rows = json.loads(path.read_text(encoding="utf-8"))["cases"]
    else:
        opened = lzma.open if path.suffix == ".xz" else open
        with opened(path, "rt", encoding="utf-8") as lines:
            rows = [json.loads(line) for line in lines]
    return [row for row in rows if row["method"] == PatchRecurrence.name and not row["declined"]]


def is_of(half: str, case: str) -> bool:
    """Say whether the photo and the PSF of a case, as `Case.name` calls them, both belong to a half."""
    window, psf = case.split("/")
    return half == "all" or photo_half(window.split("+")[0]) == psf_half(int(psf[3:])) == half


def readings(rows: Sequence[Mapping[str, Any]]) -> tuple[Floats, Floats]:
    """Disagreement and true error of the cases whose predicted error is no bound, shape (n,) each."""
    below = [row for row in rows if row["predicted_error"] < 1.0]
    predicted, error = (
        np.array([row[key] for row in below], dtype=np.float64) for key in ("predicted_error", "rel_l2")
    )
    return (predicted - _USED["at_agreement"]) / _USED["by_disagreement"], error


def main() -> None:
    """Fit and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cases", type=Path, help="blind.json, or lines of stored cases")
    parser.add_argument("--half", choices=("dev", "test", "all"), default="all")
    asked = parser.parse_args()
    rows = [row for row in rows_of(asked.cases) if is_of(asked.half, row["case"])]
    disagreement, error = readings(rows)
    line = line_through(disagreement, error)
    of_agreement, of_disagreement = line.spread
    print(
        f"{len(error)} of {len(rows)} cases; means: halves {disagreement.mean():.3f} apart, "
        f"error {error.mean():.3f}"
    )
    print(
        f'"recurrence_error": {{"at_agreement": {line.at_agreement:.2f}, "by_disagreement": '
        f"{line.by_disagreement:.2f}}}, standard errors {of_agreement:.2f} and {of_disagreement:.2f}; "
        f"in use: {_USED['at_agreement']}, {_USED['by_disagreement']}"
    )


if __name__ == "__main__":
    main()
