"""The lens test against the truth: T and S of a traced lens by its chart, and by its report from photos.

    LENSMODEL_TEST_DATA=... python -m lab.lens_test GRID.npz

A chart of dark squares that lean is photographed through a lens whose kernels are known: squares are drawn
by their exact areas in pixels, the pixel's own box is taken out again, and the truth is the transfer function
of the lens's own kernel at each place. The lens is also learned from three photos as `lab.blind_gain` takes
them, and the figures of its report stand below those of the chart.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lab.blind_gain import CAMERA, KnownLens
from lab.traced import GridLens
from lensmodel import calibrate
from lensmodel.core.types import ZONES, FieldPosition, Frame, LensSettings, Planes, zone_of
from lensmodel.measured.edges import SlantedEdges
from lensmodel.photo import develop
from lensmodel.quality import edge_area, mtf50_from_kernel
from lensmodel.report.lens_report import Range, lens_report
from lensmodel.simulate import CameraLens, SimulatedCamera, photograph, write_photo

MARGIN: Final = 40  # pixels of scene beyond the frame
LEAN_DEG: Final = 5.0
_SIZE: Final = 41  # pixels of the kernels that are the truth


@dataclass(frozen=True, slots=True)
class Square:
    """One dark square: its middle in pixels (row, col), and its side."""

    row: float
    col: float
    side: float


def squares_chart(
    frame: Frame,
    *,
    rows: int = 5,
    cols: int = 7,
    lean_deg: float = LEAN_DEG,
    fill: float = 0.6,
    dark: float = 0.12,
    bright: float = 0.7,
) -> tuple[Planes, tuple[Square, ...]]:
    """Draw rows x cols dark squares on bright paper, the whole page turned by `lean_deg` counter-clockwise.

    `fill` is the side of a square over the distance of two. The spectrum of the scene is that of an ideal
    chart as far as pixels can show it: the box of the pixels in which areas were counted is divided out.
    """
    spacing = min(frame.height / rows, frame.width / cols) * 0.97
    half = fill * spacing / 2.0
    turn = math.radians(lean_deg)
    height, width = frame.height + 2 * MARGIN, frame.width + 2 * MARGIN
    plane = np.full((height, width), bright)
    squares = []
    for i in range(rows):
        for j in range(cols):
            right, down = (j - (cols - 1) / 2) * spacing, (i - (rows - 1) / 2) * spacing
            row = frame.center[0] + down * math.cos(turn) - right * math.sin(turn)
            col = frame.center[1] + right * math.cos(turn) + down * math.sin(turn)
            squares.append(Square(row, col, 2 * half))
            reach = math.ceil(half * 1.5) + 2
            top, left = round(row) + MARGIN - reach, round(col) + MARGIN - reach
            part = np.s_[max(top, 0) : top + 2 * reach, max(left, 0) : left + 2 * reach]
            y = np.arange(height)[part[0]][:, None] - MARGIN - row
            x = np.arange(width)[part[1]][None, :] - MARGIN - col
            plane[part] -= (bright - dark) * _band(y, x, turn, half) * _band(y, x, turn + math.pi / 2, half)
    return np.ascontiguousarray(np.broadcast_to(_without_box(plane), (3, height, width))), tuple(squares)


def _band(
    y: NDArray[np.floating], x: NDArray[np.floating], normal: float, half: float
) -> NDArray[np.float64]:
    """Share of each pixel between two parallel lines, each `half` from the origin."""
    c, s = math.cos(normal), math.sin(normal)
    return edge_area(y - half * s, x + half * c, normal) - edge_area(y + half * s, x - half * c, normal)


def _without_box(plane: NDArray[np.float64]) -> NDArray[np.float32]:
    """Divide the spectrum by that of one pixel."""
    rows, cols = fft.fftfreq(plane.shape[0]), fft.rfftfreq(plane.shape[1])
    box = np.sinc(rows)[:, None] * np.sinc(cols)[None, :]
    return np.asarray(fft.irfft2(fft.rfft2(plane) / box, s=plane.shape), dtype=np.float32)


def true_mtf50(lens: CameraLens, place: FieldPosition, normal: float, pitch_um: float) -> float:
    """MTF50 in cycles/pixel of the lens's own green kernel along a normal, by a plain sum over its pixels."""
    h = (place.r * math.cos(place.phi), place.r * math.sin(place.phi))
    kernel = lens.kernel_at_field(h, LensSettings(), _SIZE, pitch_um=pitch_um, offset=(0.0, 0.0))
    t = np.arange(_SIZE) - _SIZE // 2
    along = t[None, :] * math.cos(normal) - t[:, None] * math.sin(normal)
    frequencies = np.linspace(0.0, 0.75, 751)
    mtf = np.abs(np.exp(-2j * np.pi * np.outer(frequencies, along.ravel())) @ kernel.ravel())
    below = np.flatnonzero(mtf < 0.5 * mtf[0])
    return float(frequencies[below[0]]) if below.size else 1.0


