"""Time and memory of correction on a 24-megapixel photo; prints the table of docs/performance.md.

    python benchmarks/correct_speed.py [--rows 4000 --cols 6000] [--workers 2] [--methods fast standard]

Photo and result are memory-mapped files, as in the service, so that the memory shown is the engine's.
Where rawtherapee-cli, darktable-cli or gmic are installed, `--peers` times them on the same picture.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
import tifffile
from scipy import ndimage

from lensmodel.bench.correct import run_correct_benchmark

PEERS = {
    "gmic": ["gmic", "{in}", "-deblur_richardsonlucy", "1.2,20,1", "-o", "{out}"],
    "rawtherapee-cli": ["rawtherapee-cli", "-Y", "-t", "-b16", "-o", "{out}", "-d", "-c", "{in}"],
    "darktable-cli": ["darktable-cli", "{in}", "{out}"],
}


def scene(rows: int, cols: int, path: Path) -> np.ndarray:
    """Write a photo-like picture row by row into a memory-mapped file."""
    planes = np.lib.format.open_memmap(path, mode="w+", dtype=np.float32, shape=(3, rows, cols))
    rng = np.random.default_rng(0)
    tile = rng.random((512, 512))
    tile = ndimage.gaussian_filter(tile, 1.2, mode="wrap") + 2 * ndimage.gaussian_filter(tile, 6, mode="wrap")
    tile = (tile - tile.min()) / np.ptp(tile)
    for top in range(0, rows, 512):
        high = min(512, rows - top)
        strip = np.tile(tile, (1, -(-cols // 512)))[:high, :cols]
        for channel, gain in enumerate((0.5, 0.8, 0.6)):
            noise = rng.standard_normal((high, cols)) * 0.003
            planes[channel, top : top + high] = np.minimum(0.02 + gain * strip + noise, 1.0)
    planes.flush()
    return np.load(path, mmap_mode="r")


def time_peers(photo: np.ndarray, folder: Path) -> None:
    """Print CPU seconds of the programs that are installed."""
    source = folder / "in.tif"
    tifffile.imwrite(source, (np.moveaxis(photo, 0, -1) * 65535).astype(np.uint16), photometric="rgb")
    for name, command in PEERS.items():
        if shutil.which(name) is None:
            print(f"{name}: not installed")
            continue
        target = folder / f"{name}.tif"
        words = [word.format(**{"in": str(source), "out": str(target)}) for word in command]
        before, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        subprocess.run(words, check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        print(f"{name}: CPU {cpu:.1f} s, wall {time.perf_counter() - wall:.1f} s")


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=4000)
    parser.add_argument("--cols", type=int, default=6000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--methods", nargs="+", default=["fast", "standard", "paper"])
    parser.add_argument("--peers", action="store_true")
    wanted = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        photo = scene(wanted.rows, wanted.cols, folder / "in.npy")
        out = np.lib.format.open_memmap(folder / "out.npy", mode="w+", dtype=np.float32, shape=photo.shape)
        report = run_correct_benchmark(photo, methods=wanted.methods, workers=wanted.workers, out=out)
        print(f"{report['machine']}; {report['megapixels']:.1f} MP, {report['workers']} threads")
        print("| method | CPU s | wall s | CPU s per MP and channel | peak MiB, files included |")
        print("|---|---|---|---|---|")
        methods = report["methods"]
        assert isinstance(methods, dict)
        for method, row in methods.items():
            print(
                f"| {method} | {row['cpu_s']:.1f} | {row['wall_s']:.1f} | {row['cpu_s_per_mp_channel']:.3f} "
                f"| {row['peak_mib']:.0f} |"
            )
        print("\nRichardson-Lucy kernel, CPU s per MP, channel and iteration:", report["kernel"])
        if wanted.peers:
            time_peers(photo, folder)


if __name__ == "__main__":
    main()
