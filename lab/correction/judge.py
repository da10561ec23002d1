"""Judge corrections of hard scenes behind known lenses, with the true kernels and with others.

    python -m lab.correction.judge [--frames clipped-lamps text] [--widths 1 1.2] [--method standard]

The frames are those of the gallery, foliage and faces behind ray-traced lenses. Widths other than 1 hand over
kernels so many times as wide, with the error that they have.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Final

import numpy as np

from lab.gallery.page import measured
from lab.gallery.pictures import FRAMES, SimulatedFrame, rendered, take
from lab.page import table
from lab.reproduce.cases import repository_grids
from lensmodel.api import lateral_of
from lensmodel.core.psf import PsfField, as_kernel
from lensmodel.core.types import Channel, FieldPosition, Kernel
from lensmodel.correction import KERNEL_SIZE, PsfPosterior, StoredColour, correct_planes, crop_to_support
from lensmodel.photo import develop

_HEAD: Final = (
    *("frame", "width", "gain, dB", "overshoot, %", "grain", "dots", "hue flips", "held back", "CPU s/MP"),
)


@dataclass(frozen=True, slots=True, eq=False)
class Widened:
    """A PSF field whose kernels are so many times as wide as those of another."""

    true: PsfField
    width: float

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel of a place; the light of each pixel moves outwards as a larger square."""
        kernel = self.true.kernel_at(position, channel, size)
        t = np.arange(size) - size // 2
        low, high = self.width * (t - 0.5), self.width * (t + 0.5)
        inside = np.minimum(high, t[:, None] + 0.5) - np.maximum(low, t[:, None] - 0.5)
        along = np.maximum(inside, 0.0) / self.width
        return as_kernel(along @ kernel @ along.T)

    def posterior_at(self, position: FieldPosition, channel: Channel) -> PsfPosterior:
        """Return it with the error that it has."""
        own, true = (field.kernel_at(position, channel, KERNEL_SIZE) for field in (self, self.true))
        return PsfPosterior.of_error(
            crop_to_support(own), float(np.linalg.norm(own - true) / np.linalg.norm(true))
        )


def frames() -> dict[str, SimulatedFrame]:
    """Frames by name."""
    found = {frame.name: frame for frame in FRAMES}
    for name, grid in zip(("foliage", "faces"), repository_grids(), strict=True):
        found[name] = replace(found[name], grid=grid)
    return found


def judged(frame: SimulatedFrame, folder: Path, width: float, method: str) -> list[str]:
    """Correct a frame with kernels of a width: cells of the table."""
    path, truth = take(frame, folder)
    seen, true = develop(path), frame.truth()
    correct = partial(
        correct_planes, seen.planes, true if width == 1.0 else Widened(true, width), seen.frame,
        noise=seen.correction_noise, clip=seen.clip, cfa=seen.cfa, stored=StoredColour.of_photo(seen),
        lateral=lateral_of(seen), method=method,
    )  # fmt: skip
    correct(strength=0.0)  # asks for all kernels
    start = time.process_time()
    after = correct()
    spent = 1e6 * (time.process_time() - start) / (seen.frame.height * seen.frame.width)
    before, corrected = (rendered(planes, seen.encoding) for planes in (seen.planes, after.planes))
    found = measured(before, corrected, np.load(truth))
    return [
        frame.name,
        f"{width:g}",
        " / ".join(f"{gain:+.1f}" for gain in found["gains"]["zones"].values()),
        "" if found["overshoot"] is None else f"{found['overshoot'][1]:.1f}",
        "" if found["grain"] is None else " / ".join(f"{ratio:.2f}" for ratio in found["grain"].values()),
        *(str(found[name]) for name in ("dots", "hue_flips")),
        f"{after.audit.held_back:.1%}",
        f"{spent:.2f}",
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Judge and print."""
    known = frames()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--frames", nargs="+", choices=list(known), default=list(known))
    parser.add_argument("--widths", nargs="+", type=float, default=[1.0, 1.2])
    parser.add_argument("--method", default="standard")
    wanted = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        cases = product(wanted.frames, wanted.widths)
        rows = [judged(known[name], Path(folder), width, wanted.method) for name, width in cases]
    print(table(_HEAD, rows))


if __name__ == "__main__":
    main()
