"""Time and peak memory from file to file; prints the figures of docs/lab/performance.md.

    python -m lab.correction.memory --photo FILE [--as-it-is] [--method fast]

Makes a RAW photo of the picture FILE, develops it, corrects it with the lens of `lensmodel bench correct` and
writes a 16-bit TIFF; `--as-it-is` corrects FILE itself.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

from lab.correction.correction_benchmark import SoftCorners
from lab.peers import light_numbers, write_raw
from lensmodel.api import lateral_of
from lensmodel.correction import correct_planes
from lensmodel.photo import develop, write_image


def main() -> None:
    """Run and print the peak after each part."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photo", type=Path, metavar="FILE", required=True, help="a picture")
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
        source = wanted.photo if wanted.as_it_is else Path(name) / "in.dng"
        # In a process of its own, so that its memory does not count here.
        if not wanted.as_it_is:
            if (pid := os.fork()) == 0:
                write_raw(light_numbers(develop(wanted.photo).planes), source)
                os._exit(0)
            os.waitpid(pid, 0)
        tell("start")
        photo = develop(source)
        tell("developed")
        lateral_of(photo)
        corrected = correct_planes(
            photo.planes, SoftCorners(), photo.frame, method=wanted.method, noise=photo.correction_noise,
            clip=photo.clip, cfa=photo.cfa, workers=wanted.workers,
        )  # fmt: skip
        tell("corrected")
        print(f"photo and correction: {2 * corrected.planes.nbytes / 2**20:.0f} MiB", flush=True)
        encoding = photo.encoding
        del photo
        write_image(Path(name) / "out.tif", corrected.planes, encoding, format="tiff16", color_space="same")
        tell("written")


if __name__ == "__main__":
    main()
