"""What a reproduction runs: which lenses, behind which frames, learned from how many photos of what."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Final, Literal, TypeAlias

import numpy as np
from PIL import Image

import lensmodel
from lab import traced as stored
from lab.cases import list_photos, photo_half
from lab.population.prescriptions import LOOKED_AT
from lab.stored import version_of
from lab.traced import GridLens
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfField
from lensmodel.core.types import LensSettings, Planes
from lensmodel.simulate import CameraLens, SimulatedCamera, SimulatedField, draw_lens, load_scene

Size: TypeAlias = Literal["quick", "default"]
Family: TypeAlias = Literal["third order", "ray-traced"]

PROTOCOL: Final = 8
"""Part of every key of a stored result; raised when what is measured changes."""

METHOD: Final = "standard"
"""Non-blind method of all corrections but the paper's own way."""

# Names of what becomes of the photos of a lens, beside what was learned by default, see `learned`.
BEFORE: Final = "without correction"
RIVAL: Final = "Schuler et al. 2012, n = 1"
GENERAL: Final = "general profile of the lens model"
PAPER_WAY: Final = "the paper's own way"
MEASURED: Final = "measured with a target"
TRUE: Final = "true PSF"

FIRST_SEED: Final = 1000
"""Seeds of third-order lenses below are for development, and parameters are chosen on them."""

SEEDS: Final = (1008, *range(1001, 1008))
"""Of third-order lenses, one of each kind; the soft 1008 instead of 1000, so that half are unseen."""

SOFT_SEED: Final = 1008

SEEDS_LOOKED_AT: Final = frozenset({1000, 1001, 1002, 1003, 1006})
"""Of those beyond: results of these were looked into during development."""

# Seeds of ray-traced lenses (chosen): above those of drawn ones, so many that designs hardly share one.
_TRACED_FROM: Final = 2000
_TRACED: Final = 100_000

_QUICK_FRAME: Final = (640, 960)  # rows and columns (chosen): 0.6 megapixels
_PHOTOS: Final = {"quick": (1, 2), "default": (1, 2, 5, 10)}


MARGIN: Final = 28
"""Pixels that a scene reaches beyond the frame on every side: half a kernel."""

_GRIDS: Final = ((1, 1), (1, 2), (2, 2))  # rows and columns of photographs in a frame


@dataclass(frozen=True, slots=True)
class Layout:
    """How frames are made of photographs."""

    rows: int  # grid of photographs in one frame
    cols: int
    tile: tuple[int, int]  # (height, width) that is cut from the middle of each

    @property
    def frame(self) -> tuple[int, int]:
        """Largest (height, width) of a frame that still has its margin; even."""
        height, width = self.rows * self.tile[0] - 2 * MARGIN, self.cols * self.tile[1] - 2 * MARGIN
        return height // 2 * 2, width // 2 * 2


def learned(number: int | str) -> str:
    """Name of what was learned by default from so many photos."""
    return f"n = {number}"


def repository_grids() -> tuple[Path, ...]:
    """Grids of ray-traced lenses that lie in the repository; none where it is not there."""
    folder = Path(lensmodel.__file__).parents[1] / "tests/lensmodel/data"
    return tuple(sorted(folder.glob("traced-*.npz")))


@lru_cache(maxsize=16)
def traced(path: Path) -> GridLens:
    """Read a ray-traced lens at the one aperture of a grid file."""
    return GridLens.read(path)


def design(path: Path) -> str:
    """Name of the design of a grid."""
    return str(traced(path).grid.facts["design"])


