"""What a reproduction runs: which lenses and apertures, behind which scenes, learned from how many photos."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Final, Literal, TypeAlias, TypeVar

import numpy as np

import lensmodel
from lab.code_version import version_of
from lab.reproduce import programs
from lab.reproduce.frames import Layout, content_of, layout_for, scene_files
from lab.traced import GridLens, grid
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfField
from lensmodel.core.types import LensSettings
from lensmodel.simulate import CameraLens, SimulatedCamera, SimulatedField, draw_lens

Size: TypeAlias = Literal["quick", "small", "default", "full"]
Family: TypeAlias = Literal["third order", "ray-traced"]
Container: TypeAlias = Literal["dng", "tiff", "jpeg"]
T = TypeVar("T")

FAMILIES: Final[tuple[Family, ...]] = ("third order", "ray-traced")

PROTOCOL: Final = 6
"""Part of every key of a stored result; raised when what is measured changes."""

METHODS: Final = ("paper", "standard")
"""Non-blind methods; here `paper` is the deconvolution alone, Richardson-Lucy, with our own PSFs."""

HARD_METHODS: Final = ("standard",)
"""Of the correction of scenes and paths that hurt: what a user gets who chooses nothing."""

RIVALS: Final = ("schuler", "kee")

FIRST_SEED: Final = 1000
"""Seeds of third-order lenses below are for development, and parameters are chosen on them."""

SEEDS: Final = (1008, *range(1001, 1008))
"""Of third-order lenses that are run, one of each kind; 1008 is the soft, fast one instead of 1000, so that
half of them are unseen."""

SEEDS_LOOKED_AT: Final = frozenset({1000, 1001, 1002, 1003, 1006})
"""Of those beyond: results of these were looked into during development."""

DESIGNS_LOOKED_AT: Final = frozenset({"heliar", "reverse-telephoto", "tronnier", "retrofocus"})
"""Designs of ray-traced lenses that were looked at during development."""

# Seeds of ray-traced lenses (chosen): above those of drawn ones, so many that designs hardly share one.
_TRACED_FROM: Final = 2000
_TRACED: Final = 100_000

_QUICK_FRAME: Final = (640, 960)  # rows and columns (chosen): 0.6 megapixels
_HARD_FRAME: Final = (840, 1260)  # rows and columns (chosen): a megapixel
_STOPPED_DOWN: Final = 2.0  # two stops
_DRAWN_EACH: Final = {"default": 2, "full": 4}
_TRACED_EACH: Final = {"default": 2, "full": 2}
"""Lenses of a family behind each other kind of file, by size of the run (chosen: a night)."""


@dataclass(frozen=True, slots=True)
class Condition:
    """What is different from a photo of a photograph, in raw, at base ISO."""

    title: str  # for people
    full_well_electrons: float = 50_000.0  # of the sensor at the photo's ISO, electrons
    read_noise: float = 50.0
    # the file; TIFF (16 bits) and JPEG (quality 92) are the developed DNG in sRGB
    container: Container = "dng"
    scene: str = ""  # name in `lab.scenes.HARD_SCENES` of what is drawn over the photograph, or empty

    @property
    def with_chart(self) -> bool:
        """Whether the chart is photographed and corrected too."""
        return not self.scene

    @property
    def suffix(self) -> str:
        """Of its files."""
        return {"dng": ".dng", "tiff": ".tif", "jpeg": ".jpg"}[self.container]


BASE: Final = "base"
CONDITIONS: Final[Mapping[str, Condition]] = {
    BASE: Condition("raw at base ISO (50,000 electrons, read noise 0.001)"),
    "high-iso": Condition("high ISO (2,500 electrons, read noise 0.003)", 2500.0, 7.5),
    "tiff": Condition("16-bit TIFF in sRGB", container="tiff"),
    "jpeg": Condition("JPEG only, quality 92", container="jpeg"),
    "depth": Condition("depth: near things out of focus", scene="depth"),
    "motion": Condition("motion: things that moved", scene="motion"),
    "night": Condition("night: lamps that clip", scene="night"),
    "sky": Condition("sky: little detail", scene="sky"),
    "snow": Condition("snow: bright and flat", scene="snow"),
    "text": Condition("text", scene="text"),
    "foliage": Condition("foliage", scene="foliage"),
}
"""By name; `base` is what tables are made of."""

PATHS: Final = ("high-iso", "tiff", "jpeg")
SCENES_THAT_HURT: Final = tuple(name for name, condition in CONDITIONS.items() if condition.scene)


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
    return str(traced(path).grids[0].facts["design"])


@dataclass(frozen=True, slots=True)
class Case:
    """One lens at one setting, and the numbers of photos it is learned from."""

    # of `draw_lens`, or the number of a ray-traced lens; it also mixes the order of the photographs
    seed: int
    focal_mm: float  # how the lens is set
    aperture: float
    photos: tuple[int, ...]  # ascending: the model is measured after each of these numbers of photos
    height: int  # of the camera, pixels
    width: int
    layout: Layout  # how frames are made of photographs
    # name of a `Condition`: what is photographed, at which ISO, into which kind of file
    condition: str = BASE
    grid: Path | None = None  # PSFs of a ray-traced lens; None means a lens of third order

    def __post_init__(self) -> None:
        if not self.photos or self.photos[0] < 1 or list(self.photos) != sorted(set(self.photos)):
            raise InvalidInputError(f"numbers of photos must ascend from 1 or more, got {self.photos}")
        if self.condition not in CONDITIONS:
            raise InvalidInputError(f"no condition {self.condition!r}; known: {', '.join(CONDITIONS)}")

    @property
    def conditions(self) -> Condition:
        """What is different from a raw photo of a photograph at base ISO."""
        return CONDITIONS[self.condition]

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
        """Whether nothing was developed or chosen on it."""
        if self.grid is None:
            return self.seed >= FIRST_SEED and self.seed not in SEEDS_LOOKED_AT
        return design(self.grid) not in DESIGNS_LOOKED_AT

    @property
    def source(self) -> str:
        """Where the lens comes from."""
        return (
            f"drawn, seed {self.seed}"
            if self.grid is None
            else str(traced(self.grid).grids[0].facts["source"])
        )

    @property
    def name(self) -> str:
        """Short and unique within a run."""
        which = str(self.seed) if self.grid is None else design(self.grid)
        name = f"{which}-{self.focal_mm:g}mm-f{self.aperture:g}-n{self.photos[-1]}"
        return name if self.condition == BASE else f"{name}-{self.condition}"

    @property
    def title(self) -> str:
        """For people."""
        model = self.lens.model.removeprefix("Simulated ")
        return f"{model} at {self.focal_mm:g} mm f/{self.aperture:g}"

    @property
    def stops(self) -> float:
        """How many stops it is closed from wide open."""
        return 2.0 * math.log2(self.aperture / self.lens.widest(self.focal_mm))

    @property
    def is_whole(self) -> bool:
        """Whether it is that of a lens from its first photo on, which is compared with most: one for each."""
        return self.condition == BASE and self.photos[0] <= 2

    @property
    def settings(self) -> LensSettings:
        """Settings of all photos."""
        return LensSettings(aperture=self.aperture, focal_mm=self.focal_mm)

    @property
    def camera(self) -> SimulatedCamera:
        """The sensor at the ISO of the photos."""
        sensor = SimulatedCamera(
            height=self.height,
            width=self.width,
            full_well_electrons=self.conditions.full_well_electrons,
            read_noise=self.conditions.read_noise,
        )
        if self.grid is None:
            return sensor
        return replace(sensor, pitch_um=traced(self.grid).field().pitch_um)

    def truth(self) -> PsfField:
        """Return the true PSF field."""
        if self.grid is not None:
            return traced(self.grid).field(self.settings)
        return SimulatedField(draw_lens(self.seed), self.settings, self.camera.pitch_um)

    def order(self, parts: int) -> list[int]:
        """Return in which order the photographs are used; another one for each lens."""
        return [int(i) for i in np.random.default_rng(self.seed).permutation(parts)]


@dataclass(frozen=True, slots=True)
class Reproduction:
    """What to run."""

    cases: tuple[Case, ...]
    # folder of sharp photographs, of which the test half is used; None means the library's five
    scenes: Path | None = None
    estimator: str = "default"  # blind estimator of the calibration
    methods: tuple[str, ...] = METHODS  # non-blind methods of the correction
    rivals: tuple[str, ...] = RIVALS  # blind methods of others, names in `lab.rivals`; each sees one photo
    programs: tuple[str, ...] = ()  # programs of others that correct the same photos, names in `lab.peers`
    size: Size = "default"  # how it was planned, for the page
    paper: bool = True  # whether each lens is learned and corrected the paper's own way from end to end too
    # whether a general profile of the lens model is compared with, see `fields.general_field`
    general: bool = True
    target: bool = True  # whether each lens is measured with a printed target too

    def files(self) -> tuple[Path, ...]:
        """Return the photographs."""
        return scene_files(self.scenes)


def fingerprint() -> str:
    """Hash of the code and data that figures depend on: all that is behind the work on one case.

    Rivals and programs have hashes of their own; plans and pages leave stored results as they are.
    """
    apart = ("lab.rivals", "lab.reproduce.programs", "lab.peers", "lensmodel.report")
    return version_of("lab.reproduce.job", without=apart)


def key_of(case: Case, plan: Reproduction, code: str) -> str:
    """Name under which the results of a case are stored: of all that they depend on.

    The numbers of photos are no part of it, so that a later run with more of them finds what is
    there; the largest is, because it decides how many frames there are.
    """
    lens = None
    if case.grid is not None:  # the file, and the code that answers between its nodes
        lens = hashlib.sha256(case.grid.read_bytes() + Path(grid.__file__).read_bytes()).hexdigest()
    parts = (
        PROTOCOL,
        code,
        (case.seed, case.focal_mm, case.aperture, case.height, case.width, case.photos[-1]),
        lens,
        case.condition,
        case.layout,
        plan.estimator,
        plan.methods,
        content_of(plan.files()),
    )
    return f"{case.name}-{hashlib.sha256(repr(parts).encode()).hexdigest()[:12]}"


def planned(
    size: Size,
    *,
    scenes: Path | None = None,
    grids: Sequence[Path] | None = None,
    only: Sequence[str] = (),
    default_only: bool = False,
) -> Reproduction:
    """Plan a run of one of four sizes.

    Notes
    -----
    With few photographs the largest n shrinks to what they allow without using one twice.
    """
    files = scene_files(scenes)
    paths = tuple(repository_grids() if grids is None else grids)
    if size == "quick":
        cases = tuple(_case(seed, (1, 2), files, _QUICK_FRAME) for seed in (SEEDS[0], SEEDS[4]))
        cases += tuple(_traced(path, (1, 2), files, _QUICK_FRAME) for path in paths)
    else:
        few, frame = _allowed((1, 2, 5), len(files)), _HARD_FRAME if size == "small" else None
        cases = tuple(_case(seed, few, files, frame) for seed in SEEDS)
        cases += tuple(_traced(path, few, files, frame) for path in paths)
    if size == "full":
        zooms = [seed for seed in SEEDS if len(draw_lens(seed).focal_mm) > 1]
        cases += tuple(_case(seed, few, files, focal=-1) for seed in zooms)
        cases += tuple(_case(seed, few, files, stopped=_STOPPED_DOWN) for seed in SEEDS)
        many = _allowed((10, 20), 2 * len(files))
        cases += tuple(_case(seed, many, files) for seed in SEEDS if many != few)
    names: tuple[str, ...] = PATHS if size in {"default", "full"} else ()
    names += SCENES_THAT_HURT if size == "full" else ()
    for number, name in enumerate(names):
        cases += tuple(
            replace(_case(seed, (1,), files, _HARD_FRAME), condition=name)
            for seed in in_turn(SEEDS, number, _DRAWN_EACH[size])
        )
        if name in PATHS:
            cases += tuple(
                replace(_traced(path, (1,), files, _HARD_FRAME), condition=name)
                for path in in_turn(paths, number, _TRACED_EACH[size])
            )
    return Reproduction(
        _chosen(cases, only),
        scenes,
        methods=HARD_METHODS if default_only else METHODS,
        rivals=RIVALS if size in {"default", "full"} and not default_only else (),
        programs=() if default_only else programs.installed(),
        size=size,
        paper=size != "quick" and not default_only,
        general=not default_only,
        target=not default_only,
    )


def in_turn(lenses: Sequence[T], number: int, count: int) -> list[T]:
    """Lenses of a condition: other ones for each, in turn, as unlike each other as they come."""
    each = min(count, len(lenses))
    return [lenses[(number + len(lenses) * i // each) % len(lenses)] for i in range(each)]


def _chosen(cases: Sequence[Case], only: Sequence[str]) -> tuple[Case, ...]:
    names = [case.name for case in cases]
    if len(set(names)) < len(names):
        raise InvalidInputError("two grids are of one design and aperture; give one of each")
    unknown = [text for text in only if not any(name.startswith(text) for name in names)]
    if unknown:
        raise InvalidInputError(f"no lens's name begins with {unknown[0]!r}; they are {', '.join(names)}")
    return tuple(case for case in cases if not only or case.name.startswith(tuple(only)))


def _allowed(wanted: tuple[int, ...], parts: int) -> tuple[int, ...]:
    """Numbers of photos that leave one frame over for the measurement."""
    most = parts - 1
    return tuple(sorted({min(n, most) for n in wanted}))


def _case(
    seed: int,
    photos: tuple[int, ...],
    files: Sequence[Path],
    frame: tuple[int, int] | None = None,
    *,
    focal: int = 0,
    stopped: float = 1.0,
) -> Case:
    lens = draw_lens(seed)
    layout = layout_for(files, photos[-1] + 1, frame)
    height, width = frame or layout.frame
    mm = lens.focal_mm[focal]
    return Case(seed, mm, lens.at_focal(mm).f_number * stopped, photos, height, width, layout)


def _traced(
    path: Path, photos: tuple[int, ...], files: Sequence[Path], frame: tuple[int, int] | None = None
) -> Case:
    lens = traced(path)
    # a number of the design's name takes the place of a seed, whatever else is run
    number = _TRACED_FROM + int(hashlib.sha256(design(path).encode()).hexdigest(), 16) % _TRACED
    layout = layout_for(files, photos[-1] + 1, frame)
    height, width = frame or layout.frame
    return Case(
        number,
        lens.focal_mm[0],
        lens.widest(),
        photos,
        height,
        width,
        layout,
        grid=path,
    )
