"""Speed and size of the lens model as ratios of one run; prints the table of docs/lab/lens-model.md.

    python -m lensmodel.lab.model.speed [--samples 1000] [--many 100000] [--methods combined nadaraya-watson]

Peer: scipy's cKDTree over the flat cloud of (u, v, r, cos phi, sin phi) points of the same samples, 200
nearest for every pixel of the answer, as the paper describes. CPU seconds of the process, medians.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from lensmodel.core.psf import PsfSample, gaussian
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings
from lensmodel.lab.local_frame import pixel_to_local
from lensmodel.lab.model.smoothers import make_known
from lensmodel.model import LensModel, ModelSettings

SIDE, NEAREST = 31, 200  # pixels of a kernel; samples that the peer averages
_DRAWN = 5000  # samples that differ; then they come again (chosen)
PER_PHOTO = 24  # patches of a calibration
GRID = (20, 30)  # rows and columns of a map (chosen)
SETTINGS = LensSettings(aperture=2.8, channel="g")


def lens(count: int) -> list[PsfSample]:
    """Make samples of a family of kernels that are wide along v and grow outwards, 24 to a photo.

    After some thousands the same come again in other photos: it is the model that is measured.
    """
    rng = np.random.default_rng(0)
    found: list[PsfSample] = []
    for i in range(count):
        if i >= _DRAWN:
            before = found[i % _DRAWN]
            found.append(replace(before, photo=f"p{i // PER_PHOTO}"))
            continue
        r = math.sqrt(rng.uniform(0.0, 0.95))
        along, across = 0.8 + 1.2 * r * r, 1.0 + 2.0 * r * r
        phi = float(rng.uniform(-math.pi, math.pi))
        c, s = math.cos(phi), math.sin(phi)
        u, v = np.array([-s, c]), np.array([-c, -s])
        kernel = gaussian(SIDE, along**2 * np.outer(u, u) + across**2 * np.outer(v, v))
        settings = SETTINGS.with_channel(CHANNELS[i % 3])
        found.append(PsfSample(kernel, FieldPosition(r, phi), settings, photo=f"p{i // PER_PHOTO}"))
    return found


def asking(model: LensModel, places: Sequence[FieldPosition]) -> Callable[[], object]:
    """Make a call that asks for the next place each time."""
    turns = iter(places)
    return lambda: model.query(next(turns), SETTINGS, SIDE)


def cpu(work: Callable[[], object], times: int) -> float:
    """Median CPU seconds."""
    found = []
    for _ in range(times):
        start = time.process_time()
        work()
        found.append(time.process_time() - start)
    return statistics.median(found)


def growth(model: LensModel, samples: list[PsfSample]) -> float:
    """Median CPU seconds of adding one sample after another."""
    found = []
    for sample in samples:
        start = time.process_time()
        model = model.added([sample])
        found.append(time.process_time() - start)
    return statistics.median(found)


def joining(photos: int) -> tuple[float, float, float]:
    """CPU seconds of a whole fit and of growth by a photo, and the largest relative L2 between both."""
    samples = lens(PER_PHOTO * (photos + 1))
    old, new = LensModel.fit(samples[: PER_PHOTO * photos]), samples[PER_PHOTO * photos :]
    fit, grow = cpu(lambda: old.refitted(samples), 3), cpu(lambda: old.grown(new), 3)
    kernels = (model.kernels(asked(12), SETTINGS, SIDE) for model in (old.grown(new), old.refitted(samples)))
    pairs = zip(*kernels, strict=True)
    return fit, grow, max(float(np.linalg.norm(a - b) / np.linalg.norm(b)) for a, b in pairs)


def points(samples: list[PsfSample], scale: np.ndarray) -> np.ndarray:
    """Place every pixel of every sample in units of bandwidths, shape (n * SIDE^2, 5)."""
    t = np.arange(SIDE, dtype=np.float64) - SIDE // 2
    clouds = []
    for s in samples:
        u, v = pixel_to_local(t[:, None], t[None, :], s.position.phi)
        place = [s.position.r, math.cos(s.position.phi), math.sin(s.position.phi)]
        clouds.append(np.column_stack([u.ravel(), v.ravel(), np.tile(place, (SIDE * SIDE, 1))]))
    return np.concatenate(clouds) / scale


def asked(count: int) -> list[FieldPosition]:
    """Draw places."""
    rng = np.random.default_rng(1)
    return [FieldPosition(float(r), float(p)) for r, p in rng.uniform((0, -3), (0.95, 3), (count, 2))]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--many", type=int, default=4000)
    parser.add_argument("--methods", nargs="+", default=["combined", "nadaraya-watson"])
    wanted = parser.parse_args()
    make_known()
    samples = lens(max(wanted.samples, wanted.many))
    few, places = samples[: wanted.samples], asked(15)

    scale = np.array([0.6, 0.6, 0.09, 0.3, 0.3])
    tree = cKDTree(points(few, scale))
    questions = [PsfSample(gaussian(SIDE, np.eye(2)), p, SETTINGS) for p in places[:5]]
    clouds = iter([points([q], scale) for q in questions])
    peer = cpu(lambda: tree.query(next(clouds), k=NEAREST), 5)
    print(f"flat cKDTree, {NEAREST} nearest, {len(few)} samples: {1e3 * peer:.1f} ms a PSF")
    print("| method | samples | fit s | warm s | PSF ms | of the tree | 30 x 20 x 3 s | add one ms | MiB |")
    print("|---|---|---|---|---|---|---|---|---|")
    for method in wanted.methods:
        for chosen in (few, samples[: wanted.many]):
            start = time.process_time()
            model = LensModel.fit(chosen, ModelSettings(method=method))
            fit = time.process_time() - start
            start = time.process_time()
            model = model.warmed()
            warm = time.process_time() - start
            model.query(places[0], SETTINGS, SIDE)  # builds the trees
            one = cpu(asking(model, places), len(places))
            start = time.process_time()
            for channel in CHANNELS:
                model.kernels(asked(GRID[0] * GRID[1]), SETTINGS.with_channel(channel), SIDE)
            grid = time.process_time() - start
            size, add = model.nbytes, growth(model, chosen[:12])
            print(
                f"| {method} | {len(chosen)} | {fit:.2f} | {warm:.2f} | {1e3 * one:.2f} | {one / peer:.3f} "
                f"| {grid:.2f} | {1e3 * add:.1f} | {size / 2**20:.0f} |",
                flush=True,
            )
    print("\n| photos | fitted anew s | grown ms | apart |\n|---|---|---|---|")
    for photos in (1, 2, 5, 10):
        fit, grow, apart = joining(photos)
        print(f"| {photos} and one more | {fit:.3f} | {1e3 * grow:.1f} | {apart:.3f} |", flush=True)


if __name__ == "__main__":
    main()
