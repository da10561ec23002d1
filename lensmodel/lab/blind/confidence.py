"""How honest a blind method is of its errors and its widths, from a report of `lensmodel bench blind`.

    lensmodel bench blind --photos sharp/ --methods default --noise 0.01 -o bench-output
    python -m lensmodel.lab.blind.confidence bench-output/blind.json

Printed for each method and noise: the share of cases above an error ratio of 3 before and after the
least confident 30 percent are dropped; the rank correlation of predicted and true error, and how often it
is right within 1.5 times; of second moments the median relative error, the share within 15 percent and
the share that is too large by more than 30 percent. Where the true PSF is a point (`--psfs` with a single
pixel): the share whose second moment stays below 0.3 px².
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

_POINT_PX = 0.1  # RMS width below which a true PSF is a point: one of a single pixel has 0 (chosen)
_DROPPED = 0.3  # share of the least confident (chosen)


def summary(rows: list[dict[str, Any]]) -> str:
    """Return the figures of one method at one noise level."""
    confidence, ratio, predicted, error, width, true = (
        np.array([row[key] for row in rows], dtype=np.float64)
        for key in ("confidence", "error_ratio", "predicted_error", "rel_l2", "width_px", "true_width_px")
    )
    if np.median(true) < _POINT_PX:
        least = f"{(width**2 < 0.3).mean():.0%}, median {np.median(width**2):.2f}"
        return f"sharp; second moment below 0.3 px²: {least}"
    kept = ratio[np.argsort(-confidence, kind="stable")[: round((1.0 - _DROPPED) * len(rows))]]
    moments = width**2 / true**2 - 1.0
    # A method that expects the same error everywhere ranks nothing.
    rank = stats.spearmanr(predicted, error).statistic if np.ptp(predicted) > 0 else 0.0
    return (
        f"ER > 3: {(ratio > 3).mean():.0%}, of the more confident 70 %: {(kept > 3).mean():.0%}; "
        f"predicted error: Spearman {rank:.2f}, within 1.5x "
        f"{(np.abs(np.log(predicted / error)) < np.log(1.5)).mean():.0%}; second moments: median "
        f"{np.median(moments):+.0%}, within 15 % {(np.abs(moments) < 0.15).mean():.0%}, "
        f"too large by 30 % {(moments > 0.3).mean():.0%}"
    )


def main() -> None:
    """Parse the command line and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("report", type=Path, nargs="+")
    for path in parser.parse_args().report:
        groups: dict[tuple[str, float], list[dict[str, Any]]] = {}
        for row in json.loads(path.read_text(encoding="utf-8"))["cases"]:
            if row["confidence"] is not None:
                groups.setdefault((row["method"], row["noise"]), []).append(row)
        for (method, noise), rows in groups.items():
            print(f"{method}, {100 * noise:g} %, {len(rows)} cases: {summary(rows)}")


if __name__ == "__main__":
    main()
