"""What a calibration costs: time and memory of `lensmodel calibrate`, photos of 24 megapixels.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.chain.calibration_cost [--photos 1,5] [--megapixels 24]

The photos are Bayer DNG files composed of sharp photographs, each tile mirrored where it meets the next,
blurred by a Gaussian of 0.8 px, with the noise of base ISO: the blur does not matter for the cost, the
number of patches does. Printed are the wall clock, the CPU seconds of all processes, and the largest sum
of their resident memory (what they share counts once in each, so it is an upper bound), sampled ten times a
second from /proc: Linux only. The compiled parts are there beforehand.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import ndimage

from lensmodel.lab.cases import list_photos
from lensmodel.photo.dng import write_bayer_dng
from lensmodel.simulate import load_scene

_WHITE, _ELECTRONS, _READ = 16383, 50_000.0, 0.001  # 14 bits, a full well, read noise over it (chosen)
_BLUR_PX = 0.8  # of the lens (chosen)
_PAGE = os.sysconf("SC_PAGE_SIZE")
_BALANCE = (0.5, 1.0, 0.65)  # of r, g, b in the light of day (chosen)


def compose(files: Sequence[Path], megapixels: float, first: int, target: Path) -> None:
    """Write a Bayer DNG of photographs side by side, beginning with number `first`."""
    height = round((megapixels * 1e6 / 1.5) ** 0.5) // 2 * 2
    width = round(height * 1.5) // 2 * 2
    rng = np.random.default_rng(first)
    light = np.empty((3, height, width), dtype=np.float32)
    row, number = 0, first
    while row < height:
        col, deepest = 0, height
        while col < width:
            tile = load_scene(files[number % len(files)])
            number += 1
            rows, cols = min(tile.shape[1], height - row), min(tile.shape[2], width - col)
            light[:, row : row + rows, col : col + cols] = tile[:, :rows, :cols]
            col, deepest = col + cols, min(deepest, rows)
        row += deepest
    mosaic = np.empty((height, width), dtype=np.float32)
    for channel, places in enumerate((((0, 0),), ((0, 1), (1, 0)), ((1, 1),))):
        blurred = ndimage.gaussian_filter(light[channel], _BLUR_PX) * np.float32(_BALANCE[channel])
        for down, right in places:
            mosaic[down::2, right::2] = blurred[down::2, right::2]
    deviation = np.sqrt(mosaic / _ELECTRONS + _READ**2)
    mosaic += deviation * rng.standard_normal(mosaic.shape, dtype=np.float32)
    numbers = np.round(np.clip(mosaic, 0.0, 1.0) * _WHITE).astype(np.uint16)
    write_bayer_dng(target, numbers, black=0, white=_WHITE)


def resident(root: int) -> int:
    """Resident bytes of a process and all that it started."""
    parents, sizes = {}, {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            fields = (entry / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        except OSError:
            continue
        parents[int(entry.name)], sizes[int(entry.name)] = int(fields[1]), int(fields[21]) * _PAGE
    family, added = {root}, {root}
    while added:
        added = {pid for pid, parent in parents.items() if parent in family} - family
        family |= added
    return sum(sizes.get(pid, 0) for pid in family)


def measured(photos: list[Path], folder: Path) -> tuple[float, float, float]:
    """Wall clock (s), CPU (s) and most memory (MiB) of one calibration."""
    words = [sys.executable, "-m", "app.cli", "calibrate", *map(str, photos), "--quiet", "--force"]
    lens = ["--aperture", "2.0"]
    before, began, most = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic(), 0
    with subprocess.Popen([*words, *lens, "--profile", str(folder / "lens.lensprofile")]) as process:
        while process.poll() is None:
            most = max(most, resident(process.pid))
            time.sleep(0.1)
    if process.returncode != 0:
        raise SystemExit(f"lensmodel calibrate ended with status {process.returncode}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.monotonic() - began, cpu, most / 2**20


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--photos", default="1,5", help="numbers of photos, with commas between")
    parser.add_argument("--megapixels", type=float, default=24.0)
    arguments = parser.parse_args()
    counts = [int(text) for text in arguments.photos.split(",")]
    data = os.environ.get("LENSMODEL_TEST_DATA")
    files = list_photos(Path(data) / "sharp" if data else None)
    print(f"{os.cpu_count()} cores, {arguments.megapixels:g} megapixels a photo")
    print("| photos | wall clock, min | CPU, min | memory, MiB |")
    print("|---|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        photos = [folder / f"photo-{i}.dng" for i in range(max(counts))]
        for i, path in enumerate(photos):
            compose(files, arguments.megapixels, 4 * i, path)
        for count in counts:
            wall, cpu, most = measured(photos[:count], folder)
            print(f"| {count} | {wall / 60:.1f} | {cpu / 60:.1f} | {most:.0f} |", flush=True)


if __name__ == "__main__":
    main()
