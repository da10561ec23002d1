r"""Is the noise that a correction is told the right one? Gain with the true PSF, by a factor on its variance.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.correction.noise_factor \
        [--seeds 8] [--factors 0.25 1 4] [--files jpeg]

A photo of a lens of a development seed as raw, as a 16-bit TIFF and as a JPEG of quality 92, both developed
by us in sRGB; method `standard`. Factor 1 is `LinearPhoto.correction_noise`. Where the best one is far from
it, what the file does to the picture (demosaicing, quantisation, blocks) is not in its noise model.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lensmodel.core.types import ZONES, NoiseModel
from lensmodel.lab.cases import list_photos, photo_half
from lensmodel.lab.reproduce.cases import Case
from lensmodel.lab.reproduce.fidelity import fidelity
from lensmodel.lab.reproduce.routes import corrected_with
from lensmodel.lab.reproduce.scenes import layout_for
from lensmodel.lab.reproduce.shots import take
from lensmodel.photo import LinearPhoto, develop
from lensmodel.photo.values import PlaneNoise
from lensmodel.simulate import draw_lens

FRAME = (480, 640)  # rows and columns (chosen): a run of minutes
FILES = ("base", "high-iso", "tiff", "jpeg")


def scaled(photo: LinearPhoto, factor: float) -> LinearPhoto:
    """Return the photo with another noise model."""

    def noisier(noise: PlaneNoise) -> PlaneNoise:
        r, g, b = (NoiseModel(n.shot * factor, n.read * factor) for n in noise)
        return r, g, b

    # What is told of a sensor is taken as it is; of anything else, more is made.
    return replace(photo, sensor_noise=noisier(photo.correction_noise))


def case_of(seed: int, files: Sequence[Path], condition: str) -> Case:
    """Plan a lens wide open."""
    lens = draw_lens(seed)
    focal = lens.focal_mm[0]
    layout = layout_for(files, 2, FRAME)
    return Case(seed, focal, lens.at_focal(focal).f_number, (1,), *FRAME, layout, condition=condition)


def main() -> None:
    """Print a row a file and factor."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", nargs="+", type=int, default=[8])
    parser.add_argument("--factors", nargs="+", type=float, default=[0.25, 1.0, 4.0, 16.0, 64.0])
    parser.add_argument("--files", nargs="+", choices=FILES, default=list(FILES))
    wanted = parser.parse_args()
    if max(wanted.seeds) > 99:
        parser.error("this is for development: seeds 0 to 99")
    folder = os.environ.get("LENSMODEL_TEST_DATA")
    photos = list_photos(Path(folder) / "sharp" if folder else None)
    files = tuple(path for path in photos if photo_half(path.stem) == "dev")
    print("| file | factor | " + " | ".join(f"gain {zone}, dB" for zone in ZONES) + " |")
    print("|---" * (2 + len(ZONES)) + "|")
    for condition in wanted.files:
        gains: dict[float, list[dict[str, float]]] = {factor: [] for factor in wanted.factors}
        for seed in wanted.seeds:
            case = case_of(seed, files, condition)
            balance = np.asarray(case.camera.white_balance, dtype=np.float32)[:, None, None]
            with tempfile.TemporaryDirectory(prefix="lensmodel-noise-") as work:
                shots = take(case, files, Path(work), first=2)
                photo, sharp = develop(shots.held_out), shots.truth() * balance
            grain = ", ".join(f"{value:.1f}" for value in photo.grain)
            print(f"{condition}, seed {seed}: grain {grain}", file=sys.stderr)
            shown = balance if case.conditions.container == "dng" else np.float32(1.0)
            before = fidelity(photo.planes * shown, sharp, case.camera.frame)["psnr"]
            field = case.truth()
            for factor in wanted.factors:
                planes = corrected_with(scaled(photo, factor), field, "standard", workers=os.cpu_count() or 1)
                after = fidelity(planes * shown, sharp, case.camera.frame)["psnr"]
                gains[factor].append({zone: after[zone] - before[zone] for zone in ZONES})
        for factor, rows in gains.items():
            cells = " | ".join(f"{np.mean([row[zone] for row in rows]):+.2f}" for zone in ZONES)
            print(f"| {condition} | {factor:g} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
