r"""What a photo gains that is corrected by a lens known only from other photos, and whether any of it loses.

    LENSMODEL_TEST_DATA=... python -m lab.chain.blind_gain \
        --seeds 1000:1008 --photos 1 2 [--grids FILE.npz] [--electrons 2500] [--tiff]

Each lens takes photos of 1.2 megapixels of different photographs of the test half (the development half for
seeds below 1000), as Bayer DNG files of 20,000 electrons at saturation (base ISO; `--electrons 2500` is high
ISO). The lens is learned from the first n by default settings, and a photo that was not learned from is
corrected by default settings. Lenses are of third-order theory by `--seeds`, or ray-traced ones by `--grids`
(`lab.traced`).

Printed are the gains in PSNR of the white-balanced sRGB picture against the sharp scene over the developed
photo, by zone, each block of 128 pixels after its own best shift (`lab.gallery.truth`): a PSF's
centre of mass lies beside its core where it has a flare on one side, and no blind method can tell. The same
without any shift; the same after it in linear light, and what the correction expected of that; the median
error of the PSFs of green at places all over the field, true and expected; the share of blocks that lose
more than 0.5 dB after their shift, and the worst of them. Some two minutes a photo on one core.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lab.cases import list_photos, photo_half
from lab.gallery.truth import Gains, gains
from lab.images import psnr
from lab.traced import GridLens, read_grid
from lensmodel import correction, photo
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import PsfSample, distance
from lensmodel.core.types import ZONES, FieldPosition, LensSettings, Planes, Zone
from lensmodel.model import LensModel
from lensmodel.quality.images import to_srgb
from lensmodel.simulate import (
    SimulatedCamera,
    SimulatedLens,
    SimulatedPhoto,
    draw_lens,
    load_scene,
    photograph,
    write_photo,
)
from lensmodel.workflow import pipeline

CAMERA: Final = SimulatedCamera(height=900, width=1350, full_well_electrons=20_000.0)
MARGIN, BLOCK, RIM = 64, 128, 8  # pixels beyond a crop, of a block, along the rim (chosen)
LOSS_DB: Final = 0.5  # of a block, that counts (chosen)
FALL_DB: Final = 0.05  # of a zone, that counts (chosen)
PLACES: Final = [FieldPosition(r, phi) for r in (0.05, 0.35, 0.6, 0.85) for phi in (0.4, 2.0, -2.4, -0.9)]


@dataclass(frozen=True, slots=True, eq=False)
class KnownLens:
    """A lens with known PSFs, and where to read on about it."""

    name: str
    lens: SimulatedLens | GridLens
    f_number: float
    number: int
    camera: SimulatedCamera = CAMERA

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


def shot(lens: KnownLens, number: int) -> SimulatedPhoto:
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
    return photograph(part, lens.lens, lens.settings, lens.camera, rng)


def shown(planes: Planes, *, balanced: bool = False) -> NDArray[np.float32]:
    """White-balanced and clipped, as a picture shows it; `balanced` where the file's numbers are already."""
    gains = np.asarray(1.0 if balanced else CAMERA.white_balance, dtype=np.float32).reshape(-1, 1, 1)
    return np.clip(planes * gains, 0.0, 1.0)


def written(path: Path, taken: SimulatedPhoto, *, tiff: bool) -> Path:
    """Write a photo as DNG, or as the 16-bit TIFF that our own development makes of that."""
    write_photo(path, taken)
    if not tiff:
        return path
    developed, scan = photo.develop(path), path.with_suffix(".tif")
    photo.write_image(scan, developed.planes, developed.encoding, format="tiff16", color_space="srgb")
    path.unlink()
    return scan


def decibels(made: Planes, before: Planes, truth: Planes, *, srgb: bool = True) -> float:
    """Gain in PSNR of the sRGB picture, or in linear light."""
    return psnr(made, truth, srgb=srgb) - psnr(before, truth, srgb=srgb)


def zone_gains(made: Planes, before: Planes, truth: Planes, *, srgb: bool = True) -> dict[Zone, float]:
    """Gain of each zone."""
    r, _ = CAMERA.frame.polar(*np.indices(truth.shape[1:], dtype=np.float64))
    zones: dict[Zone, NDArray[np.bool_]] = {
        "center": r < 0.3,
        "mid": (r >= 0.3) & (r <= 0.75),
        "corner": r > 0.75,
    }
    return {
        zone: decibels(*(p[:, None, mask] for p in (made, before, truth)), srgb=srgb)
        for zone, mask in zones.items()
    }


def registered_gains(
    before: NDArray[np.floating], after: NDArray[np.floating], truth: NDArray[np.floating]
) -> Gains:
    """Gains by zone and block, each block after its own best shift."""
    found = gains(*(np.moveaxis(planes, 0, -1) for planes in (before, after, truth)))
    assert found is not None, "a frame of the camera holds many blocks"
    return found


def block_gains(made: Planes, before: Planes, truth: Planes) -> NDArray[np.float64]:
    """Gain of each block."""
    blocks = [
        decibels(*(p[:, top : top + BLOCK, left : left + BLOCK] for p in (made, before, truth)))
        for top in range(RIM, truth.shape[1] - BLOCK, BLOCK)
        for left in range(RIM, truth.shape[2] - BLOCK, BLOCK)
    ]
    return np.array(blocks)


