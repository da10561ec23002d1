"""Peak memory from file to file; prints the figures of docs/lab/performance.md.

    python -m lab.correction.memory [--kind tif] [--megapixels 100] [--method fast]

Makes a file of smooth light with noise, develops it, corrects it with the lens of `lensmodel bench
correct` and writes a 16-bit TIFF, as `lensmodel correct` does. 100 megapixels need 2 GiB of disk.
"""

from __future__ import annotations

import argparse
import math
import os
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
import tifffile
from scipy import ndimage

from lab.correction.correction_benchmark import SoftCorners
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
    parser.add_argument("--method", default="fast")
    wanted = parser.parse_args()
    start = time.perf_counter()

    def tell(part: str) -> None:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"{part}: peak {peak:.0f} MiB after {time.perf_counter() - start:.0f} s", flush=True)

    with tempfile.TemporaryDirectory() as name:
        source = Path(name) / f"in.{wanted.kind}"
        # In a process of its own, so that its memory does not count here.
        pid = os.fork()
        if pid == 0:
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
            noise=photo.sensor_noise or photo.noise,
            clip=photo.clip,
            cfa=photo.cfa,
        )
        tell("corrected")
        encoding = photo.encoding
        del photo
        write_image(Path(name) / "out.tif", corrected.planes, encoding, format="tiff16", color_space="same")
        tell("written")


if __name__ == "__main__":
    main()
