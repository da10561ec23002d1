"""Judge corrections on a fixed set: hard scenes behind known lenses, where the truth is known.

    python -m lab.correction.judge [--scenes lamps text] [--widths 1 1.2] [--method standard]

Prints a table: gain in PSNR of the picture as shown in centre, mid and corner, overshoot beside edges and
grain over the original's, isolated dots, hue flips, share of the correction that was held back, CPU seconds
a megapixel. Widths other than 1 hand over kernels so many times as wide, with the error that they have.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lab.correction.frame_window import FRAME, FrameWindow, view
from lab.gallery import figures
from lab.gallery.pictures import Rendered, rendered
from lab.images import psnr
from lab.reproduce import cases
from lab.scenes import hard_scene
from lensmodel.core.psf import PsfField, as_kernel
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, Kernel, LensSettings
from lensmodel.correction import StoredColour, correct_planes
from lensmodel.photo import LinearPhoto, develop, write_image
from lensmodel.simulate import CameraLens, SimulatedCamera, draw_lens, write_photo
from lensmodel.simulate.camera import SimulatedPhoto

PITCH_UM: Final = 4.5
KERNEL: Final = 55
_BEYOND: Final = (
    192  # pixels of mirror image around what was photographed: more than a cell looks at (chosen)
)
_RIM: Final = 8  # pixels that do not count (chosen)
_SCENE: Final = (558, 718)  # rows and columns of a scene: a window and all that its blur reaches


@dataclass(frozen=True)
class Case:
    """A scene behind a lens: a seed of `draw_lens`, or the number of a traced lens of the repository."""

    scene: str  # one of `lab.scenes.HARD_SCENES`
    seed: int | None = None
    grid: int = 0
    full_well: float = 50_000.0
    read: float = 50.0
    jpeg: bool = False

    @property
    def lens(self) -> tuple[CameraLens, PsfField, float]:
        """The lens, its field wide open, and its aperture."""
        if self.seed is not None:
            drawn = draw_lens(self.seed)
            aperture = drawn.at_focal().f_number
            return drawn, drawn.field(LensSettings(aperture=aperture), pitch_um=PITCH_UM), aperture
        traced = cases.traced(cases.repository_grids()[self.grid])
        return traced, traced.field(), traced.grid.f_number


CASES: Final = {
    "lamps": Case("lamps", 1000),
    "text": Case("text", 1006),
    "foliage": Case("foliage", grid=0),
    "faces, high ISO": Case("faces", grid=1, full_well=2500.0, read=7.5),
    "night": Case("night", 1002, full_well=2500.0, read=7.5),
    "faces, JPEG": Case("faces", 1004, full_well=20_000.0, read=20.0, jpeg=True),
    "snow": Case("snow", 1003),
    "red cars": Case("red-cars", 1001),
}


@dataclass(frozen=True)
class Handed:
    """The field that is handed over: the true one, or kernels of another width."""

    true: PsfField
    width: float
    known: dict[tuple[float, float, Channel, int], Kernel] = field(default_factory=dict)

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel of a place."""
        key = (position.r, position.phi, channel, size)
        if key not in self.known:
            kernel = self.true.kernel_at(position, channel, size)
            self.known[key] = kernel if self.width == 1.0 else widened(kernel, self.width)
        return self.known[key]

    def error(self, position: FieldPosition, channel: Channel) -> float:
        """Return its relative L2 error."""
        true = self.true.kernel_at(position, channel, KERNEL)
        return float(np.linalg.norm(self.kernel_at(position, channel, KERNEL) - true) / np.linalg.norm(true))


def widened(kernel: Kernel, width: float) -> Kernel:
    """Kernel at `width` times its width: the light of each pixel moves outwards as a larger square."""
    t = np.arange(kernel.shape[0]) - kernel.shape[0] // 2
    low, high = width * (t - 0.5), width * (t + 0.5)
    inside = np.minimum(high, t[:, None] + 0.5) - np.maximum(low, t[:, None] - 0.5)
    along = np.maximum(inside, 0.0) / width
    return as_kernel(along @ kernel @ along.T)


