"""What a reproduction runs: which lenses, behind which frames, learned from how many photos; and these."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, TypeAlias

import numpy as np
from PIL import Image

import lensmodel
from lab import traced
from lab.cases import list_photos, photo_half
from lab.images import middle
from lab.population.prescriptions import LOOKED_AT
from lab.stored import version_of
from lab.traced import GridLens, known_lens, wide_open
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import atomic, save_array
from lensmodel.core.psf import PsfField
from lensmodel.core.types import LensSettings, Planes
from lensmodel.photo import develop, write_image
from lensmodel.simulate import SimulatedCamera, SimulatedLens, edge_chart, load_scene, photograph, write_photo

Size: TypeAlias = Literal["quick", "default"]

PROTOCOL: Final = 8  # part of every key of a stored result; raised when what is measured changes

# Names of what becomes of the photos of a lens, beside what was learned by default, see `learned`.
BEFORE: Final = "without correction"
RIVAL: Final = "Schuler et al. 2012, n = 1"
GENERAL: Final = "general profile of the lens model"
PAPER_WAY: Final = "the paper's own way"
MEASURED: Final = "measured with a target"
TRUE: Final = "true PSF"

FIRST_SEED: Final = 1000  # seeds of third-order lenses below are for development
SEEDS: Final = (1008, *range(1001, 1008))  # one of each kind; 1008 for 1000, so that half are unseen
SOFT_SEED: Final = 1008
SEEDS_LOOKED_AT: Final = frozenset({1000, 1001, 1002, 1003, 1006})  # during development

# Seeds of ray-traced lenses (chosen): above those of drawn ones, so many that designs hardly share one.
_TRACED_FROM: Final = 2000
_TRACED: Final = 100_000

_QUICK_FRAME: Final = (640, 960)  # rows and columns (chosen): 0.6 megapixels
_PHOTOS: Final = {"quick": (1, 2), "default": (1, 2, 5, 10)}

BASE_ISO: Final = SimulatedCamera(full_well_electrons=50_000.0, read_noise=50.0)
MARGIN: Final = 28  # pixels that a scene reaches beyond the frame on every side: half a kernel
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


@dataclass(frozen=True, slots=True)
class Case:
    """One lens wide open, and the numbers of photos it is learned from."""

    # of `draw_lens`, or the number of a ray-traced lens; it also mixes the order of the photographs
    seed: int
    photos: tuple[int, ...]  # ascending: the model is measured after each of these numbers of photos
    height: int  # of the camera, pixels
    width: int
    layout: Layout  # how frames are made of photographs
    grid: Path | None = None  # PSFs of a ray-traced lens; None means a lens of third order

    @property
    def lens(self) -> SimulatedLens | GridLens:
        """The lens."""
        return known_lens(self.seed, self.grid)

    @property
    def settings(self) -> LensSettings:
        """Settings of all photos."""
        return wide_open(self.lens)

    @property
    def family(self) -> Literal["third order", "ray-traced"]:
        """Which family it is of."""
        return "third order" if self.grid is None else "ray-traced"

    @property
    def unseen(self) -> bool:
        """Whether nothing was developed, chosen or trained on it."""
        if isinstance(self.lens, GridLens):
            return self.lens.design not in LOOKED_AT
        return self.seed >= FIRST_SEED and self.seed not in SEEDS_LOOKED_AT

    @property
    def source(self) -> str:
        """Where the lens comes from."""
        if isinstance(self.lens, GridLens):
            return str(self.lens.grid.facts["source"])
        return f"drawn, seed {self.seed}"

    @property
    def name(self) -> str:
        """Short and unique within a run."""
        which = self.lens.design if isinstance(self.lens, GridLens) else self.seed
        return f"{which}-{self.settings.focal_mm:.3g}mm-f{self.settings.aperture:.2g}"

    @property
    def title(self) -> str:
        """For people."""
        model = str(self.lens.identity.model).removeprefix("Simulated ")
        return f"{model} at {self.settings.focal_mm:.3g} mm f/{self.settings.aperture:.2g}"

    @property
    def camera(self) -> SimulatedCamera:
        """The sensor at base ISO."""
        sensor = replace(BASE_ISO, height=self.height, width=self.width)
        return (
            replace(sensor, pitch_um=self.lens.grid.pitch_um) if isinstance(self.lens, GridLens) else sensor
        )

    def truth(self) -> PsfField:
        """Return the true PSF field."""
        return self.lens.field(self.settings)

    def parts(self) -> tuple[object, ...]:
        """All that its photos depend on, beside the photographs and the code that takes them."""
        grid = None
        if self.grid is not None:  # the file, and the code that answers between its nodes
            grid = hashlib.sha256(self.grid.read_bytes() + Path(traced.__file__).read_bytes()).hexdigest()
        return (self.seed, self.settings, self.height, self.width, grid, self.layout)


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


def photos_of(case: Case, plan: Reproduction) -> str:
    """Name of the folder of a case's photos: of the lens, the frames, and what takes them."""
    return _name(case, case.parts(), content_of(plan.files()), version_of(__name__))


