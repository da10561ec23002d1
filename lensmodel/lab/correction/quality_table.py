"""Gain of every correction method, and of programs in use, on lenses and photographs nothing was tuned on.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.correction.quality_table [--kinds coma] [--cache FOLDER]

Prints the tables of docs/lab/correction.md: gain in PSNR of the sRGB picture in center, mid and corner of a
frame of 6 megapixels with the true PSF field, SSIM, edges, noise in flats, and light near clipped lamps.
Each lens and exposure is kept in the cache folder, so that a run that was stopped goes on where it was.
Some ten minutes on an idle core.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lensmodel.core.psf import PsfField
from lensmodel.core.types import ZONES, LensSettings, Planes
from lensmodel.lab.correction.quality import (
    EXPOSURES,
    FrameWindow,
    composed,
    edge_figures,
    gains_of,
    lamp_gains,
    our_methods,
    view,
)
from lensmodel.lab.peers import PEERS
from lensmodel.simulate import draw_lens

KINDS = ("soft-fast", "coma", "astigmatism", "decentred", "nearly-perfect")
PAIRS = (("s05", "s17"), ("s19", "s21"))
LAMPS = ("s06", "s01")
LAMP_GAIN = 2.5  # by which lamps outshine the scene (chosen)


@dataclass(frozen=True)
class PhotographedLens:
    """A lens and what was photographed through it, without noise; made once for all exposures."""

    field: PsfField
    views: list[list[FrameWindow]]
    lamps: FrameWindow

    @classmethod
    def draw(cls, kind: str, seed: int, pairs: int) -> PhotographedLens:
        """Photograph everything through one lens."""
        folder = Path(os.environ["LENSMODEL_TEST_DATA"]) / "sharp"
        field = draw_lens(seed, kind).field(LensSettings())

        def scene(names: tuple[str, ...], gain: float = 1.0) -> Planes:
            return composed([next(folder.glob(f"{name}_*")) for name in names], gain)

        views = [[view(zone, scene(pair), field) for zone in ZONES] for pair in PAIRS[:pairs]]
        return cls(field, views, view("mid", scene(LAMPS, LAMP_GAIN), field))


def measured(lens: PhotographedLens, seed: int, exposure: str, programs: Sequence[str]) -> dict[str, object]:
    """Everything about one lens at one exposure."""
    noise, peers = EXPOSURES[exposure], [peer for peer in PEERS if peer.program in programs]
    runs = []
    for number, views in enumerate(lens.views):
        rng = np.random.default_rng([seed, number])
        runs.append(gains_of(views, lens.field, noise, methods=our_methods(), peers=peers, rng=rng))
    gains = {
        name: {zone: np.mean([run[name][zone] for run in runs], axis=0).tolist() for zone in ZONES}
        for name in runs[0]
    }
    ours = {name: method for name, method in our_methods().items() if "prior" not in name}
    edges = {
        zone: asdict(edge_figures(lens.field, noise, r)) for zone, r in (("center", 0.1), ("corner", 0.9))
    }
    return {"gains": gains, "lamps": lamp_gains(lens.lamps, lens.field, noise, ours), "edges": edges}


def main() -> None:
    """Measure what is not yet known, then print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS))
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--pairs", type=int, default=1, choices=range(1, len(PAIRS) + 1))
    parser.add_argument("--peers", nargs="*", default=["gmic", "rawtherapee-cli"], metavar="PROGRAM")
    parser.add_argument("--cache", type=Path, default=Path("correct-quality"))
    wanted = parser.parse_args()
    wanted.cache.mkdir(parents=True, exist_ok=True)
    found: dict[str, dict[str, dict[str, Any]]] = {exposure: {} for exposure in EXPOSURES}
    for kind in wanted.kinds:
        lens: PhotographedLens | None = None
        for exposure in EXPOSURES:
            path = wanted.cache / f"{kind}-{wanted.seed}-{exposure.replace(' ', '-')}.json"
            start = time.perf_counter()
            if not path.exists():
                lens = lens or PhotographedLens.draw(kind, wanted.seed, wanted.pairs)
                numbers = measured(lens, wanted.seed, exposure, wanted.peers)
                path.write_text(json.dumps(numbers), encoding="utf-8")
            found[exposure][kind] = json.loads(path.read_text(encoding="utf-8"))
            print(f"{kind}, {exposure}: {time.perf_counter() - start:.0f} s", flush=True)
    for exposure, lenses in found.items():
        for index, (title, form) in enumerate((("PSNR, dB", "{:+.1f}"), ("SSIM", "{:+.3f}"))):
            print(f"\n| {exposure}, gain in {title} | " + " | ".join(lenses) + " |")
            print("|---|" + "---|" * len(lenses))
            for name in next(iter(lenses.values()))["gains"]:
                cells = [
                    " / ".join(form.format(figures["gains"][name][zone][index]) for zone in ZONES)
                    for figures in lenses.values()
                ]
                print(f"| {name} | " + " | ".join(cells) + " |")
        print(f"\n| {exposure}, near clipped lamps, dB | " + " | ".join(lenses) + " |")
        print("|---|" + "---|" * len(lenses))
        for name in next(iter(lenses.values()))["lamps"]:
            print(
                f"| {name} | "
                + " | ".join(f"{figures['lamps'][name]:+.1f}" for figures in lenses.values())
                + " |"
            )
        print(f"\n| {exposure}, edge: MTF50 before, after, overshoot %, noise gain | center | corner |")
        print("|---|---|---|")
        for kind, figures in lenses.items():
            cells = [
                f"{e['before']:.3f}, {e['after']:.3f}, {e['overshoot']:.1f}, {e['noise']:.2f}"
                for e in figures["edges"].values()
            ]
            print(f"| {kind} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