@dataclass(frozen=True, slots=True)
class Sharpness:
    """T and S at a place, MTF50 in cycles/pixel, a report's ranges, and whether it calls them a guess."""

    place: FieldPosition
    tangential: float
    sagittal: float
    ranges: tuple[Range, Range] | None = None
    guessed: bool = False


def main() -> None:
    """Print T and S of a traced lens by zone: by its chart, by photos, and as they are."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "grid", type=Path, help="of a traced lens, as `python -m lab.population grid` writes it"
    )
    parser.add_argument("--photos", type=int, default=3, help="from which the lens is learned too; 0: none")
    parser.add_argument("--places", action="store_true", help="print each square of the chart")
    asked = parser.parse_args()
    lens = GridLens.read(asked.grid)
    pitch_um = lens.grid.pitch_um
    ways = {"chart": by_chart(lens, pitch_um)}
    if asked.photos:
        ways[f"{asked.photos} photos"] = by_photos(lens, asked.photos, pitch_um)
    print(
        f"{lens.identity.model}, MTF50 in cycles/pixel: median of a zone, its truth, how far off half of "
        "the places are"
    )
    for zone in ZONES:
        for way, found in ways.items():
            if own := [one for one in found if zone_of(one.place.r) == zone]:
                print(f"{zone:7}{way:>9}  {_line(lens, own, pitch_um)}")
    if asked.places:
        for one in sorted(ways["chart"], key=lambda one: one.place.r):
            where = f"r {one.place.r:.2f} phi {math.degrees(one.place.phi):4.0f}"
            print(f"{where}: {_line(lens, [one], pitch_um)}")


def by_chart(lens: GridLens, pitch_um: float) -> list[Sharpness]:
    """Photograph the chart through the lens, and measure it."""
    camera = SimulatedCamera(height=2000, width=3000, pitch_um=pitch_um)
    scene, _ = squares_chart(camera.frame)
    shot = photograph(scene, lens, LensSettings(), camera, np.random.default_rng(0))
    with tempfile.TemporaryDirectory() as folder:
        write_photo(Path(folder) / "chart.dng", shot)
        photo = develop(Path(folder) / "chart.dng")
    psfs = SlantedEdges().measure([photo], size=31, channels=("g",))
    found = []
    for psf in psfs:
        t, s = (mtf50_from_kernel(psf.kernel, psf.position.phi + turn) for turn in (0.0, math.pi / 2))
        found.append(Sharpness(psf.position, t, s))
    return found


def by_photos(lens: GridLens, photos: int, pitch_um: float) -> list[Sharpness]:
    """Learn the lens from photos, and read its report."""
    known = KnownLens("", lens, 2000, replace(CAMERA, pitch_um=pitch_um))
    with tempfile.TemporaryDirectory() as folder:
        shots = [Path(folder) / f"{number}.dng" for number in range(photos)]
        for number, path in enumerate(shots):
            known.shot(number, path)
        model = calibrate(shots, aperture=known.settings.aperture).model
    found = lens_report(model, "").tested[0]
    return [Sharpness(s.position, *s.mtf50, s.ranges, s.unknown) for s in found.map]


def _line(lens: CameraLens, found: Sequence[Sharpness], pitch_um: float) -> str:
    """Medians of T and S, those of the truth at the same places, the median error, and what ranges hold."""
    words = []
    for way, (name, turn) in enumerate((("T", 0.0), ("S", math.pi / 2))):
        figures = [one.sagittal if turn else one.tangential for one in found]
        true = [min(true_mtf50(lens, one.place, one.place.phi + turn, pitch_um), 0.5) for one in found]
        seen = np.minimum(figures, 0.5)
        median, truth = np.median(seen), np.median(true)
        off = np.median(np.abs(seen / true - 1.0))
        ranges = [one.ranges[way] for one in found if one.ranges is not None]
        held = [min(low, 0.5) <= value <= high for value, (low, high) in zip(true, ranges, strict=False)]
        own = [f"{round(median / truth - 1.0, 2) + 0.0:+.0%}", f"places {off:.0%}"]
        own += [f"ranges hold {sum(held)} of {len(held)}"] if held else []
        words.append(f"{name} {median:.3f} truth {truth:.3f} ({', '.join(own)})")
    guessed = sum(one.guessed for one in found)
    return ", ".join([*words, *([f"hatched {guessed} of {len(found)}"] if guessed else [])])


if __name__ == "__main__":
    main()