def taken(case: Case, zone: str, rng: np.random.Generator) -> tuple[FrameWindow, LinearPhoto, Rendered]:
    """Photograph a window of the frame: what was seen, developed, and the sharp scene as shown."""
    lens, true, aperture = case.lens
    at = view(zone, np.maximum(hard_scene(case.scene, *_SCENE, rng), 0.0).astype(np.float32), true)
    height, width = (extent // 2 * 2 for extent in at.light.shape[1:])
    camera = SimulatedCamera(
        height=height, width=width, full_well_electrons=case.full_well, read_noise=case.read
    )
    light, sharp = (camera.balanced(planes[:, :height, :width]) for planes in (at.light, at.scene))
    settings = LensSettings(aperture=aperture)
    shot = SimulatedPhoto(camera.mosaic(light, rng), light, sharp, lens, camera, settings)
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "a.dng"
        write_photo(path, shot)
        seen = develop(path)
        shown = rendered(sharp, seen.encoding)
        if case.jpeg:
            path = path.with_suffix(".jpg")
            write_image(path, seen.planes, seen.encoding, format="jpeg", color_space="srgb", quality=92)
            seen = develop(path)
    return at, seen, shown


@dataclass
class Row:
    """Figures of one case, gathered window by window."""

    gains: list[float] = field(default_factory=list)
    edges: list[NDArray[np.float64]] = field(default_factory=list)
    grain: list[NDArray[np.float64]] = field(default_factory=list)
    faults: dict[str, int] = field(default_factory=lambda: {"dots": 0, "flips": 0})
    held: list[float] = field(default_factory=list)
    cpu_s: float = 0.0
    pixels: int = 0

    def add(self, before: Rendered, after: Rendered, truth: Rendered) -> None:
        """Measure a window."""
        old, new, sharp = (p.astype(np.float32) / np.float32(65535.0) for p in (before, after, truth))
        inner = (slice(_RIM, -_RIM), slice(_RIM, -_RIM))
        self.gains.append(psnr(new[inner], sharp[inner]) - psnr(old[inner], sharp[inner]))
        self.edges.append(figures.overshoots(old, new, sharp))
        self.grain.append(figures.grain(old, new, sharp))
        self.faults["dots"] += int(figures.dots(old, new, sharp)[inner].sum())
        self.faults["flips"] += int(figures.hue_flips(old, new, sharp)[inner].sum())

    def cells(self) -> list[str]:
        """The row of the table."""
        edges = figures.percentile_of_edges(np.concatenate(self.edges))
        grain = figures.grain_ratio(np.concatenate(self.grain))
        return [
            " / ".join(f"{gain:+.1f}" for gain in self.gains),
            "" if edges is None else f"{edges[1]:.1f}",
            "" if grain is None else " / ".join(f"{ratio:.2f}" for ratio in grain.values()),
            *(str(count) for count in self.faults.values()),
            f"{np.mean(self.held):.1%}",
            f"{1e6 * self.cpu_s / self.pixels:.2f}",
        ]


def judged(case: Case, width: float, method: str, seed: int) -> Row:
    """Correct the three windows of a case with kernels of a width, and measure."""
    handed, row = Handed(case.lens[1], width), Row()
    for zone in ("center", "mid", "corner"):
        at, seen, truth = taken(case, zone, np.random.default_rng([seed, len(zone)]))
        before = np.asarray(seen.planes)
        pads = [(min(first, _BEYOND), _BEYOND) for first in (at.top, at.left)]
        around = np.pad(before, [(0, 0), *pads], mode="reflect")
        whole = np.zeros((len(CHANNELS), FRAME.height, FRAME.width), dtype=np.float32)
        top, left = at.top - pads[0][0], at.left - pads[1][0]
        whole[:, top : top + around.shape[1], left : left + around.shape[2]] = around

        correct = partial(
            correct_planes,
            whole,
            handed,
            FRAME,
            noise=seen.correction_noise,
            clip=seen.clip,
            cfa=seen.cfa,
            stored=StoredColour.of_photo(seen),
            method=method,
            psf_error=handed.error if width != 1.0 else 0.0,
            roi=at.roi,
        )
        correct(strength=0.0)  # asks for all kernels
        start = time.process_time()
        after = correct()
        row.cpu_s += time.process_time() - start
        row.pixels += at.roi[2] * at.roi[3]
        row.held.append(after.audit.held_back)
        first = (at.roi[0] - at.top, at.roi[1] - at.left)
        cut = (slice(first[0], first[0] + at.roi[2]), slice(first[1], first[1] + at.roi[3]))
        row.add(
            rendered(before, seen.encoding)[cut],
            rendered(np.ascontiguousarray(after.planes), seen.encoding),
            truth[cut],
        )
    return row


def main(arguments: Sequence[str] | None = None) -> None:
    """Judge and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--widths", nargs="+", type=float, default=[1.0, 1.2])
    parser.add_argument("--method", default="standard")
    wanted = parser.parse_args(arguments)
    print("| scene | width | gain, dB | overshoot, % | grain | dots | hue flips | held back | CPU s/MP |")
    print("|---|---|---|---|---|---|---|---|---|")
    for number, name in enumerate(wanted.scenes):
        for width in wanted.widths:
            cells = judged(CASES[name], width, wanted.method, number).cells()
            print(f"| {name} | {width:g} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
