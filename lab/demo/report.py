"""The demo's photos, by a simulated lens, and what is measured against a truth that no service saw."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from app.client import Client
from lab.charts import by_zone, measure_edges
from lab.images import Picture, fidelity
from lab.scenes import photograph_of
from lensmodel.cli.console import mtf50_words
from lensmodel.core.geometry import zone_of
from lensmodel.core.psf import distance
from lensmodel.core.types import ZONES, FieldPosition, LensSettings, Planes, Zone
from lensmodel.simulate import SimulatedCamera, draw_lens, edge_chart, photograph, write_photo

LENS: Final = draw_lens(2024, "soft-fast")
"""The lens of the demo (seed chosen: any number); nothing in the project was tuned on it."""

CAMERA: Final = SimulatedCamera(height=896, width=1456)
"""1.3 megapixels, base ISO; every scene covers its frame."""

SETTINGS: Final = LensSettings(aperture=LENS.at_focal().f_number, focal_mm=LENS.focal_mm[0])
"""Of all its photos: wide open."""

_MARGIN: Final = 18  # pixels by which every photograph exceeds the frame

LEARN_FROM = ("city", "lake", "tea-gardens")
HELD_OUT = "colosseum"
CHART = "chart"


@dataclass(frozen=True, slots=True)
class DemoShot:
    """One photo that the demo took."""

    name: str  # name of the scene
    path: Path  # the DNG file
    sharp: Planes  # light that a perfect lens would have put on the sensor, not white-balanced, saturation 1


def take_photos(folder: Path, *, on_photo: Callable[[str], None]) -> dict[str, DemoShot]:
    """Photograph every scene through the lens; `on_photo` takes the name of each before it is taken."""
    folder.mkdir(parents=True, exist_ok=True)
    shots: dict[str, DemoShot] = {}
    for number, name in enumerate((*LEARN_FROM, HELD_OUT, CHART)):
        on_photo(name)
        scene = edge_chart(CAMERA.frame).scene if name == CHART else _scene(name)
        photo = photograph(scene, LENS, SETTINGS, CAMERA, np.random.default_rng(number))
        shots[name] = DemoShot(name, folder / f"{name}.dng", photo.sharp)
        write_photo(shots[name].path, photo)
    return shots


def _scene(name: str) -> Planes:
    """The middle of a photograph."""
    return photograph_of(name, CAMERA.height + 2 * _MARGIN, CAMERA.width + 2 * _MARGIN)


_JUDGED: Final[tuple[Zone, ...]] = ("center", "corner")
_GAP = 6  # pixels between crops (chosen)


@dataclass(frozen=True, slots=True)
class Sharpness:
    """Slanted edges of one zone: MTF50 in cycles/pixel, highest value of the MTF, overshoot in percent."""

    mtf50: float
    mtf_max: float
    overshoot: float


@dataclass(slots=True)
class DemoReport:
    """Filled in as the demo goes; one entry of a list for each photo that the lens has learned from."""

    lens: str
    aperture: float
    psf_error: list[dict[Zone, float]] = field(default_factory=list)
    psnr_before: dict[Zone, float] = field(default_factory=dict)
    psnr_after: list[dict[Zone, float]] = field(default_factory=list)
    chart_before: dict[Zone, Sharpness] = field(default_factory=dict)
    chart_after: dict[Zone, Sharpness] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def improved(self) -> bool:
        """Whether the photo never used for calibration has become better in centre and corner."""
        return bool(self.psnr_after) and all(
            self.psnr_after[-1][zone] > self.psnr_before[zone] for zone in _JUDGED
        )

    def write(self, folder: Path) -> None:
        """Write report.md."""
        (folder / "report.md").write_text(self._text(), encoding="utf-8")

    def _text(self) -> str:
        learned = "\n".join(
            f"| {number} | {_row(error)} | {_row(after)} |"
            for number, (error, after) in enumerate(
                zip(self.psf_error, self.psnr_after, strict=True), start=1
            )
        )
        edges = "\n".join(
            f"| {zone} | {mtf50_words(before.mtf50)} | {mtf50_words(after.mtf50)} "
            f"| {after.mtf_max:.2f} | {after.overshoot:.1f} % |"
            for zone, before in self.chart_before.items()
            if (after := self.chart_after.get(zone)) is not None
        )
        return f"""# What the demo measured

Lens: {self.lens}, at f/{self.aperture:g}, simulated, so that the truth is known. The photo that it was never
calibrated with became **{"better" if self.improved else "NOT better"}** in centre and corner.

