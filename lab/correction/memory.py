"""Time and peak memory from file to file; prints the figures of docs/lab/performance.md.

    python -m lab.correction.memory [--kind tif] [--megapixels 100] [--photo FILE] [--method fast]

Makes a file of smooth light with noise, or a RAW photo of the picture FILE, develops it, corrects it with the
lens of `lensmodel bench correct` and writes a 16-bit TIFF, as `lensmodel correct` does; `--as-it-is` corrects
FILE itself. Peaks are those of each part, by Linux's own count. 100 megapixels need 2 GiB of disk.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
from pathlib import Path

import numpy as np
import tifffile
from scipy import ndimage

from lab.correction.correction_benchmark import SoftCorners
from lab.peers import light_numbers, write_raw
from lensmodel.correction import correct_planes
from lensmodel.photo import develop, write_image
from lensmodel.photo.dng import write_bayer_dng
from lensmodel.workflow.correcting import lateral_of


def write_photo(path: Path, megapixels: float) -> None:
    """Write a picture of a 4:3 sensor."""
    rng = np.random.default_rng(0)
    rows = round(math.sqrt(megapixels * 1e6 * 3 / 4)) // 2 * 2
    cols = round(rows * 4 / 3) // 2 * 2
    tile = ndimage.gaussian_filter(rng.random((512, 512)), 3, mode="wrap")
    tile = (tile - tile.min()) / np.ptp(tile) + 0.01 * rng.standard_normal(tile.shape)
    numbers = (1000 + 9000 * np.clip(tile, 0, 1)).astype(np.uint16)
    light = np.tile(numbers, (-(-rows // 512), -(-cols // 512)))[:rows, :cols]
    if path.suffix == ".dng":
        write_bayer_dng(path, light, black=512, white=15000)
    else:
        tifffile.imwrite(path, np.stack([light * 4] * 3, axis=-1), photometric="rgb")


def main() -> None:
    """Run and print the peak after each part."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kind", choices=["tif", "dng"], default="tif")
    parser.add_argument("--megapixels", type=float, default=100.0)
    parser.add_argument("--photo", type=Path, metavar="FILE", help="a picture to make a RAW photo of")
    parser.add_argument("--as-it-is", action="store_true", help="correct FILE itself")
    parser.add_argument("--method", default="fast")
    parser.add_argument("--workers", type=int, default=1, metavar="N")
    wanted = parser.parse_args()
    start = time.perf_counter()

    def tell(part: str) -> None:
        status = Path("/proc/self/status").read_text()
        peak = int(status.partition("VmHWM:")[2].split()[0]) / 1024
        Path("/proc/self/clear_refs").write_text("5")  # count the peak of the next part anew
        cpu, wall = time.process_time(), time.perf_counter() - start
        print(f"{part}: peak {peak:.0f} MiB, {cpu:.1f} CPU s, {wall:.1f} s", flush=True)

    with tempfile.TemporaryDirectory() as name:
        source = Path(name) / f"in.{'dng' if wanted.photo else wanted.kind}"
        if wanted.as_it_is:
            source = wanted.photo
        # In a process of its own, so that its memory does not count here.
        pid = os.fork()
        if pid == 0:
            if wanted.as_it_is:
                pass
            elif wanted.photo:
                write_raw(light_numbers(develop(wanted.photo).planes), source)
            else:
                write_photo(source, wanted.megapixels)
            os._exit(0)
        os.waitpid(pid, 0)
        tell("start")
        photo = develop(source)
        tell("developed")
        lateral_of(photo)
        corrected = correct_planes(
            photo.planes,
            SoftCorners(),
            photo.frame,
            method=wanted.method,
            noise=photo.correction_noise,
            clip=photo.clip,
            cfa=photo.cfa,
            workers=wanted.workers,
        )
        tell("corrected")
        print(f"photo and correction: {2 * corrected.planes.nbytes / 2**20:.0f} MiB", flush=True)
        encoding = photo.encoding
        del photo
        write_image(Path(name) / "out.tif", corrected.planes, encoding, format="tiff16", color_space="same")
        tell("written")


if __name__ == "__main__":
    main()
