"""How many photos a Dask cluster calibrates in an hour, by the number of its workers.

    python -m app.lab.cluster [--photos 8] [--megapixels 6] [--workers 1 2]

A cluster on this machine, each worker a process with one thread, gets the same photos (composed as in
`lensmodel.lab.chain.calibration_cost`) from `lensmodel calibrate --scheduler`, once for each number of
workers. Printed are the wall clock of the whole command, with its start and the fit at its end, the photos
an hour, and how many times the first number's that is. One photo goes before, so that all is compiled.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from lensmodel.lab.cases import list_photos
from lensmodel.lab.chain.calibration_cost import compose


def seconds(photos: Sequence[Path], profile: Path, workers: int) -> float:
    """Calibrate photos by a cluster of so many workers; return the wall clock."""
    dask: Any = import_module("distributed")
    with dask.LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None, protocol="tcp"
    ) as cluster:
        address = cluster.scheduler_address
        began = time.monotonic()
        subprocess.run(  # noqa: S603 - our own command
            [
                *(sys.executable, "-m", "lensmodel", "calibrate", *map(str, photos), "--quiet"),
                *("--profile", str(profile), "--scheduler", address, "--aperture", "2"),
            ],
            check=True,
            stdout=subprocess.DEVNULL,
        )
        return time.monotonic() - began


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--photos", type=int, default=8)
    parser.add_argument("--megapixels", type=float, default=6.0)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    asked = parser.parse_args()
    files = list_photos(None)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        photos = [folder / f"{k}.dng" for k in range(asked.photos)]
        for k, path in enumerate(photos):
            compose(files, asked.megapixels, 7 * k, path)
        seconds(photos[:1], folder / "first.lensprofile", 1)
        print(f"{asked.photos} photos of {asked.megapixels:g} megapixels")
        print("| workers | s | photos an hour | times the first |\n|---|---|---|---|")
        first = None
        for workers in asked.workers:
            took = seconds(photos, folder / f"{workers}.lensprofile", workers)
            first = first or took
            rate = 3600 * len(photos) / took
            print(f"| {workers} | {took:.0f} | {rate:.0f} | {first / took:.2f} |", flush=True)


if __name__ == "__main__":
    main()