@dataclass(frozen=True, slots=True)
class Case:
    """One lens wide open, and the numbers of photos it is learned from."""

    # of `draw_lens`, or the number of a ray-traced lens; it also mixes the order of the photographs
    seed: int
    focal_mm: float  # how the lens is set
    aperture: float
    photos: tuple[int, ...]  # ascending: the model is measured after each of these numbers of photos
    height: int  # of the camera, pixels
    width: int
    layout: Layout  # how frames are made of photographs
    grid: Path | None = None  # PSFs of a ray-traced lens; None means a lens of third order

    @property
    def lens(self) -> CameraLens:
        """The lens."""
        return draw_lens(self.seed) if self.grid is None else traced(self.grid)

    @property
    def family(self) -> Family:
        """Which family it is of."""
        return "third order" if self.grid is None else "ray-traced"

    @property
    def unseen(self) -> bool:
        """Whether nothing was developed, chosen or trained on it."""
        if self.grid is None:
            return self.seed >= FIRST_SEED and self.seed not in SEEDS_LOOKED_AT
        return design(self.grid) not in LOOKED_AT

    @property
    def source(self) -> str:
        """Where the lens comes from."""
        return (
            f"drawn, seed {self.seed}" if self.grid is None else str(traced(self.grid).grid.facts["source"])
        )

    @property
    def name(self) -> str:
        """Short and unique within a run."""
        which = str(self.seed) if self.grid is None else design(self.grid)
        return f"{which}-{self.focal_mm:.3g}mm-f{self.aperture:.2g}"

    @property
    def title(self) -> str:
        """For people."""
        model = self.lens.model.removeprefix("Simulated ")
        return f"{model} at {self.focal_mm:.3g} mm f/{self.aperture:.2g}"

    @property
    def settings(self) -> LensSettings:
        """Settings of all photos."""
        return LensSettings(aperture=self.aperture, focal_mm=self.focal_mm)

    @property
    def camera(self) -> SimulatedCamera:
        """The sensor at base ISO."""
        sensor = SimulatedCamera(
            height=self.height, width=self.width, full_well_electrons=50_000.0, read_noise=50.0
        )
        return sensor if self.grid is None else replace(sensor, pitch_um=traced(self.grid).field().pitch_um)

    def truth(self) -> PsfField:
        """Return the true PSF field."""
        if self.grid is not None:
            return traced(self.grid).field(self.settings)
        return SimulatedField(draw_lens(self.seed), self.settings, self.camera.pitch_um)


@dataclass(frozen=True, slots=True)
class Reproduction:
    """What to run."""

    cases: tuple[Case, ...]
    # folder of sharp photographs, of which the test half is used; None means the library's five
    scenes: Path | None = None
    size: Size = "default"  # how it was planned, for the page
    # whether all that a lens is compared with is run too: the paper's own way from end to end, a general
    # profile, a printed target, a blind rival, Figs. 2 and 4
    compare: bool = False

    def files(self) -> tuple[Path, ...]:
        """Return the photographs."""
        return scene_files(self.scenes)


def fingerprint() -> str:
    """Hash of the code and data that figures depend on; pages leave stored results as they are."""
    return version_of("lab.reproduce.job")


def photos_of(case: Case, plan: Reproduction) -> str:
    """Name of the folder of a case's photos: of the lens, the frames, and what takes them."""
    parts = (_lens_of(case), case.layout, content_of(plan.files()), version_of("lab.reproduce.shots"))
    return f"{case.name}-{hashlib.sha256(repr(parts).encode()).hexdigest()[:12]}"


def key_of(case: Case, plan: Reproduction, code: str) -> str:
    """Name under which the results of a case are stored: of all that they depend on."""
    parts = (PROTOCOL, code, _lens_of(case), case.layout, content_of(plan.files()))
    return f"{case.name}-{hashlib.sha256(repr(parts).encode()).hexdigest()[:12]}"


def _lens_of(case: Case) -> tuple[object, ...]:
    lens = None
    if case.grid is not None:  # the file, and the code that answers between its nodes
        lens = hashlib.sha256(case.grid.read_bytes() + Path(stored.__file__).read_bytes()).hexdigest()
    return (case.seed, case.focal_mm, case.aperture, case.height, case.width, lens)


def planned(
    size: Size, *, scenes: Path | None = None, lenses: Sequence[str] = (), compare: bool = False
) -> Reproduction:
    """Plan a run."""
    files = scene_files(scenes)
    chosen: Sequence[int | Path] = [_lens(text) for text in lenses]
    if not chosen:
        seeds = (SEEDS[0], SEEDS[4]) if size == "quick" else SEEDS
        chosen = [*seeds, *repository_grids()]
    frame = _QUICK_FRAME if size == "quick" else None
    layout = layout_for(files, frame)
    cases = tuple(_case(one, _PHOTOS[size], frame or layout.frame, layout) for one in chosen)
    if len({case.name for case in cases}) < len(cases):
        raise InvalidInputError("two lenses are of one design and aperture; give one of each")
    return Reproduction(cases, scenes, size, compare)


def _lens(text: str) -> int | Path:
    if text.isdigit():
        return int(text)
    if not Path(text).is_file():
        raise InvalidInputError(f"{text!r} is neither the seed of a lens nor a file of a ray-traced one")
    return Path(text)


