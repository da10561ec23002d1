"""What a photo gains that is corrected by a lens known only from other photos, and whether any of it loses.

    LENSMODEL_TEST_DATA=... python benchmarks/blind_gain.py --seeds 1000:1008 --photos 1 2 [--grids FILE.npz]

Each lens takes photos of 1.2 megapixels of different photographs of the test half (the development half for
seeds below 1000), as Bayer DNG files of 20,000 electrons at saturation. The lens is learned from the first n
by default settings, and one that was not learned from is corrected by default settings. Lenses are of
third-order theory by `--seeds`, or ray-traced ones by `--grids` (`lensmodel.bench.traced`).

Printed are the gains in PSNR of the white-balanced sRGB picture against the sharp scene over the developed
photo, by zone; the expected gains that the correction foretold; the median error of the PSFs of green at
places all over the field, true and expected; the share of blocks of 128 pixels that lose more than 0.5 dB,
and the worst of them. Some two minutes a photo on one core.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel import deconv, photo, pipeline
from lensmodel.bench.cases import list_photos, photo_half
from lensmodel.bench.traced import GridLens, read_grid
from lensmodel.errors import NotEnoughEvidenceError
from lensmodel.psf import PsfSample, distance
from lensmodel.quality import psnr
from lensmodel.regression import LensModel, ModelSettings
from lensmodel.simulate import (
    SimulatedCamera,
    SimulatedLens,
    SimulatedPhoto,
    draw_lens,
    load_scene,
    photograph,
    write_photo,
)
from lensmodel.types import ZONES, FieldPosition, LensSettings, Planes, Zone

CAMERA: Final = SimulatedCamera(height=900, width=1350, full_well_electrons=20_000.0)
MARGIN, BLOCK, RIM = 64, 128, 8
LOSS_DB: Final = 0.5
FALL_DB: Final = 0.05
PLACES: Final = [FieldPosition(r, phi) for r in (0.05, 0.35, 0.6, 0.85) for phi in (0.4, 2.0, -2.4, -0.9)]


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """A lens with known PSFs, and where to read on about it."""

    name: str
    lens: SimulatedLens | GridLens
    f_number: float
    number: int

    @property
    def settings(self) -> LensSettings:
        """Wide open."""
        return LensSettings(aperture=self.f_number)


def scenes(half: str) -> list[Path]:
    """Photographs that are large enough."""
    return [
        path
        for path in list_photos(Path(os.environ["LENSMODEL_TEST_DATA"]) / "sharp")
        if photo_half(path.stem) == half
    ]


def shot(lens: Lens, number: int) -> SimulatedPhoto:
    """Photo `number` of a lens."""
    files = scenes("test" if lens.number >= 1000 else "dev")
    scene = load_scene(files[(5 * lens.number + 3 * number) % len(files)])
    if scene.shape[1] > scene.shape[2]:
        scene = np.rot90(scene, axes=(1, 2))
    rows, cols = (
        min(extent, wanted + MARGIN) // 2 * 2
        for extent, wanted in zip(scene.shape[1:], (CAMERA.height, CAMERA.width), strict=True)
    )
    top, left = (scene.shape[1] - rows) // 2, (scene.shape[2] - cols) // 2
    part = np.ascontiguousarray(scene[:, top : top + rows, left : left + cols])
    rng = np.random.default_rng([lens.number, number])
    return photograph(part, lens.lens, lens.settings, CAMERA, rng)


def shown(planes: Planes) -> NDArray[np.float32]:
    """White-balanced and clipped, as a picture shows it."""
    gains = np.asarray(CAMERA.white_balance, dtype=np.float32)[:, None, None]
    return np.clip(planes * gains, 0.0, 1.0)


def decibels(made: Planes, before: Planes, truth: Planes) -> float:
    """Gain in PSNR of the sRGB picture."""
    return psnr(made, truth, srgb=True) - psnr(before, truth, srgb=True)


def gains(made: Planes, before: Planes, truth: Planes) -> tuple[dict[Zone, float], NDArray[np.float64]]:
    """Gain of each zone, and of each block."""
    rows, cols = np.indices(truth.shape[1:], dtype=np.float64)
    r, _ = CAMERA.frame.polar(rows, cols)
    zone_masks: dict[Zone, NDArray[np.bool_]] = {
        "center": r < 0.3,
        "mid": (r >= 0.3) & (r <= 0.75),
        "corner": r > 0.75,
    }
    zones = {
        z: decibels(*(p[:, None, mask] for p in (made, before, truth))) for z, mask in zone_masks.items()
    }
    blocks = [
        decibels(*(p[:, top : top + BLOCK, left : left + BLOCK] for p in (made, before, truth)))
        for top in range(RIM, truth.shape[1] - BLOCK, BLOCK)
        for left in range(RIM, truth.shape[2] - BLOCK, BLOCK)
    ]
    return zones, np.array(blocks)


def psf_errors(lens: Lens, model: LensModel) -> tuple[float, float]:
    """Median relative L2 error of green, true and expected."""
    truth = lens.lens.field(lens.settings)  # of the usual pitch, which is that of the camera
    asked = lens.settings.with_channel("g")
    answers = [model.query(place, asked, 55) for place in PLACES]
    true = [
        distance(answer.kernel, truth.kernel_at(place, "g", 55)).rel_l2
        for place, answer in zip(PLACES, answers, strict=True)
    ]
    return float(np.median(true)), float(np.median([answer.predicted_error for answer in answers]))


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What one correction came to."""

    zones: dict[Zone, float]
    expected: dict[Zone, float | None]
    blocks: NDArray[np.float64]
    errors: tuple[float, float]