| photos learned from | PSF error centre / mid / corner | PSNR centre / mid / corner (dB) |
| --- | --- | --- |
| 0, the photo as it was | | {_row(self.psnr_before)} |
{learned}

PSF error: relative L2 distance to the true green PSF after sub-pixel alignment, median of the zone; 0 is
perfect. PSNR: sRGB-encoded picture against the sharp scene, each block of 128 pixels at its best shift,
before and after alike: a PSF's centre of mass may lie beside its core, which displaces the picture smoothly
but does not blur it.

| slanted edges of a chart | MTF50 before | MTF50 after | highest MTF after | overshoot after |
| --- | --- | --- | --- | --- |
{edges}

MTF50 in cycles/pixel, green. A PSF that is too wide raises MTF50 as well, but then the highest MTF rises
above 1 and edges overshoot: read them together.

The whole demo took {self.seconds:.0f} s.

Files: corrected.tif (16 bit), before-after.png, service.log.
"""


def _row(values: dict[Zone, float]) -> str:
    return " / ".join(f"{values[zone]:.2f}" for zone in ZONES)


def psf_error(client: Client, lens_id: str, version: int) -> dict[Zone, float]:
    """Median relative L2 error of the served green PSFs in each zone, after sub-pixel alignment."""
    errors: dict[Zone, list[float]] = {zone: [] for zone in ZONES}
    for r, count in ((0.05, 1), (0.2, 3), (0.45, 4), (0.6, 4), (0.85, 4)):  # not where patches lie
        for i in range(count):
            phi = 2 * math.pi * (i + 0.3) / count - math.pi
            answer = client.psf(lens_id, r=r, phi=phi, aperture=SETTINGS.aperture, size=55, version=version)
            kernel = np.asarray(answer.psf.data)
            truth = LENS.kernel(FieldPosition(r, phi), SETTINGS, 55, pitch_um=CAMERA.pitch_um)
            errors[zone_of(r)].append(distance(kernel, truth).rel_l2)
    return {zone: float(np.median(values)) for zone, values in errors.items()}


def psnr(planes: Planes, shot: DemoShot) -> dict[Zone, float]:
    """PSNR in dB of the sRGB-encoded, white-balanced picture in each zone, registered block by block."""
    gains = np.asarray(CAMERA.white_balance, dtype=np.float32)[:, None, None]
    return fidelity(planes * gains, shot.sharp * gains, CAMERA.frame)


def sharpness(planes: Planes) -> dict[Zone, Sharpness]:
    """MTF50, maximum of the MTF and overshoot on the green edges of the chart, by zone."""
    boxes = [edge.box for edge in edge_chart(CAMERA.frame).edges]
    found = by_zone(measure_edges(planes[1], boxes))
    return {zone: Sharpness(row.mtf50, row.mtf_max, row.overshoot) for zone, row in found.items()}


def draw_crops(rows: Mapping[str, Picture], path: Path, *, side: int = 180) -> None:
    """Write a PNG with one row of crops for each picture, two screen pixels for one of its own.

    They are where the last picture has most detail.
    """
    pictures, large = list(rows.items()), 2 * side
    places = _detailed(pictures[-1][1], side)
    size = (len(places) * (large + _GAP) + _GAP, len(pictures) * (large + _GAP) + _GAP)
    sheet = Image.new("RGB", size, "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(18)
    for i, (label, picture) in enumerate(pictures):
        top = _GAP + i * (large + _GAP)
        for j, (row, col) in enumerate(places):
            crop = Image.fromarray(picture[row : row + side, col : col + side])
            sheet.paste(
                crop.resize((large, large), Image.Resampling.NEAREST), (_GAP + j * (large + _GAP), top)
            )
        draw.rectangle((_GAP, top, _GAP + 20 + draw.textlength(label, font), top + 30), "#000c")
        draw.text((_GAP + 10, top + 4), label, "white", font)
    sheet.save(path, optimize=True)


def _detailed(picture: Picture, side: int, count: int = 3) -> list[tuple[int, int]]:
    """Top left corners of the windows with the steepest steps that do not overlap, from left to right."""
    grey = picture.mean(axis=2)
    steep = np.abs(np.diff(grey, axis=0))[:, :-1] + np.abs(np.diff(grey, axis=1))[:-1]
    sums = np.pad(steep.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    inside = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    found = []
    for _ in range(count):
        row, col = (int(place) for place in np.unravel_index(inside.argmax(), inside.shape))
        inside[max(row - side, 0) : row + side, max(col - side, 0) : col + side] = -1.0
        found.append((row, col))
    return sorted(found, key=lambda place: place[1])