def psf_errors(lens: KnownLens, model: LensModel) -> tuple[float, float]:
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
class CorrectionOutcome:
    """What one correction came to."""

    shown: Gains
    unshifted: dict[Zone, float]
    linear: Gains
    expected: dict[Zone, float | None]
    errors: tuple[float, float]


def outcomes(
    lens: KnownLens, counts: Sequence[int], folder: Path, *, tiff: bool = False
) -> Iterator[tuple[int, CorrectionOutcome | str]]:
    """Learn a lens from some photos and correct another one, for each number of photos."""
    most = max(counts)
    samples: list[list[PsfSample]] = []
    for number in range(most):
        path = written(folder / f"{lens.number}-{number}.dng", shot(lens, number), tiff=tiff)
        try:
            samples.append(pipeline.samples_of_photo(path, pipeline.Recipe(lens.settings), workers=1))
        except NotEnoughEvidenceError:
            samples.append([])
    last = shot(lens, most)
    developed = photo.develop(written(folder / "last.dng", last, tiff=tiff))
    before, truth = shown(developed.planes, balanced=tiff), shown(last.sharp)
    for count in counts:
        known = [sample for own in samples[:count] for sample in own]
        if not known:
            yield count, "its photos show too little"
            continue
        model = LensModel.fit(known)
        made: correction.Corrected = pipeline.correct_photo(
            developed, model, lens.settings, lateral=pipeline.lateral_of(developed)
        )
        after = shown(made.planes, balanced=tiff)
        yield (
            count,
            CorrectionOutcome(
                registered_gains(*map(to_srgb, (before, after, truth))),
                zone_gains(after, before, truth),
                # a forecast is of the light that the file's numbers stand for, before any white balance
                registered_gains(developed.planes, made.planes, truth if tiff else last.sharp),
                {zone: report.expected_gain_db for zone, report in made.zones.items()},
                psf_errors(lens, model),
            ),
        )


def lenses(seeds: Sequence[int], grids: Sequence[Path], electrons: float) -> Iterator[KnownLens]:
    """The lenses that were asked for, on a sensor of so many electrons at saturation."""
    camera = replace(CAMERA, full_well_electrons=electrons)
    for seed in seeds:
        drawn = draw_lens(seed)
        yield KnownLens(str(seed), drawn, drawn.at_focal().f_number, seed, camera)
    for index, path in enumerate(grids):
        truth = read_grid(path)
        yield KnownLens(path.stem, GridLens((truth,)), truth.f_number, 2000 + index, camera)


def seed_range(text: str) -> list[int]:
    """Numbers of `first:end`, or one number."""
    first, _, end = text.partition(":")
    return list(range(int(first), int(end) if end else int(first) + 1))


class Tally:
    """Sums over all lenses."""

    def __init__(self) -> None:
        self.zones: list[float] = []
        self.unshifted: list[float] = []
        self.lost, self.blocks = 0, 0
        self.pairs: list[tuple[float, float]] = []

    def add(self, outcome: CorrectionOutcome) -> None:
        """Count one correction."""
        self.zones += outcome.shown.zones.values()
        self.unshifted += outcome.unshifted.values()
        self.lost += round(outcome.shown.loss_share * outcome.shown.blocks)
        self.blocks += outcome.shown.blocks
        self.pairs += [
            (gain, outcome.linear.zones[zone]) for zone, gain in outcome.expected.items() if gain is not None
        ]

    @property
    def words(self) -> str:
        """What it all comes to."""
        expected, true = np.array(self.pairs or [(0.0, 0.0)]).T
        falls, unshifted = (np.array(zones) < -FALL_DB for zones in (self.zones, self.unshifted))
        slope = float(expected @ true) / max(float(expected @ expected), 1e-9)
        off = expected - true
        return (
            f"\n{falls.sum()} of {falls.size} zones lose more than {FALL_DB} dB "
            f"({unshifted.sum()} without shifts); "
            f"{self.lost} of {self.blocks} blocks lose more than {LOSS_DB} dB.\n"
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
    parser.add_argument("--electrons", type=float, default=CAMERA.full_well_electrons)
    parser.add_argument("--tiff", action="store_true", help="16-bit TIFF files of our development instead")
    wanted = parser.parse_args()
    print(
        "| lens | n | gain center / mid / corner, dB | without shifts | in linear light | expected "
        "| PSF error (expected) | lost blocks | worst |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    tally = Tally()
    with tempfile.TemporaryDirectory() as name:
        for lens in lenses(wanted.seeds, wanted.grids, wanted.electrons):
            for count, outcome in outcomes(lens, wanted.photos, Path(name), tiff=wanted.tiff):
                if isinstance(outcome, str):
                    print(f"| {lens.name} | {count} | {outcome} | | | | | | |", flush=True)
                    continue
                announced = [outcome.expected.get(zone) for zone in ZONES]
                words = " / ".join("?" if gain is None else f"{gain:+.1f}" for gain in announced)
                seen, unshifted, linear = (
                    " / ".join(f"{gain[zone]:+.2f}" for zone in ZONES)
                    for gain in (outcome.shown.zones, outcome.unshifted, outcome.linear.zones)
                )
                print(
                    f"| {lens.name} | {count} | {seen} | {unshifted} | {linear} | {words} "
                    f"| {outcome.errors[0]:.2f} ({outcome.errors[1]:.2f}) "
                    f"| {outcome.shown.loss_share:.1%} | {outcome.shown.worst_db:+.2f} |",
                    flush=True,
                )
                tally.add(outcome)
    print(tally.words)


if __name__ == "__main__":
    main()