def key_of(case: Case, plan: Reproduction, code: str) -> str:
    """Name under which the results of a case are stored: of all that they depend on."""
    return _name(case, PROTOCOL, code, case.parts(), content_of(plan.files()))


def _name(case: Case, *parts: object) -> str:
    return f"{case.name}-{hashlib.sha256(repr(parts).encode()).hexdigest()[:12]}"


def planned(
    size: Size, *, scenes: Path | None = None, lenses: Sequence[str] = (), compare: bool = False
) -> Reproduction:
    """Plan a run."""
    files = scene_files(scenes)
    seeds = (SEEDS[0], SEEDS[4]) if size == "quick" else SEEDS
    frame = _QUICK_FRAME if size == "quick" else None
    layout = layout_for(files, frame)
    cases = tuple(
        Case(seed, _PHOTOS[size], *(frame or layout.frame), layout, grid)
        for seed, grid in map(_lens, lenses or [*map(str, seeds), *map(str, repository_grids())])
    )
    if len({case.name for case in cases}) < len(cases):
        raise InvalidInputError("two lenses are of one design and aperture; give one of each")
    return Reproduction(cases, scenes, size, compare)


def _lens(text: str) -> tuple[int, Path | None]:
    if text.isdigit():
        return int(text), None
    if not Path(text).is_file():
        raise InvalidInputError(f"{text!r} is neither the seed of a lens nor a file of a ray-traced one")
    # a number of the design's name takes the place of a seed, whatever else is run
    design = GridLens.read(text).design
    return _TRACED_FROM + int(hashlib.sha256(design.encode()).hexdigest(), 16) % _TRACED, Path(text)


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
    layouts = [_layout(files, *grid) for grid in _GRIDS if 2 * grid[0] * grid[1] <= len(files)]
    if not layouts:
        raise InvalidInputError(f"two photographs are needed at least, there are {len(files)}")
    rows, cols = wanted or (0, 0)
    for layout in layouts if wanted else layouts[-1:]:
        if layout.rows * layout.tile[0] >= rows and layout.cols * layout.tile[1] >= cols:
            return layout
    raise InvalidInputError(f"the photographs do not cover frames of {wanted}: give larger ones, or more")