def _case(which: int | Path, photos: tuple[int, ...], frame: tuple[int, int], layout: Layout) -> Case:
    if isinstance(which, int):
        lens = draw_lens(which)
        mm = lens.focal_mm[0]
        return Case(which, mm, lens.at_focal(mm).f_number, photos, *frame, layout)
    # a number of the design's name takes the place of a seed, whatever else is run
    number = _TRACED_FROM + int(hashlib.sha256(design(which).encode()).hexdigest(), 16) % _TRACED
    return Case(number, traced(which).focal_mm[0], traced(which).widest(), photos, *frame, layout, which)


# --- frames composed of sharp photographs -------------------------------------------------------
# The photographs of the held-out photo serve in no other. Where there are few of them, those that the lens is
# learned from serve again, mirrored and in another place of the frame.


def scene_files(folder: Path | None) -> tuple[Path, ...]:
    """Photographs of the test half of a folder; all five of the library when there is no folder."""
    found = list_photos(folder)
    if folder is None:
        return found
    tested = tuple(path for path in found if photo_half(path.stem) == "test")
    if not tested:
        raise InvalidInputError(f"{folder} holds no photograph of the test half; add some")
    return tested


def layout_for(files: Sequence[Path], wanted: tuple[int, int] | None = None) -> Layout:
    """Decide how to make frames that cover `wanted` rows and columns; the largest where it is None."""
    grids = [(rows, cols) for rows, cols in _GRIDS if 2 * rows * cols <= len(files)]
    if not grids:
        raise InvalidInputError(f"two photographs are needed at least, there are {len(files)}")
    layouts = [_layout(files, grid) for grid in grids]
    for layout in layouts if wanted else layouts[-1:]:
        rows, cols = wanted or (0, 0)
        if layout.rows * layout.tile[0] >= rows and layout.cols * layout.tile[1] >= cols:
            return layout
    raise InvalidInputError(f"the photographs do not cover frames of {wanted}: give larger ones, or more")


def _layout(files: Sequence[Path], grid: tuple[int, int]) -> Layout:
    sizes = np.array([_turned_size(path, upright=grid[1] > grid[0]) for path in files])
    height, width = (int(n) // 2 * 2 for n in sizes.min(axis=0))
    return Layout(*grid, (height, width))


def frame_scene(files: Sequence[Path], layout: Layout, number: int | None) -> Planes:
    """Compose a frame from photographs in the given order."""
    per = layout.rows * layout.cols
    if number is None:
        parts = [_part(path, layout, 0) for path in files[:per]]
    else:
        others = files[per:]
        indices = range(number * per, (number + 1) * per)
        parts = [_part(others[i % len(others)], layout, i // len(others)) for i in indices]
    rows = [parts[i * layout.cols : (i + 1) * layout.cols] for i in range(layout.rows)]
    return np.ascontiguousarray(np.concatenate([np.concatenate(row, axis=2) for row in rows], axis=1))


def centred_cut(scene: Planes, height: int, width: int) -> Planes:
    """Cut the middle so that the scene exceeds `height` x `width` by twice the margin, or by less, evenly."""
    cut = []
    for have, want in zip(scene.shape[1:], (height, width), strict=True):
        if have < want:
            raise InvalidInputError(f"a scene of {scene.shape[1:]} does not cover {height} x {width}")
        spare = min((have - want) // 2, MARGIN)
        start = (have - want - 2 * spare) // 2
        cut.append(slice(start, start + want + 2 * spare))
    return np.ascontiguousarray(scene[:, cut[0], cut[1]])


def content_of(files: Sequence[Path]) -> str:
    """Hash of the photographs' bytes, in order."""
    total = hashlib.sha256()
    for path in files:
        total.update(hashlib.sha256(path.read_bytes()).digest())
    return total.hexdigest()[:16]


def _part(path: Path, layout: Layout, use: int) -> Planes:
    """The middle of a photograph; mirrored in another way each time that it is used."""
    scene = load_scene(path)
    if (scene.shape[1] > scene.shape[2]) != (layout.tile[0] > layout.tile[1]):
        scene = np.rot90(scene, axes=(1, 2))
    height, width = layout.tile
    top, left = (scene.shape[1] - height) // 2, (scene.shape[2] - width) // 2
    return scene[:, top : top + height, left : left + width][
        :, :: -1 if use & 2 else 1, :: -1 if use & 1 else 1
    ]


def _turned_size(path: Path, *, upright: bool) -> tuple[int, int]:
    with Image.open(path) as image:
        short, long = sorted(image.size)
    return (long, short) if upright else (short, long)
