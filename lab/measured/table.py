"""Measured PSFs against the truth: targets, pairs, points and edges, beside blind estimates.

Every lens is photographed with a simulated camera at base ISO, whose DNG files hold a Bayer mosaic and
noise. The target stands a little turned and aslant, unevenly lit, bent by the lens, with tones of its own;
the second photo of a pair is moved by parts of a pixel and turned. Photos and results are kept in the
folder, so that a run that was stopped goes on.

    python -m lab.measured.table --output measured --seeds 1000,1004 \
        --traced tests/lensmodel/data/traced-heliar-f3.5.npz
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from lab.measured.run import KINDS, PAIR_GOAL, TARGET_GOAL, WayResult, measured, table
from lab.measured.shots import camera_of, third_order, traced


def main() -> None:
    """Run the benchmark and print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("measured"), help="folder of photos and results")
    parser.add_argument("--seeds", default="1000,1004", help="of third-order lenses")
    parser.add_argument("--traced", default="", help="grids of traced lenses; OPEN:CLOSED for pairs")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--channels", default="gr", help="colours to measure, of r, g and b")
    parser.add_argument("--height", type=int, default=640)
    parser.add_argument("--width", type=int, default=960)
    parser.add_argument("--size", type=int, default=25, help="side of the kernels that are compared")
    parser.add_argument("--detail", type=int, default=900, help="samples of the page's long side")
    asked = parser.parse_args()
    camera = camera_of(asked.height, asked.width)
    benches = [third_order(int(seed), camera) for seed in asked.seeds.split(",") if seed]
    for entry in filter(None, asked.traced.split(",")):
        opened, _, closed = entry.partition(":")
        benches.append(traced(Path(opened), Path(closed) if closed else None, camera))
    rows: list[WayResult] = []
    for bench in benches:
        folder = asked.output / f"{bench.name.replace(' ', '-').replace('/', '')}-{asked.height}"
        for kind in asked.kinds.split(","):
            if kind in {"pair", "blind"} and bench.closed is None:
                continue
            rows.append(
                measured(
                    bench, kind, folder, detail=asked.detail, size=asked.size, channels=tuple(asked.channels)
                )
            )
            print(table(rows[-1:]).splitlines()[-1], flush=True)
    print("\n" + table(rows))
    for kind, goal in (("target", TARGET_GOAL), ("pair", PAIR_GOAL)):
        green = [row.error["g"] for row in rows if row.kind == kind and "g" in row.error]
        if green:
            middle = float(np.median(green))
            verdict = "reached" if middle <= goal else "not reached"
            print(f"{kind}: median error {middle:.3f} over {len(green)} lenses, goal {goal}: {verdict}")
    (asked.output / "measured.json").write_text(json.dumps([asdict(row) for row in rows], indent=1))


if __name__ == "__main__":
    main()
