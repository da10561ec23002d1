"""`python -m lab.traced`: make grids, list designs and copies."""

from __future__ import annotations

import argparse
import logging
import sys
import time
from pathlib import Path

import numpy as np

from lab.traced.copies import copies
from lab.traced.lens import TracedLens
from lab.traced.make import DEFAULT_STEP, interpolation_error, make_grid

logger = logging.getLogger(__name__)


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m lab.traced", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="list the copies that grids can be made of")
    make = commands.add_parser("make", help="trace copies and write one grid a copy and aperture")
    make.add_argument("copy", nargs="+", choices=sorted(copies), help="name of a copy")
    make.add_argument("--output", type=Path, default=Path(), help="folder; default: the current one")
    make.add_argument("--stopped", type=float, default=0.0, help="stops closed from wide open")
    make.add_argument(
        "--step", type=float, default=DEFAULT_STEP, help="distance of the nodes, half diagonals"
    )
    make.add_argument("--size", type=int, default=55, help="odd side of the kernels, pixels")
    make.add_argument("--pitch", type=float, default=4.5, help="pixel pitch, micrometres")
    make.add_argument("--check", type=int, default=0, help="compare with exact PSFs at so many places")
    asked = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    if asked.command == "list":
        for name, copy in copies.items():
            logger.info("%-22s %s", name, copy)
        return 0
    for name in asked.copy:
        start = time.process_time()
        lens = TracedLens(copies[name])
        f_number = lens.copy.f_number * 2.0 ** (asked.stopped / 2.0)
        grid = make_grid(lens, f_number, step=asked.step, size=asked.size, pitch_um=asked.pitch)
        path = asked.output / f"{name}-f{f_number:.2g}.npz"
        grid.write(path)
        spent = time.process_time() - start
        logger.info("%s: %d KB, %.0f CPU seconds", path, path.stat().st_size // 1024, spent)
        logger.info("largest misfit of a path: %.4f waves", grid.facts["path_misfit_waves"])
        if asked.check:
            errors = interpolation_error(lens, grid, asked.check, np.random.default_rng(0))
            logger.info("error between nodes: median %.4f, largest %.4f", np.median(errors), max(errors))
    return 0


if __name__ == "__main__":
    sys.exit(main())
