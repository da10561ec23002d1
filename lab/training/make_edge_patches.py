"""Make the prior of the estimator `sun`: small windows of ideal edges, and how steep they are.

Run as ``python -m lab.training.make_edge_patches``; writes
lab/data/edge_patches.npz. Everything is drawn here: steps, bars and corners integrated over
the pixel, and the steepness of the strongest edges of dead-leaves scenes. No photograph takes part.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lab.blind.steps.edge_patches import SIDE, edge_mask, steepness_of
from lab.blind.steps.pyramid import View
from lab.scenes import dead_leaves
from lensmodel.core.types import NoiseModel

COUNT: Final = 220  # windows of the prior (chosen)
ANGLES: Final = 32  # of edges in a turn (chosen)
SCENES: Final = 6  # of dead leaves (chosen)
QUANTILES: Final = 64  # of the steepness (chosen)

OUT: Final = Path(__file__).parents[1] / "data" / "edge_patches.npz"

_FINE = 8  # samples a pixel along each axis (chosen)


def primitives() -> NDArray[np.float64]:
    """Windows `(n, SIDE²)` of steps, bars and corners, zero mean, unit norm."""
    t = (np.arange(SIDE * _FINE) + 0.5) / _FINE - SIDE / 2.0
    down, across = t[:, None], t[None, :]
    drawn = []
    # A quarter of the circle is enough: every window comes with its turns.
    for angle in np.arange(ANGLES // 4) * 2.0 * math.pi / ANGLES:
        u = math.cos(angle) * across - math.sin(angle) * down
        v = math.sin(angle) * across + math.cos(angle) * down
        for place in (-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5):
            drawn.append(u > place)
            drawn.extend((u > place) & (u < place + width) for width in (1.0, 2.0))
            drawn.extend((u > place) & (v > other) for other in (-1.0, 0.0, 1.0))
    fine = np.stack(drawn).astype(np.float64)
    pixels = fine.reshape(len(fine), SIDE, _FINE, SIDE, _FINE).mean(axis=(2, 4)).reshape(len(fine), -1)
    pixels -= pixels.mean(axis=1, keepdims=True)
    norm = np.linalg.norm(pixels, axis=1)
    strong = norm > 0.2 * norm.max()
    return np.asarray(pixels[strong] / norm[strong, None])


def spread(windows: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Pick windows far from each other, each with its turns by 90 degrees and its negative."""
    chosen: list[NDArray[np.float64]] = []
    nearest = np.full(len(windows), -1.0)
    pick = 0
    while len(chosen) < count:
        square = windows[pick].reshape(SIDE, SIDE)
        orbit = [s * np.rot90(square, turn).ravel() for turn in range(4) for s in (1.0, -1.0)]
        for one in orbit:
            if all(float(one @ other) < 1.0 - 1e-6 for other in chosen):
                chosen.append(one)
                nearest = np.maximum(nearest, windows @ one)
        pick = int(nearest.argmin())
    return np.stack(chosen)


def steepness() -> NDArray[np.float64]:
    """Quantiles of the steepness of edge windows in sharp scenes."""
    found = []
    for seed in range(SCENES):
        plane = dead_leaves(256, 256, np.random.default_rng(seed), largest=60.0)[1]
        view = View.of(plane.astype(np.float32), NoiseModel.white(0.0))
        found.append(steepness_of(view.y)[edge_mask(view.y)])
    return np.quantile(np.concatenate(found), (np.arange(QUANTILES) + 0.5) / QUANTILES)


def main() -> None:
    """Write the file."""
    OUT.parent.mkdir(exist_ok=True)
    np.savez_compressed(
        OUT,
        patches=spread(primitives(), COUNT).astype(np.float32),
        steepness=steepness().astype(np.float32),
    )


if __name__ == "__main__":
    main()
