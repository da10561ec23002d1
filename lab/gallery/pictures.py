"""Which pictures entries_of in the gallery: every real one of the test data, and frames of hard scenes."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import tifffile
from numpy.typing import NDArray

from lab.reproduce.cases import MARGIN
from lab.reproduce.shots import JPEG_QUALITY
from lab.scenes import hard_scene
from lab.stored import version_of
from lab.traced import GridLens
from lensmodel.core.errors import InvalidInputError, LensModelError, NotAnImageError
from lensmodel.core.files import atomic
from lensmodel.core.psf import PsfField
from lensmodel.core.types import LensSettings, Planes
from lensmodel.photo import Encoding, develop, inspect, write_image
from lensmodel.simulate import SimulatedCamera, SimulatedLens, draw_lens, photograph, write_photo

Rendered = NDArray[np.uint16]
"""A picture `(row, col, 3)`, sRGB, 0 to 65535, in sensor orientation."""


def rendered(planes: Planes, encoding: Encoding) -> Rendered:
    """Render linear planes as the program writes them for a viewer: an sRGB TIFF of 16 bits."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "picture.tif"
        write_image(path, planes, encoding, format="tiff16", color_space="srgb")
        return read_rendered(path)


def read_rendered(path: Path) -> Rendered:
    """Read a TIFF of 16 bits a channel."""
    picture: Rendered = tifffile.imread(path)[..., :3].astype(np.uint16, copy=False)
    return picture


HEIGHT: Final = 832
WIDTH: Final = 1248
"""A megapixel: all demo photographs cover it, and it is calibrated in half a minute."""

FOLDERS: Final = ("real", "large", "raw", "series", "meta")
STARS: Final = ("psf", (".tif", ".tiff"))
"""Star fields lie among other measurements of points."""

SUBJECTS: Final = {"faces": (215, 230)}
"""An eye and the skin below it."""

SMALLEST: Final = 64
"""Shorter side of a picture that shows anything; stand-ins for metadata are smaller."""


@dataclass(frozen=True, slots=True)
class SimulatedFrame:
    """One simulated photo."""

    name: str  # of its file, too
    scene: str  # name in `lab.scenes.HARD_SCENES`
    lens: int  # seed of the lens
    jpeg: bool = False  # whether it is a camera's JPEG, else a DNG
    full_well_electrons: float = 50_000.0  # of the sensor at this ISO, electrons
    read_noise: float = 50.0
    grid: Path | None = None  # of a ray-traced lens that takes the place of the drawn one

    @property
    def optics(self) -> SimulatedLens | GridLens:
        """The lens."""
        return draw_lens(self.lens) if self.grid is None else GridLens.read(self.grid)

    @property
    def settings(self) -> LensSettings:
        """Wide open."""
        focal = self.optics.focal_mm[0]
        return LensSettings(aperture=self.optics.widest(focal), focal_mm=focal)

    def truth(self) -> PsfField:
        """Return the true PSF field."""
        return self.optics.field(self.settings)

    @property
    def file(self) -> str:
        """Name of its file."""
        return f"{self.name}{'.jpg' if self.jpeg else '.dng'}"


FRAMES: Final = (
    SimulatedFrame("clipped-lamps", "lamps", 1000),
    SimulatedFrame("red-cars", "red-cars", 1001),
    SimulatedFrame("night-high-iso", "night", 1002, full_well_electrons=2500.0, read_noise=7.5),
    SimulatedFrame("snow-twigs", "snow", 1003),
    SimulatedFrame("faces", "faces", 1004, jpeg=True),
    SimulatedFrame("foliage", "foliage", 1005),
    SimulatedFrame("text", "text", 1006),
    SimulatedFrame("sky-gradient", "sky", 1007, jpeg=True),
)
"""Each through another kind of lens; the noise is that of the reproduction at base and high ISO."""


def take(
    frame: SimulatedFrame, folder: Path, *, height: int = HEIGHT, width: int = WIDTH
) -> tuple[Path, Path]:
    """Take a frame unless it is there."""
    photo, truth = folder / frame.file, folder / f"{frame.name}-truth.npy"
    if photo.exists() and truth.exists():
        return photo, truth
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([frame.lens, 18])
    camera = SimulatedCamera(
        height, width, full_well_electrons=frame.full_well_electrons, read_noise=frame.read_noise
    )
    scene = hard_scene(frame.scene, height + 2 * MARGIN, width + 2 * MARGIN, rng)
    taken = photograph(scene, frame.optics, frame.settings, camera, rng)
    raw = folder / f"{frame.name}.dng"
    write_photo(raw, taken)
    developed = develop(raw)
    with atomic(truth) as file:
        np.save(file, rendered(taken.sharp, developed.encoding), allow_pickle=False)
    if frame.jpeg:
        planes, encoding = developed.planes, developed.encoding
        write_image(photo, planes, encoding, format="jpeg", color_space="srgb", quality=JPEG_QUALITY)
        raw.unlink()
    return photo, truth


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture of the gallery."""

    name: str  # for people: folder and file, or "simulated/" and the frame
    path: Path  # the photo; of a simulated frame it is taken when its turn comes
    truth: Path | None = None  # npy of what a perfect lens would have shown; only of simulated frames
    unreadable: str = ""  # why the file cannot be read; "" where it can
    # pixel `(row, col)` of what the picture is about, where the usual places may miss it
    subject: tuple[int, int] | None = None

    @property
    def slug(self) -> str:
        """The name as part of a file's name."""
        return re.sub(r"[^A-Za-z0-9_]+", "-", self.name).strip("-")


def real_pictures(folder: Path) -> list[Picture]:
    """Find the real pictures of the test data, those included that cannot be read."""
    files = [path for name in FOLDERS for path in sorted((folder / name).glob("*")) if path.is_file()]
    files += [path for path in sorted((folder / STARS[0]).glob("*")) if path.suffix.lower() in STARS[1]]
    found = []
    for path in files:
        name = f"{path.parent.name}/{path.name}"
        try:
            info = inspect(path)
        except NotAnImageError:
            continue
        except LensModelError as error:
            found.append(Picture(name, path, unreadable=str(error)))
            continue
        if min(info.width, info.height) >= SMALLEST:
            found.append(Picture(name, path))
    if not found:
        raise InvalidInputError(
            f"{folder} has no picture in {', '.join(FOLDERS)}; name the test data's folder"
        )
    return found


def simulated_pictures(cache: Path) -> list[Picture]:
    """Name the simulated frames; they are taken when their turn comes."""
    folder = cache / f"frames-{version_of('lab.gallery.pictures')[:12]}"
    return [
        Picture(
            f"simulated/{frame.name}",
            folder / frame.file,
            folder / f"{frame.name}-truth.npy",
            subject=SUBJECTS.get(frame.name),
        )
        for frame in FRAMES
    ]


def taken(picture: Picture) -> None:
    """Take a simulated frame whose turn has come."""
    if picture.truth is not None:
        take(next(frame for frame in FRAMES if frame.file == picture.path.name), picture.path.parent)


def chosen(pictures: Sequence[Picture], only: Sequence[str]) -> list[Picture]:
    """Keep the pictures whose name holds one of some texts; all where none is given."""
    for text in only:
        if not any(text in picture.name for picture in pictures):
            names = ", ".join(picture.name for picture in pictures)
            raise InvalidInputError(f"no picture is called {text!r}; there are {names}")
    return [p for p in pictures if not only or any(text in p.name for text in only)]
