r"""What a correction with the true PSF gains in each channel, over the photo and over deblurring a point.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.chain.true_psf --seeds 1000:1008 [--grids FILE.npz ...]

Photos of 1.2 megapixels as in `blind_gain`, Bayer DNG files; each is corrected twice by the same method, with
the true PSF field of its lens and with a point. Printed are, for red, green and blue, the gains in PSNR of
the white-balanced sRGB picture over the developed photo by zone, the worst block of 128 pixels of all
channels together, and how many channels of zones fall below the developed photo or below the point.
Some two minutes a lens on one core.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Final

import numpy as np

from lensmodel import photo
from lensmodel.core.types import CHANNELS, ZONES, Planes
from lensmodel.lab.chain.blind_gain import (
    CAMERA,
    FALL_DB,
    block_gains,
    lenses,
    seed_range,
    shot,
    shown,
    written,
    zone_gains,
)
from lensmodel.lab.reproduce.routes import PointField, corrected_with

FIRST: Final = 0  # the photo of each lens


def channel_gains(made: Planes, before: Planes, truth: Planes) -> list[list[float]]:
    """Gains by channel and zone."""
    gains = []
    for index, _ in enumerate(CHANNELS):
        one = slice(index, index + 1)
        zones = zone_gains(made[one], before[one], truth[one])
        gains.append([zones[zone] for zone in ZONES])
    return gains


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=seed_range, default=[])
    parser.add_argument("--grids", type=Path, nargs="*", default=[])
    parser.add_argument("--method", default="standard")
    parser.add_argument("--electrons", type=float, default=CAMERA.full_well_electrons)
    wanted = parser.parse_args()
    print("| lens | PSF | red | green | blue | worst block |")
    print("|---|---|---|---|---|---|")
    falls = {"the developed photo": 0, "the point": 0}
    count = 0
    with tempfile.TemporaryDirectory() as name:
        for lens in lenses(wanted.seeds, wanted.grids, wanted.electrons):
            taken = shot(lens, FIRST)
            developed = photo.develop(written(Path(name) / "photo.dng", taken, tiff=False))
            before, truth = shown(developed.planes), shown(taken.sharp)
            gains = {}
            for kind, field in (("true", lens.lens.field(lens.settings)), ("point", PointField())):
                after = shown(corrected_with(developed, field, wanted.method))
                gains[kind] = np.array(channel_gains(after, before, truth))
                gain_words = " | ".join(" / ".join(f"{gain:+.2f}" for gain in row) for row in gains[kind])
                worst = block_gains(after, before, truth).min()
                print(f"| {lens.name} | {kind} | {gain_words} | {worst:+.2f} |", flush=True)
            falls["the developed photo"] += int((gains["true"] < -FALL_DB).sum())
            falls["the point"] += int((gains["true"] - gains["point"] < -FALL_DB).sum())
            count += gains["true"].size
    for what, number in falls.items():
        print(f"{number} of {count} channels of zones are more than {FALL_DB} dB below {what}.")


if __name__ == "__main__":
    main()
