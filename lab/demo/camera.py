"""The demo's camera: sharp photographs seen through a simulated lens, as Bayer DNG files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from lab.scenes import photograph_of
from lensmodel.core.types import LensSettings, Planes
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
