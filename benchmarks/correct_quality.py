"""Gain of every correction method on simulated lenses, in decibels of the sRGB picture.

    LENSMODEL_TEST_DATA=... python benchmarks/correct_quality.py [--photos s01 s05] [--seeds 1000]

Photographs are blurred by simulated lenses that were never used for tuning (seeds from 1000 on),
noise of two exposures is added, and every method restores them with the true PSF. "denoising only" is
the standard method with a PSF that is a point: the gain that deblurring must be judged against.
"""

from __future__ import annotations

import argparse
import os
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lensmodel.blur import UniformBlur
from lensmodel.deconv import SparseGradient, correct_planes
from lensmodel.geometry import Frame
from lensmodel.psf import PsfField, delta
from lensmodel.quality import slanted_edge, zone_psnr
from lensmodel.simulate import BlurOptions, SimulatedLens, blurred, draw_lens, load_scene, slanted_edge_scene
from lensmodel.types import Channel, FieldPosition, Kernel, LensSettings, NoiseModel, Planes

EXPOSURES = {
    "base ISO": NoiseModel(1 / 50_000, 0.001**2),
    "high ISO": NoiseModel(1 / 2_500, 0.003**2),
}
KINDS = ("soft-fast", "astigmatism", "nearly-perfect")
METHODS = ("standard", "fast", "paper")
ZONES_SHOWN = ("center", "corner")


@dataclass(frozen=True)
class Point:
    """A lens without blur: what is left of a correction is its denoising."""

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return a point, everywhere."""
        return delta(size)


@dataclass(frozen=True)
class Constant:
    """One kernel everywhere."""

    kernel: Kernel

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel."""
        return self.kernel


def exposed(light: Planes, noise: NoiseModel, rng: np.random.Generator) -> Planes:
    """Light on the sensor with noise, clipped at saturation."""
    seen = light + rng.standard_normal(light.shape) * np.sqrt(noise.variance(light))
    return np.minimum(seen, 1.0).astype(np.float32)


def overshoot(lens: SimulatedLens, noise: NoiseModel, r: float) -> tuple[float, float, float]:
    """MTF50 before and after, and overshoot in percent, of an edge at radius r."""
    kernel = lens.field(LensSettings()).kernel_at(FieldPosition(r, 0.6), "g", 55)
    blur = UniformBlur(kernel)
    edge = slanted_edge_scene(294, 294, 0.15, dark=0.15, bright=0.75)
    frame = Frame(240, 240)
    rng = np.random.default_rng(5)
    seen = exposed(np.stack([blur.forward(edge)] * 3), noise, rng)
    fixed = correct_planes(seen, Constant(kernel), frame, noise=[noise] * 3).planes
    cut = np.s_[60:180, 60:180]
    before, after = slanted_edge(seen[1][cut]), slanted_edge(fixed[1][cut])
    return before.mtf50, after.mtf50, after.overshoot


def main() -> None:  # noqa: C901 - five nested loops are what a table is
    """Print one row per exposure, lens and method."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photos", nargs="+", default=["s02", "s05"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1000])
    parser.add_argument("--crop", nargs=2, type=int, default=[800, 1200], metavar=("ROWS", "COLS"))
    wanted = parser.parse_args()
    folder = Path(os.environ["LENSMODEL_TEST_DATA"]) / "sharp"
    gains: dict[tuple[str, str, str, str], list[float]] = defaultdict(list)
    rows, cols = wanted.crop
    for kind in KINDS:
        for seed in wanted.seeds:
            lens = draw_lens(seed, kind)
            field: PsfField = lens.field(LensSettings())
            for exposure, noise in EXPOSURES.items():
                for zone, r in (("center", 0.1), ("corner", 0.9)):
                    before, after, over = overshoot(lens, noise, r)
                    print(
                        f"{kind:15} {exposure} {zone:7} edge: "
                        f"MTF50 {before:.3f} -> {after:.3f}, overshoot {over:.1f} %"
                    )
            for name in wanted.photos:
                scene = load_scene(next(folder.glob(f"{name}_*")))[:, :rows, :cols]
                frame = Frame(scene.shape[1], scene.shape[2])
                light = blurred(scene, lens, LensSettings(), frame, BlurOptions(lateral=False))
                for exposure, noise in EXPOSURES.items():
                    seen = exposed(light, noise, np.random.default_rng(seed))
                    before = zone_psnr(seen, scene, frame, srgb=True, border=8)
                    for method in (*METHODS, "denoising only"):
                        start = time.process_time()
                        fixed = correct_planes(
                            seen,
                            Point() if method == "denoising only" else field,
                            frame,
                            noise=[noise] * 3,
                            method=SparseGradient() if method == "denoising only" else method,
                        ).planes
                        after = zone_psnr(fixed, scene, frame, srgb=True, border=8)
                        for zone in ZONES_SHOWN:
                            gains[exposure, kind, method, zone].append(after[zone] - before[zone])
                        print(
                            f"{kind:15} {seed} {name} {exposure} {method:15}"
                            + "".join(f" {zone} {after[zone] - before[zone]:+.2f}" for zone in ZONES_SHOWN)
                            + f"  ({time.process_time() - start:.1f} s)",
                            flush=True,
                        )
    print("\nmean gain in dB, center / corner")
    for exposure in EXPOSURES:
        for method in (*METHODS, "denoising only"):
            cells = [
                " / ".join(f"{np.mean(gains[exposure, kind, method, zone]):+.1f}" for zone in ZONES_SHOWN)
                for kind in KINDS
            ]
            print(f"| {exposure} | {method} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
