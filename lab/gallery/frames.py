"""The simulated frames: hard scenes, taken through lenses whose PSF is known, as files of a camera."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

import lensmodel
from lab.gallery import scenes
from lab.gallery.rendering import rendered
from lab.reproduce import conditions
from lab.reproduce.scenes import MARGIN
from lensmodel.core.files import atomic
from lensmodel.core.types import LensSettings, Planes
from lensmodel.photo import develop, write_image
from lensmodel.simulate import SimulatedCamera, draw_lens, photograph, write_photo

HEIGHT: Final = 832
WIDTH: Final = 1248
"""A megapixel: all demo photographs cover it, and it is calibrated in half a minute."""

JPEG_QUALITY: Final = 92  # of 100 (chosen): that of a fine JPEG, as in `lab.camera_jpeg`


@dataclass(frozen=True, slots=True)
class SimulatedFrame:
    """One simulated photo.

    Parameters
    ----------
    name : str
        Of its file, too.
    scene : callable
        `(rng, height, width) -> Planes`.
    lens : int
        Seed of the lens.
    jpeg : bool
        Whether it is a camera's JPEG, else a DNG.
    full_well_electrons, read_noise : float
        Of the sensor at this ISO, electrons.
    """

    name: str
    scene: Callable[[np.random.Generator, int, int], Planes]
    lens: int
    jpeg: bool = False
    full_well_electrons: float = 50_000.0
    read_noise: float = 50.0

    @property
    def file(self) -> str:
        """Name of its file."""
        return f"{self.name}{'.jpg' if self.jpeg else '.dng'}"


def _page(rng: np.random.Generator, height: int, width: int) -> Planes:
    return conditions.text(np.zeros((3, height, width), dtype=np.float32), rng)


FRAMES: Final = (
    SimulatedFrame("clipped-lamps", scenes.lamps, 1000),
    SimulatedFrame("red-cars", scenes.red_cars, 1001),
    SimulatedFrame("night-high-iso", scenes.night, 1002, full_well_electrons=2500.0, read_noise=7.5),
    SimulatedFrame("snow-twigs", scenes.snow, 1003),
    SimulatedFrame("faces", scenes.faces, 1004, jpeg=True),
    SimulatedFrame("foliage", scenes.foliage, 1005),
    SimulatedFrame("text", _page, 1006),
    SimulatedFrame("sky-gradient", scenes.sky, 1007, jpeg=True),
)
"""Each through another kind of lens; the noise is that of the reproduction at base and high ISO."""


def take(
    frame: SimulatedFrame, folder: Path, *, height: int = HEIGHT, width: int = WIDTH
) -> tuple[Path, Path]:
    """Take a frame unless it is there.

    Returns
    -------
    photo : Path
        DNG or JPEG.
    truth : Path
        npy, uint16 `(row, col, 3)`: what a perfect lens would have shown, rendered as the photo is.
    """
    photo, truth = folder / frame.file, folder / f"{frame.name}-truth.npy"
    if photo.exists() and truth.exists():
        return photo, truth
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([frame.lens, 18])
    lens = draw_lens(frame.lens)
    camera = SimulatedCamera(
        height=height,
        width=width,
        full_well_electrons=frame.full_well_electrons,
        read_noise=frame.read_noise,
    )
    focal = lens.focal_mm[0]
    settings = LensSettings(aperture=lens.at_focal(focal).f_number, focal_mm=focal)
    taken = photograph(frame.scene(rng, height + 2 * MARGIN, width + 2 * MARGIN), lens, settings, camera, rng)
    raw = folder / f"{frame.name}.dng"
    write_photo(raw, taken)
    developed = develop(raw)
    with atomic(truth) as file:
        np.save(file, rendered(taken.sharp, developed.encoding), allow_pickle=False)
    if frame.jpeg:
        write_image(
            photo,
            developed.planes,
            developed.encoding,
            format="jpeg",
            color_space="srgb",
            quality=JPEG_QUALITY,
        )
        raw.unlink()
    return photo, truth


def version() -> str:
    """Hash of the code that frames come from: what another version took is taken again."""
    root = Path(lensmodel.__file__).parent
    code = [*sorted((root / "simulate").glob("*.py")), Path(__file__), Path(inspect.getfile(scenes))]
    total = hashlib.sha256()
    for path in code:
        total.update(path.read_bytes())
    return total.hexdigest()[:12]