def outcomes(lens: Lens, counts: Sequence[int], folder: Path) -> Iterator[tuple[int, Outcome | str]]:
    """Learn a lens from some photos and correct another one, for each number of photos."""
    most = max(counts)
    samples: list[list[PsfSample]] = []
    for number in range(most):
        path = folder / f"{lens.number}-{number}.dng"
        write_photo(path, shot(lens, number))
        try:
            samples.append(pipeline.samples_of_photo(path, workers=1))
        except NotEnoughEvidenceError:
            samples.append([])
    last, path = shot(lens, most), folder / "last.dng"
    write_photo(path, last)
    developed = photo.develop(path)
    for count in counts:
        known = [sample for own in samples[:count] for sample in own]
        if not known:
            yield count, "its photos show too little"
            continue
        model = LensModel.fit(known, ModelSettings()).warmed()
        made: deconv.Corrected = pipeline.correct_photo(
            developed, model, lens.settings, lateral=pipeline.lateral_of(developed)
        )
        zones, blocks = gains(shown(made.planes), shown(developed.planes), shown(last.sharp))
        expected = {zone: report.expected_gain_db for zone, report in made.zones.items()}
        yield count, Outcome(zones, expected, blocks, psf_errors(lens, model))


def lenses(seeds: Sequence[int], grids: Sequence[Path]) -> Iterator[Lens]:
    """The lenses that were asked for."""
    for seed in seeds:
        drawn = draw_lens(seed)
        yield Lens(str(seed), drawn, drawn.at_focal().f_number, seed)
    for index, path in enumerate(grids):
        truth = read_grid(path)
        yield Lens(path.stem, GridLens((truth,)), truth.f_number, 2000 + index)


def seed_range(text: str) -> list[int]:
    """Numbers of `first:end`, or one number."""
    first, _, end = text.partition(":")
    return list(range(int(first), int(end) if end else int(first) + 1))


class Tally:
    """Sums over all lenses."""

    def __init__(self) -> None:
        self.zones: list[float] = []
        self.blocks: list[float] = []
        self.pairs: list[tuple[float, float]] = []

    def add(self, outcome: Outcome) -> None:
        """Count one correction."""
        self.zones += outcome.zones.values()
        self.blocks += outcome.blocks.tolist()
        self.pairs += [
            (gain, outcome.zones[zone]) for zone, gain in outcome.expected.items() if gain is not None
        ]

    @property
    def words(self) -> str:
        """What it all comes to."""
        expected, true = np.array(self.pairs or [(0.0, 0.0)]).T
        falls, lost = np.array(self.zones) < -FALL_DB, np.array(self.blocks) < -LOSS_DB
        slope = float(expected @ true) / max(float(expected @ expected), 1e-9)
        off = expected - true
        return (
            f"\n{falls.sum()} of {falls.size} zones lose more than {FALL_DB} dB; "
            f"{lost.sum()} of {lost.size} blocks lose more than {LOSS_DB} dB.\n"
            f"Expected gains are off by {np.abs(off).mean():.2f} dB on average ({off.mean():+.2f}), "
            f"{int((np.sign(expected) != np.sign(true)).sum())} of {off.size} of the wrong sign; "
            f"true gains are {slope:.2f} times as large."
        )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=seed_range, default=[])
    parser.add_argument("--grids", type=Path, nargs="*", default=[])
    parser.add_argument("--photos", type=int, nargs="+", default=[1])
    wanted = parser.parse_args()
    print(
        "| lens | n | gain center / mid / corner, dB | expected | PSF error (expected) | lost blocks | worst|"
    )
    print("|---|---|---|---|---|---|---|")
    tally = Tally()
    with tempfile.TemporaryDirectory() as name:
        for lens in lenses(wanted.seeds, wanted.grids):
            for count, outcome in outcomes(lens, wanted.photos, Path(name)):
                if isinstance(outcome, str):
                    print(f"| {lens.name} | {count} | {outcome} | | | | |", flush=True)
                    continue
                told = [outcome.expected.get(zone) for zone in ZONES]
                words = " / ".join("?" if gain is None else f"{gain:+.1f}" for gain in told)
                seen = " / ".join(f"{outcome.zones[zone]:+.2f}" for zone in ZONES)
                bad = outcome.blocks < -LOSS_DB
                print(
                    f"| {lens.name} | {count} | {seen} | {words} "
                    f"| {outcome.errors[0]:.2f} ({outcome.errors[1]:.2f}) "
                    f"| {bad.mean():.1%} | {outcome.blocks.min():+.2f} |",
                    flush=True,
                )
                tally.add(outcome)
    print(tally.words)


if __name__ == "__main__":
    main()
