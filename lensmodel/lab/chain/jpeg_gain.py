r"""What a camera's JPEG gains that is corrected by a lens known only from other JPEGs of the same camera.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.chain.jpeg_gain \
        --seeds 1000:1004 --photos 1 2 [--cameras usual]

Each lens of third-order theory takes photos of 1.2 megapixels as in `blind_gain`, and a camera makes JPEG
files of them by its own chain (`lab.camera_jpeg.CameraJpeg`: tone curve, denoising, unsharp mask, half the
chroma, compression). The lens is learned from the first n by default settings, and one that was not learned
from is corrected by default settings.

Printed are the gains in PSNR of the file's numbers over the photo as it was, by zone, against what that
camera shows of the sharp scene, sharpened and with chroma as in the file, without noise and compression;
what the correction expected in linear light; the gain of luma and of chroma alone over the whole photo; the
share of blocks of 128 pixels that lose more than 0.5 dB, and the worst of them. Some two minutes a photo on
one core. `--keep FOLDER` keeps what was learned of each photo for another run.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lensmodel import photo
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import ZONES, Planes, Zone
from lensmodel.lab.camera_jpeg import CAMERA_JPEGS
from lensmodel.lab.chain.blind_gain import (
    BLOCK,
    CAMERA,
    FALL_DB,
    LOSS_DB,
    RIM,
    KnownLens,
    lenses,
    seed_range,
    shot,
)
from lensmodel.model import LensModel, LensProfile, ModelSettings, load_profile, save_profile
from lensmodel.workflow import pipeline

LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # ITU-R BT.601, as JFIF asks


@dataclass(frozen=True, slots=True, eq=False)
class JpegGains:
    """Gains in decibels of one correction: by zone, as expected there, of luma, of chroma, by block."""

    zones: dict[Zone, float]
    expected: dict[Zone, float]
    luma: float
    chroma: float
    blocks: NDArray[np.float64]


def outcomes(
    lens: KnownLens, camera: str, counts: Sequence[int], folder: Path
) -> Iterator[tuple[int, JpegGains | str]]:
    """Learn a lens from some JPEGs and correct another one, for each number of photos."""
    most, chain = max(counts), CAMERA_JPEGS[camera]
    samples = [learned(lens, camera, number, folder) for number in range(most)]
    last, path = shot(lens, most), folder / f"{lens.number}-{most}-{camera}.jpg"
    chain.write(path, last)
    developed, truth = photo.develop(path), chain.rendered(last.sharp, CAMERA)
    before = values(developed.planes)
    for count in counts:
        known = [sample for own in samples[:count] for sample in own]
        if not known:
            yield count, "its photos show too little"
            continue
        model = LensModel.fit(known, ModelSettings()).warmed()
        made = pipeline.correct_photo(developed, model, lens.settings, lateral=pipeline.lateral_of(developed))
        expected = {zone: of.expected_gain_db or 0.0 for zone, of in made.zones.items()}
        yield count, outcome(values(made.planes), before, truth, expected)


def learned(lens: KnownLens, camera: str, number: int, folder: Path) -> list[PsfSample]:
    """Samples of one photo, kept in the folder."""
    path = folder / f"{lens.number}-{number}-{camera}.jpg"
    kept, refused = path.with_suffix(".lensprofile"), path.with_suffix(".refused")
    if refused.exists():
        return []
    if not kept.exists():
        CAMERA_JPEGS[camera].write(path, shot(lens, number))
        try:
            own = pipeline.samples_of_photo(path, workers=1)
        except NotEnoughEvidenceError:
            refused.touch()
            return []
        save_profile(kept, LensProfile(LensModel.fit(own)))
    return list(load_profile(kept).model.samples)


def values(planes: Planes) -> Planes:
    """What is written of planes, 0..1 and as fine as floats are: the sRGB values of the file."""
    clipped = np.clip(planes, 0.0, 1.0)
    dark = clipped <= 0.0031308
    return np.where(dark, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055).astype(np.float32)


def outcome(made: Planes, before: Planes, truth: Planes, expected: dict[Zone, float]) -> JpegGains:
    """Compare with what the camera should have shown."""
    after, first = made - truth, before - truth
    squared = [np.square(error).mean(axis=0) for error in (after, first)]
    r, _ = CAMERA.frame.polar(*np.indices(truth.shape[1:], dtype=np.float64))
    masks: dict[Zone, NDArray[np.bool_]] = {
        "center": r < 0.3,
        "mid": (r >= 0.3) & (r <= 0.75),
        "corner": r > 0.75,
    }
    zones = {zone: decibels(squared[1][mask], squared[0][mask]) for zone, mask in masks.items()}
    luma = [np.tensordot(LUMA, error, axes=1) for error in (after, first)]
    chroma = [error - bright for error, bright in zip((after, first), luma, strict=True)]
    blocks = [
        decibels(*(error[top : top + BLOCK, left : left + BLOCK] for error in reversed(squared)))
        for top in range(RIM, truth.shape[1] - BLOCK, BLOCK)
        for left in range(RIM, truth.shape[2] - BLOCK, BLOCK)
    ]
    return JpegGains(
        zones,
        expected,
        decibels(*(np.square(error) for error in reversed(luma))),
        decibels(*(np.square(error) for error in reversed(chroma))),
        np.array(blocks),
    )


def decibels(before: NDArray[np.floating], after: NDArray[np.floating]) -> float:
    """Gain by squared errors."""
    return float(10.0 * np.log10(before.mean() / after.mean()))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=seed_range, default=seed_range("1000:1004"))
    parser.add_argument("--photos", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--cameras", nargs="+", choices=CAMERA_JPEGS, default=["usual"])
    parser.add_argument("--keep", type=Path)
    wanted = parser.parse_args()
    print("| lens | camera | n | gain center / mid / corner, dB | expected | luma / chroma | lost | worst |")
    print("|---|---|---|---|---|---|---|---|")
    zones: list[float] = []
    blocks: list[float] = []
    with tempfile.TemporaryDirectory() as name:
        folder = wanted.keep or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        for lens in lenses(wanted.seeds, [], CAMERA.full_well_electrons):
            for camera in wanted.cameras:
                for count, seen in outcomes(lens, camera, wanted.photos, folder):
                    if isinstance(seen, str):
                        print(f"| {lens.name} | {camera} | {count} | {seen} | | | | |", flush=True)
                        continue
                    words = " / ".join(f"{seen.zones[zone]:+.2f}" for zone in ZONES)
                    hoped = " / ".join(f"{seen.expected.get(zone, 0.0):+.2f}" for zone in ZONES)
                    print(
                        f"| {lens.name} | {camera} | {count} | {words} | {hoped} | {seen.luma:+.2f} / "
                        f"{seen.chroma:+.2f} | {(seen.blocks < -LOSS_DB).mean():.1%} "
                        f"| {seen.blocks.min():+.2f} |",
                        flush=True,
                    )
                    zones += seen.zones.values()
                    blocks += seen.blocks.tolist()
    falls, lost = np.array(zones) < -FALL_DB, np.array(blocks) < -LOSS_DB
    print(
        f"\n{falls.sum()} of {falls.size} zones lose more than {FALL_DB} dB; "
        f"{lost.sum()} of {lost.size} blocks lose more than {LOSS_DB} dB."
    )


if __name__ == "__main__":
    main()
