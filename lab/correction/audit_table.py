r"""What the audit of corrections catches, what it holds back of sound ones, and what it costs.

    LENSMODEL_TEST_DATA=... python -m lab.correction.audit_table \
        [--half "held out"] [--cache FOLDER] [--every N]
    LENSMODEL_TEST_DATA=... python -m lab.correction.audit_table --limits
    LENSMODEL_TEST_DATA=... python -m lab.correction.audit_table --cost

Simulated lenses of five kinds photograph pairs of sharp photographs in center, mid and corner, on planes and
on mosaics, at base and high ISO. Blocks of 128 x 128 pixels that gain with the true PSF must be left alone;
blocks that lose more than 1 dB against the photo by a fault must be caught: more than a tenth of the
correction held back, or half of the error beyond the photo's gone. The limits of the checks were chosen on
the half "development", with `--limits`; the table of docs/lab/correction.md is of the other half.

`--limits` prints, for each check, the limit at which no sound block of the development half is held back
by more than a tenth by it alone, and the quantiles below; of a mosaic, over what `tolerances.MOSAIC` allows.
`--blind` tells the audit no PSF, as `lensmodel check` without a profile. `--cost` corrects a photo of planes
and one of a mosaic in turn with and without the audit, and prints the share of time that it adds.

Corrections are kept in the cache folder as they are before the audit; some ten minutes on an idle core to
make them all, four to judge them.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

import numpy as np

from lab.correction.audit_figures import (
    HALO,
    BlockVerdict,
    blocks,
    factors,
    judged,
    shares,
    table,
)
from lab.correction.audit_trials import BLOCK, HALVES, SOUND, AuditCase, cases, trial
from lensmodel.correction.audit import CHECKS
from lensmodel.correction.audit.tolerances import LIMITS


def main() -> None:
    """Judge one half, or print limits."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--half", default="held out", choices=list(HALVES))
    parser.add_argument("--cache", type=Path, default=Path("audit-trials"))
    parser.add_argument("--every", type=int, default=1, metavar="N", help="Only every Nth case.")
    parser.add_argument("--limits", action="store_true")
    parser.add_argument("--cost", action="store_true")
    parser.add_argument("--blind", action="store_true")
    parser.add_argument("--json", type=Path, metavar="FILE", help="Keep every verdict.")
    wanted = parser.parse_args()
    folder = Path(os.environ["LENSMODEL_TEST_DATA"]) / "sharp"
    chosen = cases("development" if wanted.limits else wanted.half)[:: wanted.every]
    if wanted.cost:
        print_cost(folder)
        return
    if wanted.limits:
        print_limits(chosen, folder, wanted.cache)
        return
    verdicts: list[BlockVerdict] = []
    seconds = 0.0
    for case in chosen:
        for block in blocks(trial(case, folder, wanted.cache), reblur=not wanted.blind):
            verdict, spent = judged(block)
            verdicts.append(verdict)
            seconds += spent
    print("\n".join(table(verdicts)))
    megapixels = len(verdicts) * (BLOCK + 2 * HALO) ** 2 / 1e6
    print(f"\n{seconds / megapixels:.2f} s of one core a megapixel, halos included")
    sound = [v for v in verdicts if v.made in SOUND and v.gain > 0.0]
    print("\nsound blocks held back by more than a tenth, by check:")
    for name in CHECKS:
        print(f"  {name:16} {np.mean([v.checks[name] > 0.1 for v in sound]):.2%}")
    if wanted.json is not None:
        kept = [
            {"made": v.made, "mosaic": v.mosaic, "gain": v.gain, "after": v.after, "held": v.held_back}
            | {"checks": v.checks}
            for v in verdicts
        ]
        wanted.json.write_text(json.dumps(kept), encoding="utf-8")


def print_cost(folder: Path) -> None:
    """Print the time of the audit over that of the correction without it: median and range of 5 pairs."""
    for case in cases("development")[:2]:
        for method in ("standard", "fast"):
            found = shares(case, folder, method, 5)
            share, low, high = np.median(found), min(found), max(found)
            print(f"{'mosaic' if case.mosaic else 'planes'}, {method}: {share:.2f} ({low:.2f} to {high:.2f})")


def print_limits(chosen: tuple[AuditCase, ...], folder: Path, cache: Path) -> None:
    """Print for each check what its limit has to be for the sound blocks, and what the faults would need."""
    start = time.perf_counter()
    found: dict[str, list[dict[str, float]]] = {}
    for case in chosen:
        for block in blocks(trial(case, folder, cache)):
            if block.sound or (block.made not in SOUND and block.gain < -1.0):
                found.setdefault("sound" if block.sound else block.made, []).append(factors(block))
    print(f"{sum(map(len, found.values()))} blocks in {time.perf_counter() - start:.0f} s")
    for name in CHECKS:
        values = np.array([f[name] for f in found["sound"]]) * LIMITS[name]
        line = ", ".join(f"{q:.1%} {np.quantile(values, q):.3g}" for q in (0.5, 0.95, 0.99, 0.995, 1.0))
        print(f"{name}: limit {LIMITS[name]:g}; sound: {line}")
        for made, rows in found.items():
            if made != "sound":
                own = np.array([f[name] for f in rows]) * LIMITS[name]
                share = float((own > values.max()).mean())
                print(f"    {made:26} {len(own):4} blocks, median {np.median(own):.3g}, beyond: {share:.0%}")


if __name__ == "__main__":
    main()
