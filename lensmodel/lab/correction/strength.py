"""How near the automatic strength of `standard` comes to the best one chosen against the truth.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.correction.strength [--kinds coma] [--pairs 2]

Lenses, windows and photographs of `correct_quality.py`, which nothing was tuned on, the true PSF field, at
base ISO, at high ISO and half way between. Prints for each exposure and zone the gain in PSNR of the
automatic setting, the best of a grid of prior weights and strengths, and how far the first is behind.
"""

from __future__ import annotations

import argparse
import itertools
import os
from pathlib import Path
from typing import Final

import numpy as np

from lensmodel.core.types import ZONES, LensSettings, NoiseModel
from lensmodel.correction import SparseGradient
from lensmodel.lab.correction.quality import EXPOSURES, composed, corrected, exposed, view
from lensmodel.lab.correction.quality_table import KINDS, PAIRS
from lensmodel.lab.images import psnr
from lensmodel.simulate import draw_lens

BETWEEN: Final = NoiseModel(1 / 11_000, 0.0017**2)  # 11,000 electrons: between base and high ISO (chosen)
WEIGHTS: Final = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0)  # factors that are tried (chosen)
STRENGTHS: Final = (0.7, 0.85, 1.0)  # that are tried (chosen)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS))
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--pairs", type=int, default=1, choices=range(1, len(PAIRS) + 1))
    wanted = parser.parse_args()
    folder = Path(os.environ["LENSMODEL_TEST_DATA"]) / "sharp"
    exposures = {"base ISO": EXPOSURES["base ISO"], "between": BETWEEN, "high ISO": EXPOSURES["high ISO"]}
    behind: list[float] = []
    print("| lens | exposure | automatic, dB | best of the grid | prior x, strength | behind |")
    print("|---|---|---|---|---|---|", flush=True)
    for kind in wanted.kinds:
        field = draw_lens(wanted.seed, kind).field(LensSettings())
        scenes = [
            composed([next(folder.glob(f"{name}_*")) for name in pair]) for pair in PAIRS[: wanted.pairs]
        ]
        views = [[view(zone, scene, field) for zone in ZONES] for scene in scenes]
        for exposure, noise in exposures.items():
            # gains by photograph, zone, weight and strength
            gains = np.zeros((len(scenes), len(ZONES), len(WEIGHTS), len(STRENGTHS)))
            for number, zones in enumerate(views):
                rng = np.random.default_rng([wanted.seed, number])
                for z, at in enumerate(zones):
                    seen = exposed(at.light, noise, rng)
                    before, truth = at.inner(seen), at.inner(at.scene)
                    plain = psnr(before, truth, srgb=True)
                    for w, factor in enumerate(WEIGHTS):
                        method = SparseGradient(weight=factor * SparseGradient().weight)
                        after = corrected(seen, at, field, noise, method)
                        for s, strength in enumerate(STRENGTHS):
                            mixed = before + np.float32(strength) * (after - before)
                            gains[number, z, w, s] = psnr(mixed, truth, srgb=True) - plain
            mean = gains.mean(axis=0)
            automatic = mean[:, WEIGHTS.index(1.0), STRENGTHS.index(1.0)]
            best = mean.reshape(len(ZONES), -1).max(axis=1)
            places = list(itertools.product(WEIGHTS, STRENGTHS))
            chosen = [places[int(one.argmax())] for one in mean.reshape(len(ZONES), -1)]
            behind += (best - automatic).tolist()
            cells = [
                " / ".join(f"{value:+.2f}" for value in automatic),
                " / ".join(f"{value:+.2f}" for value in best),
                " / ".join(f"{w:g}, {s:g}" for w, s in chosen),
                " / ".join(f"{value:.2f}" for value in best - automatic),
            ]
            print(f"| {kind} | {exposure} | " + " | ".join(cells) + " |", flush=True)
    within = sum(value <= 0.3 for value in behind)
    print(f"\n{within} of {len(behind)} within 0.3 dB, {max(behind):.2f} dB behind at most")


if __name__ == "__main__":
    main()
