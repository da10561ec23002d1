"""The pictures of the gallery: every real one of the test data, and frames of hard scenes; corrected."""

from __future__ import annotations

import hashlib
import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import tifffile
from numpy.typing import NDArray

import lensmodel
from lab.reproduce.cases import BASE_ISO, JPEG_QUALITY, MARGIN
from lab.scenes import hard_scene
from lab.stored import Unit, stored, version_of
from lab.traced import GridLens, known_lens, wide_open
from lensmodel.blind.sampling import CalibrationEvent
from lensmodel.core.errors import InvalidInputError, LensModelError, NotAnImageError
from lensmodel.core.files import atomic
from lensmodel.core.psf import PsfField
from lensmodel.core.types import Planes
from lensmodel.photo import Encoding, develop, inspect, write_image
from lensmodel.simulate import SimulatedCamera, SimulatedLens, photograph, write_photo

Rendered = NDArray[np.uint16]  # a picture `(row, col, 3)`, sRGB, 0 to 65535, in sensor orientation


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
WIDTH: Final = 1248  # a megapixel: all demo photographs cover it, and it is calibrated in half a minute

FOLDERS: Final = ("real", "large", "raw", "series", "meta")
STARS: Final = ("psf", (".tif", ".tiff"))  # star fields lie among other measurements of points
SUBJECTS: Final = {"faces": (215, 230)}  # an eye and the skin below it
SMALLEST: Final = 64  # shorter side of a picture that shows anything; stand-ins for metadata are smaller


@dataclass(frozen=True, slots=True)
class SimulatedFrame:
    """One simulated photo."""

    name: str  # of its file, too
    scene: str  # name in `lab.scenes.HARD_SCENES`
    lens: int  # seed of the lens
    jpeg: bool = False  # whether it is a camera's JPEG, else a DNG
    camera: SimulatedCamera = BASE_ISO
    grid: Path | None = None  # of a ray-traced lens that takes the place of the drawn one

    @property
    def optics(self) -> SimulatedLens | GridLens:
        """The lens."""
        return known_lens(self.lens, self.grid)

    def truth(self) -> PsfField:
        """Return the true PSF field."""
        return self.optics.field(wide_open(self.optics))

    @property
    def file(self) -> str:
        """Name of its file."""
        return f"{self.name}{'.jpg' if self.jpeg else '.dng'}"

    @property
    def truth_file(self) -> str:
        """Name of the file of its truth, npy."""
        return f"{self.name}-truth.npy"


HIGH_ISO: Final = SimulatedCamera(full_well_electrons=2500.0, read_noise=7.5)
FRAMES: Final = (
    SimulatedFrame("clipped-lamps", "lamps", 1000),
    SimulatedFrame("red-cars", "red-cars", 1001),
    SimulatedFrame("night-high-iso", "night", 1002, camera=HIGH_ISO),
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
    photo, truth = folder / frame.file, folder / frame.truth_file
    if photo.exists() and truth.exists():
        return photo, truth
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([frame.lens, 18])
    camera = replace(frame.camera, height=height, width=width)
    scene = hard_scene(frame.scene, height + 2 * MARGIN, width + 2 * MARGIN, rng)
    taken = photograph(scene, frame.optics, wide_open(frame.optics), camera, rng)
    raw = folder / f"{frame.name}.dng"
    write_photo(raw, taken)
    developed = develop(raw)
    _save(truth, rendered(taken.sharp, developed.encoding))
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
    frame: SimulatedFrame | None = None
    unreadable: str = ""  # why the file cannot be read; "" where it can
    # pixel `(row, col)` of what the picture is about, where the usual places may miss it
    subject: tuple[int, int] | None = None

    @property
    def truth(self) -> Path | None:
        """Path of what a perfect lens would have shown (npy); None for real pictures."""
        return None if self.frame is None else self.path.with_name(self.frame.truth_file)

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
            if min(info.width, info.height) >= SMALLEST:
                found.append(Picture(name, path))
        except NotAnImageError:
            continue
        except LensModelError as error:
            found.append(Picture(name, path, unreadable=str(error)))
    if not found:
        raise InvalidInputError(f"{folder} has no picture in {', '.join(FOLDERS)}; name the test data")
    return found


def simulated_pictures(cache: Path) -> list[Picture]:
    """Name the simulated frames; they are taken when their turn comes."""
    folder = cache / f"frames-{version_of(__name__)[:12]}"
    return [
        Picture(f"simulated/{frame.name}", folder / frame.file, frame, subject=SUBJECTS.get(frame.name))
        for frame in FRAMES
    ]


def chosen(pictures: Sequence[Picture], only: Sequence[str]) -> list[Picture]:
    """Keep the pictures whose name holds one of some texts; all where none is given."""
    for text in only:
        if not any(text in picture.name for picture in pictures):
            names = ", ".join(picture.name for picture in pictures)
            raise InvalidInputError(f"no picture is called {text!r}; there are {names}")
    return [p for p in pictures if not only or any(text in p.name for text in only)]


BEFORE, AFTER = "before.npy", "after.npy"  # pictures as stored, rendered
ANY_APERTURE: Final = 5.6  # of photos that do not say theirs (chosen): of no effect where one photo is all

Words = Callable[[str], None]


def work(picture: Picture, cache: Path, workers: int, say: Words) -> tuple[Path, Unit]:
    """Return the folder of the pictures, before and after, and how they were made."""
    if picture.frame is not None:
        say("taking the photo")
        take(picture.frame, picture.path.parent)
    with picture.path.open("rb") as file:
        content = hashlib.file_digest(file, "sha256").hexdigest()[:8]
    folder = cache / f"{picture.slug}-{content}-{version_of(__name__)[:8]}"
    return folder, stored(folder / "work.json", lambda: _worked(picture, folder, workers, say))


def _worked(picture: Picture, folder: Path, workers: int, say: Words) -> Unit:
    say("developing")
    developed = develop(picture.path)
    _save(folder / BEFORE, rendered(developed.planes, developed.encoding))
    aperture = ANY_APERTURE if developed.info.metadata.aperture is None else None
    note = "" if aperture is None else "the file does not say its aperture, which was given as by --aperture"
    unit: Unit = {"state": "left alone", "reason": "", "note": note, "announced": {}}
    reasons: list[str] = []

    def heard(event: CalibrationEvent) -> None:
        if event.stage == "skipped":
            reasons.append(event.detail)

    say("calibrating")
    try:
        lens = lensmodel.calibrate(picture.path, aperture=aperture, workers=workers, on_event=heard)
    except LensModelError as error:
        return {**unit, "reason": f"calibration was refused: {reasons[0] if reasons else error}"}
    say("correcting")
    with tempfile.TemporaryDirectory(prefix="lensmodel-gallery-") as name:
        output = Path(name) / "corrected.tif"
        try:
            corrected = lensmodel.correct(
                picture.path, lens, output, aperture=aperture, color_space="srgb", workers=workers
            )
        except LensModelError as error:
            return {**unit, "reason": f"correction was refused: {error}"}
        _save(folder / AFTER, read_rendered(output))
    announced = {zone: report.expected_gain_db for zone, report in corrected.zones.items()}
    return {**unit, "state": "corrected", "announced": announced}


def _save(path: Path, values: Rendered) -> None:
    """Keep an array, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic(path) as file:
        np.save(file, values, allow_pickle=False)