def _layout(files: Sequence[Path], rows: int, cols: int) -> Layout:
    sizes = []
    for path in files:
        with Image.open(path) as image:
            sizes.append(sorted(image.size, reverse=cols > rows))
    height, width = (int(n) // 2 * 2 for n in np.min(sizes, axis=0))
    return Layout(rows, cols, (height, width))


def frame_scene(files: Sequence[Path], layout: Layout, number: int | None) -> Planes:
    """Compose a frame from photographs in the given order; None means the held-out one."""
    per = layout.rows * layout.cols
    others = files[per:]
    indices = range((number or 0) * per, ((number or 0) + 1) * per)
    if number is None:
        parts = [_part(path, layout, 0) for path in files[:per]]
    else:
        parts = [_part(others[i % len(others)], layout, i // len(others)) for i in indices]
    rows = [parts[i * layout.cols : (i + 1) * layout.cols] for i in range(layout.rows)]
    return np.ascontiguousarray(np.concatenate([np.concatenate(row, axis=2) for row in rows], axis=1))


def centred_cut(scene: Planes, height: int, width: int) -> Planes:
    """Cut the middle so that the scene exceeds `height` x `width` by twice the margin, or by less, evenly."""
    if scene.shape[1] < height or scene.shape[2] < width:
        raise InvalidInputError(f"a scene of {scene.shape[1:]} does not cover {height} x {width}")
    sides = zip(scene.shape[1:], (height, width), strict=True)
    return middle(scene, *(want + 2 * min((have - want) // 2, MARGIN) for have, want in sides))


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
    return middle(scene, *layout.tile)[:, :: -1 if use & 2 else 1, :: -1 if use & 1 else 1]


Container: TypeAlias = Literal["dng", "tiff", "jpeg"]

JPEG_QUALITY: Final = 92  # of 100 (chosen): that of a fine JPEG of a camera

SUFFIXES: Final[dict[Container, str]] = {"dng": ".dng", "tiff": ".tif", "jpeg": ".jpg"}


@dataclass(frozen=True, slots=True)
class Shots:
    """Files of the photos of one case."""

    learn: tuple[Path, ...]  # in the order in which the lens learns from them
    held_out: Path  # never used for calibration
    chart: Path
    sharp: Path  # npy, the light that a perfect lens would have put on the sensor for `held_out`

    @classmethod
    def of(cls, case: Case, folder: Path) -> Shots:
        """Name the files of a case in a folder."""
        return cls(
            tuple(folder / f"photo-{i:02d}.dng" for i in range(case.photos[-1])),
            folder / "held-out.dng",
            folder / "chart.dng",
            folder / "held-out-sharp.npy",
        )

    def truth(self) -> Planes:
        """Load the truth behind `held_out`: camera colours, not white-balanced."""
        planes: Planes = np.load(self.sharp, allow_pickle=False)
        return planes


def take(case: Case, files: Sequence[Path], folder: Path, *, photos: int | None = None) -> Shots:
    """Take the photos of a case that are not there yet; the first `photos` alone if that is given."""
    folder.mkdir(parents=True, exist_ok=True)
    shots, camera = Shots.of(case, folder), case.camera
    order = np.random.default_rng(case.seed).permutation(len(files))
    mixed = [files[i] for i in order]
    wanted: list[tuple[Path, int | None]] = [(path, i) for i, path in enumerate(shots.learn[:photos])]
    wanted += [] if photos else [(shots.held_out, None), (shots.chart, None)]
    for path, number in wanted:
        if path.exists():
            continue
        if path == shots.chart:
            scene = edge_chart(camera.frame, guard=guard_of(case)).scene
        else:
            scene = centred_cut(frame_scene(mixed, case.layout, number), case.height, case.width)
        seed = [case.seed, len(SUFFIXES) if path == shots.chart else 0 if number is None else number + 10]
        photo = photograph(scene, case.lens, case.settings, camera, np.random.default_rng(seed))
        if path == shots.held_out:
            with atomic(shots.sharp) as file:
                save_array(file, photo.sharp)
        write_photo(path, photo)  # last, and whole or not at all: a photo that is there is complete
    return shots


def in_container(path: Path, container: Container) -> Path:
    """Return a photo as another kind of file, developed by the library in sRGB; made where it is missing."""
    made = path.with_suffix(SUFFIXES[container])
    if not made.exists():
        developed = develop(path)
        kind: Literal["jpeg", "tiff16"] = "jpeg" if container == "jpeg" else "tiff16"
        write_image(
            made, developed.planes, developed.encoding, format=kind, color_space="srgb", quality=JPEG_QUALITY
        )
    return made


def guard_of(case: Case) -> int:
    """Pixels between an edge and the border of its tile of the chart: half a kernel if it fits."""
    tile = min(case.height // 6, case.width // 8)
    return min(27, (tile - 32) // 2)
