"""Measured PSFs of simulated lenses against the truth: targets, pairs, points and edges, and blind estimates.

    python -m lab.measured --seeds 1000,1004 --traced GRID.npz --kinds target

Every lens is photographed at base ISO into DNG files with a Bayer mosaic and noise. The target stands turned,
aslant and unevenly lit, bent by the lens, with tones of its own; the second photo of a pair is moved by parts
of a pixel and turned.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from scipy import ndimage

from lab import targets
from lab.scenes import dead_leaves
from lab.traced import GridLens
from lensmodel import measured as measure
from lensmodel.core.errors import InvalidInputError, LensModelError
from lensmodel.core.psf import distance, resized
from lensmodel.core.types import Channel, FieldPosition, Kernel, LensSettings, Planes
from lensmodel.measured.target import Target
from lensmodel.photo import develop
from lensmodel.simulate import (
    BlurOptions,
    SimulatedCamera,
    SimulatedLens,
    SimulatedPhoto,
    draw_lens,
    photograph,
    write_photo,
)
from lensmodel.workflow import sampling

KINDS: Final = ("target", "pair", "points", "edges", "blind")
BASE_ISO_ELECTRONS: Final = 40_000.0  # full well of a pixel (chosen)
CLOSED_F_NUMBER: Final = 8.0  # of the second photo of a pair, as docs/topics/measuring.md asks
OPTIONS: Final = BlurOptions(size=41, step=0.05)
"""Between exact kernels lie splines: 0.1 half diagonals apart, the photo of a point in the corner of a
decentred lens was up to 22 percent off the kernel that it is compared with, 0.05 apart below 3 percent."""

_BLIND_PATCHES: Final = 6  # of a small frame (chosen)
_NEAR: Final = 1.5  # an expected error within this factor of the true one is right

Found = tuple[FieldPosition, Channel, Kernel, float]
"""Where, in which colour, the kernel, and the error that is expected of it."""


@dataclass(frozen=True, slots=True)
class Bench:
    """One lens before its camera, wide open and closed; `closed` is None where its PSFs are not known."""

    name: str
    lens: SimulatedLens | GridLens
    settings: LensSettings
    closed: LensSettings | None
    camera: SimulatedCamera
    seed: int

    @classmethod
    def drawn(cls, seed: int, camera: SimulatedCamera) -> Bench:
        """Return a lens of `simulate.draw_lens`."""
        lens = draw_lens(seed)
        settings = LensSettings(aperture=lens.widest(lens.focal_mm[0]), focal_mm=lens.focal_mm[0])
        closed = replace(settings, aperture=CLOSED_F_NUMBER)
        return cls(lens.model.removeprefix("Simulated "), lens, settings, closed, camera, seed)

    @classmethod
    def traced(cls, entry: str, camera: SimulatedCamera) -> Bench:
        """Return a ray-traced lens from `OPEN[:CLOSED]`, grids of one copy."""
        lens = GridLens.read(*map(Path, entry.split(":")))
        focal, numbers = lens.focal_mm[0], [grid.f_number for grid in lens.grids]
        closed = LensSettings(aperture=numbers[-1], focal_mm=focal) if len(numbers) > 1 else None
        settings = LensSettings(aperture=numbers[0], focal_mm=focal)
        return cls(lens.model.removeprefix("Traced "), lens, settings, closed, camera, 1)

    def take(self, kind: str, folder: Path, detail: int) -> list[Path]:
        """Take the photos of one measurement as DNG files."""
        shape, rng = (self.camera.height, self.camera.width), np.random.default_rng([self.seed, len(kind)])
        lift = targets.LIFT if kind == "points" else 0.0
        if kind == "target":
            setup = targets.Setup(fill=0.97)
            scene = 0.8 * targets.target_scene(measure.TargetPage(detail), shape, setup)
        elif kind == "edges":
            scene = targets.board_scene(shape[0] / 4.0, shape, targets.Setup())
        elif kind == "points":
            scene = targets.light_scene(64, shape, rng)
        else:
            scene = _detailed(shape, rng)
        paths = []
        for number, setting in enumerate([self.settings, self.closed] if kind == "pair" else [self.settings]):
            if setting is None:
                raise InvalidInputError(f"the PSFs of {self.name} closed down are not known")
            # the tripod gives way a little, and the lens is handled between the two
            seen = targets.moved_scene(scene, (0.37, -0.81), 0.05) if number else scene
            paths.append(folder / f"{kind}-{number}.dng")
            write_photo(paths[-1], self._photo(setting, seen, rng, lift))
        return paths

    def _photo(
        self, setting: LensSettings, scene: Planes, rng: np.random.Generator, lift: float
    ) -> SimulatedPhoto:
        """Photograph a scene; one that is negative somewhere is lifted before the blur, lowered after it."""
        if not lift:
            return photograph(scene, self.lens, setting, self.camera, rng, options=OPTIONS)
        lifted, dark = (
            photograph(planes, self.lens, setting, self.camera, None, options=OPTIONS)
            for planes in (scene + np.float32(lift), np.full_like(scene, lift))
        )
        clean = np.maximum(lifted.clean - dark.clean, 0.0)
        return replace(lifted, clean=clean, mosaic=self.camera.mosaic(clean, rng))

    def row(self, kind: str, folder: Path, detail: int, size: int, channels: Sequence[Channel]) -> list[str]:
        """Measure in one way, and compare with the truth: places, errors, what was expected, CPU seconds."""
        try:
            paths = self.take(kind, folder, detail)
            began = time.process_time()
            found = list(_found(kind, paths, detail, size, channels))
        except LensModelError as refused:
            return [self.name, kind, f"refused: {refused}", *[""] * 5]
        seconds = time.process_time() - began
        truth = self.lens.field(self.settings)
        expected = np.array([told for *_, told in found])
        true = np.array(
            [distance(k, resized(truth.kernel_at(p, c, size), size)).rel_l2 for p, c, k, _ in found]
        )
        error = {c: true[[channel == c for _, channel, _, _ in found]] for c in channels}
        green, ratio = error.get("g", true), expected / np.maximum(true, 1e-9)
        return [
            self.name,
            kind,
            str(len(green)),
            " / ".join(f"{np.median(values):.3f}" for values in error.values() if values.size),
            f"{np.quantile(green, 0.9):.3f}",
            f"{np.median(expected):.3f}",
            f"{np.mean((ratio >= 1.0 / _NEAR) & (ratio <= _NEAR)):.0%}",
            f"{seconds:.0f}",
        ]


def _found(
    kind: str, paths: Sequence[Path], detail: int, size: int, channels: Sequence[Channel]
) -> Iterator[Found]:
    if kind == "blind":
        yield from _blind(paths[0], size)
        return
    method = Target(details=(detail,)) if kind == "target" else measure.methods.create(kind)
    for one in method.measure([develop(path) for path in paths], size=size, channels=channels):
        yield one.position, one.channel, one.kernel, one.error


def _blind(path: Path, size: int) -> Iterator[Found]:
    """Blind estimates of a few patches of the same photo, green only."""
    photo = develop(path)
    for group in sampling.patches_by_cell(sampling.find_patches(photo, count=_BLIND_PATCHES)):
        cells = sampling.estimate_cell(
            photo,
            group,
            settings=sampling.settings_of(photo),
            photo_id="bench",
            size=size,
            channels=("g",),
        )
        for sample in (cell.sample for cell in cells):
            yield sample.position, "g", sample.kernel, 1.0 if sample.error is None else sample.error


def _detailed(shape: tuple[int, int], rng: np.random.Generator) -> Planes:
    """A scene with detail of all sizes, not too bright to clip, without frequencies beyond the pixels'."""
    height, width = (n + 2 * targets.MARGIN for n in shape)
    leaves = dead_leaves(height, width, rng, smallest=1.0)
    grain = 1.0 + 0.15 * ndimage.gaussian_filter(rng.standard_normal((height, width)), 0.7) / 0.4
    return np.ascontiguousarray(np.clip(0.05 + 0.7 * leaves * grain, 0.0, 0.9), dtype=np.float32)


def main() -> None:
    """Run the benchmark and print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", default="1000,1004", help="of third-order lenses")
    parser.add_argument("--traced", default="", help="grids of traced lenses; OPEN:CLOSED for pairs")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--channels", default="gr", help="colours to measure, of r, g and b")
    parser.add_argument("--height", type=int, default=640)
    parser.add_argument("--width", type=int, default=960)
    parser.add_argument("--size", type=int, default=25, help="side of the kernels that are compared")
    parser.add_argument("--detail", type=int, default=900, help="samples of the page's long side")
    asked = parser.parse_args()
    camera = SimulatedCamera(height=asked.height, width=asked.width, full_well_electrons=BASE_ISO_ELECTRONS)
    benches = [Bench.drawn(int(seed), camera) for seed in asked.seeds.split(",") if seed]
    benches += [Bench.traced(entry, camera) for entry in asked.traced.split(",") if entry]
    print("| lens | way | places | error | nine in ten below | expected | right | CPU s |")
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        for bench in benches:
            for kind in asked.kinds.split(","):
                row = bench.row(kind, Path(name), asked.detail, asked.size, tuple(asked.channels))
                print("| " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
