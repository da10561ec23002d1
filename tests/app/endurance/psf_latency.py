"""Ask a service for the PSF of a lens again and again; print how long an answer takes.

    python tests/app/endurance/psf_latency.py [--requests 500] [--beside 0] [--form npy]

A service of its own learns a lens from one photo, then answers for 55 x 55 pixels over one connection, each
time at another place. `--beside` is how many processes compute meanwhile, as a worker does.
Printed are the median and the 95th percentile of the wall time, and the processor time of the API for each.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from running import running, write_photo

NICENESS = 10


def compute() -> None:
    """Keep a core busy."""
    os.nice(NICENESS)
    while True:
        pass


def processor_s(pid: int) -> float:
    """Return the processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--requests", type=int, default=500)
    parser.add_argument("--beside", type=int, default=0, metavar="PROCESSES")
    parser.add_argument("--form", choices=["json", "npy", "png", "tiff"], default="npy")
    wishes = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, running(Path(folder) / "data") as service:
        photo = service.calibrated(write_photo(Path(folder) / "a.dng", 1))
        address = f"/v1/lenses/{photo['lens_id']}/psf.{wishes.form}"
        busy = [multiprocessing.Process(target=compute, daemon=True) for _ in range(wishes.beside)]
        for process in busy:
            process.start()

        def ask(number: int) -> float:
            place = {"r": number % 97 / 97, "phi": number % 6 - 3.0, "aperture": 2.8, "size": 55}
            began = time.perf_counter()
            service.http.get(address, params=place).raise_for_status()
            return 1000.0 * (time.perf_counter() - began)

        for number in range(50):  # the first fits the model
            ask(number)
        api = service.info()["pid"]
        before = processor_s(api)
        millis = sorted(ask(number) for number in range(wishes.requests))
        used = 1000.0 * (processor_s(api) - before) / wishes.requests
        for process in busy:
            process.kill()
    p95 = millis[int(0.95 * (len(millis) - 1))]
    print(f"{wishes.form}: p50 {statistics.median(millis):.1f} ms, p95 {p95:.1f} ms, processor {used:.1f} ms")


if __name__ == "__main__":
    main()
