"""Which lenses at which apertures, learned from how many photos."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, TypeAlias

import numpy as np

import lensmodel
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfField
from lensmodel.core.types import LensSettings
from lensmodel.lab.reproduce import families, programs
from lensmodel.lab.reproduce.conditions import BASE, PATHS, SCENES_THAT_HURT, Condition, condition
from lensmodel.lab.reproduce.families import FIRST_SEED, Family
from lensmodel.lab.reproduce.scenes import Layout, content_of, layout_for, scene_files
from lensmodel.simulate import CameraLens, SimulatedCamera, SimulatedField, draw_lens

Size: TypeAlias = Literal["quick", "default", "full"]

PROTOCOL: Final = 4
"""Part of every key of a stored result; raised when what is measured changes."""

METHODS: Final = ("paper", "standard")
"""Non-blind methods; here `paper` is the deconvolution alone, Richardson-Lucy, with our own PSFs."""

HARD_METHODS: Final = ("standard",)
"""Of the correction of scenes and paths that hurt: what a user gets who chooses nothing."""

RIVALS: Final = ("schuler", "kee")

_PARTS: Final = (
    "core",
    "photo",
    "optics",
    "estimation",
    "model",
    "correction",
    "quality",
    "simulate",
    "workflow",
)
_MEASURING: Final = (
    "conditions",
    "fidelity",
    "general",
    "job",
    "measure",
    "measured",
    "routes",
    "scenes",
    "shots",
)
_NO_PART: Final = ("api", "checking", "joining")
"""Modules that no route from a photo to a corrected one goes through."""

_QUICK_FRAME = (640, 960)
_HARD_FRAME = (840, 1260)
_STOPPED_DOWN = 2.0  # two stops


@dataclass(frozen=True, slots=True)
class Case:
    """One lens at one setting, and the numbers of photos it is learned from.

    Parameters
    ----------
    seed : int
        Of `draw_lens`, or the number of a ray-traced lens; it also mixes the order of the photographs.
    focal_mm, aperture : float
        How the lens is set.
    photos : tuple of int
        Ascending: the model is measured after each of these numbers of photos.
    height, width : int
        Of the camera, pixels.
    layout : Layout
        How frames are made of photographs.
    condition : str
        Name of a `Condition`: what is photographed, at which ISO, into which kind of file.
    grid : Path or None
        PSFs of a ray-traced lens; None means a lens of third order.
    """

    seed: int
    focal_mm: float
    aperture: float
    photos: tuple[int, ...]
    height: int
    width: int
    layout: Layout
    condition: str = BASE
    grid: Path | None = None

    def __post_init__(self) -> None:
        if not self.photos or self.photos[0] < 1 or list(self.photos) != sorted(set(self.photos)):
            raise InvalidInputError(f"numbers of photos must ascend from 1 or more, got {self.photos}")
        condition(self.condition)

    @property
    def conditions(self) -> Condition:
        """What is different from a raw photo of a photograph at base ISO."""
        return condition(self.condition)

    @property
    def lens(self) -> CameraLens:
        """The lens."""
        return draw_lens(self.seed) if self.grid is None else families.traced(self.grid)

    @property
    def family(self) -> Family:
        """Which family it is of."""
        return "third order" if self.grid is None else "ray-traced"

    @property
    def unseen(self) -> bool:
        """Whether nothing was developed or chosen on it."""
        if self.grid is None:
            return self.seed >= FIRST_SEED
        return families.design(self.grid) not in families.LOOKED_AT

    @property
    def source(self) -> str:
        """Where the lens comes from."""
        return f"drawn, seed {self.seed}" if self.grid is None else families.source(self.grid)

    @property
    def name(self) -> str:
        """Short and unique within a run."""
        which = str(self.seed) if self.grid is None else families.design(self.grid)
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
        return replace(sensor, pitch_um=families.traced(self.grid).field().pitch_um)

    def truth(self) -> PsfField:
        """Return the true PSF field."""
        if self.grid is not None:
            return families.traced(self.grid).field(self.settings)
        return SimulatedField(draw_lens(self.seed), self.settings, self.camera.pitch_um)

    def order(self, parts: int) -> list[int]:
        """Return in which order the photographs are used; another one for each lens."""
        return [int(i) for i in np.random.default_rng(self.seed).permutation(parts)]


@dataclass(frozen=True, slots=True)
class Reproduction:
    """What to run.

    Parameters
    ----------
    cases : tuple of Case
    scenes : Path or None
        Folder of sharp photographs, of which the test half is used; None means the library's five.
    estimator : str
        Blind estimator of the calibration.
    methods : tuple of str
        Non-blind methods of the correction.
    rivals : tuple of str
        Blind methods of others, names in `lensmodel.lab.rivals`; each sees one photo.
    programs : tuple of str
        Programs of others that correct the same photos, names in `lensmodel.lab.peers`.
    size : {"quick", "default", "full"}
        How it was planned, for the page.
    paper : bool
        Whether each lens is learned and corrected the paper's own way from end to end too.
    general : bool
        Whether a general profile of the lens model is compared with, see `general.general_field`.
    target : bool
        Whether each lens is measured with a printed target too.
    """

    cases: tuple[Case, ...]
    scenes: Path | None = None
    estimator: str = "default"
    methods: tuple[str, ...] = METHODS
    rivals: tuple[str, ...] = RIVALS
    programs: tuple[str, ...] = ()
    size: Size = "default"
    paper: bool = True
    general: bool = True
    target: bool = True

    def files(self) -> tuple[Path, ...]:
        """Return the photographs."""
        return scene_files(self.scenes)


def planned(
    size: Size,
    *,
    scenes: Path | None = None,
    estimator: str = "default",
    hard: bool = False,
    lenses: int | None = None,
    grids: Sequence[Path] | None = None,
    only: Sequence[str] = (),
    paper: bool = True,
    target: bool = True,
) -> Reproduction:
    """Plan a run of one of three sizes.

    Parameters
    ----------
    size : {"quick", "default", "full"}
        Two lenses, small photos, n = 1, 2; eight lenses of different kind, wide open, n = 1, 2, 5;
        the same stopped down too, the zoom also at its long end, and n = 10, 20 on smaller frames.
        The default size takes the other paths (high ISO, TIFF, JPEG) with two lenses each, the full
        size takes them and the scenes that hurt with four.
    scenes : Path or None
        See `Reproduction`.
    estimator : str
        See `Reproduction`.
    hard : bool
        Take the scenes that hurt too, each with two lenses.
    lenses : int or None
        Only so many of the lenses of each family, the first ones; results of a smaller run serve a larger
        one.
    grids : sequence of Path, optional
        Grids of ray-traced lenses, one lens each; None takes those of the repository.
    only : sequence of str
        Only lenses whose name begins so, such as "1003" or "heliar"; for sittings on several machines.
    paper, target : bool
        See `Reproduction`.

    Raises
    ------
    InvalidInputError
        If `lenses` is below one, two grids are of one design and aperture, or no lens has such a name.

    Notes
    -----
    With few photographs the largest n shrinks to what they allow without using one twice.
    """
    files = scene_files(scenes)
    if lenses is not None and lenses < 1:
        raise InvalidInputError(f"a reproduction takes at least one lens, not {lenses}")
    seeds = range(FIRST_SEED, FIRST_SEED + 8)[:lenses]
    paths = tuple(families.repository_grids() if grids is None else grids)[:lenses]
    if size == "quick":
        two = (FIRST_SEED, FIRST_SEED + 4)[:lenses]
        cases = tuple(_case(seed, (1, 2), files, _QUICK_FRAME) for seed in two)
        cases += tuple(_traced(path, (1, 2), files, _QUICK_FRAME) for path in paths)
    else:
        few = _allowed((1, 2, 5), len(files))
        cases = tuple(_case(seed, few, files) for seed in seeds)
        cases += tuple(_traced(path, few, files) for path in paths)
    if size == "full":
        zooms = [seed for seed in seeds if len(draw_lens(seed).focal_mm) > 1]
        cases += tuple(_case(seed, few, files, focal=-1) for seed in zooms)
        cases += tuple(_case(seed, few, files, stopped=_STOPPED_DOWN) for seed in seeds)
        many = _allowed((10, 20), 2 * len(files))
        cases += tuple(_case(seed, many, files) for seed in seeds if many != few)
    names = (PATHS if size != "quick" or hard else ()) + (SCENES_THAT_HURT if hard or size == "full" else ())
    each = min({"quick": 1, "default": 2, "full": 4}[size], len(seeds))
    for number, name in enumerate(names):
        # other lenses for each, in turn, as unlike each other as they come
        chosen = [seeds[(number + len(seeds) * i // each) % len(seeds)] for i in range(each)]
        frame = _QUICK_FRAME if size == "quick" else _HARD_FRAME
        cases += tuple(replace(_case(seed, (1,), files, frame), condition=name) for seed in chosen)
    return Reproduction(
        _chosen(cases, only),
        scenes,
        estimator,
        programs=programs.installed(),
        size=size,
        paper=paper,
        target=target,
    )


def _chosen(cases: Sequence[Case], only: Sequence[str]) -> tuple[Case, ...]:
    names = [case.name for case in cases]
    if len(set(names)) < len(names):
        raise InvalidInputError("two grids are of one design and aperture; give one of each")
    unknown = [text for text in only if not any(name.startswith(text) for name in names)]
    if unknown:
        raise InvalidInputError(f"no lens's name begins with {unknown[0]!r}; they are {', '.join(names)}")
    return tuple(case for case in cases if not only or case.name.startswith(tuple(only)))


def fingerprint(extra: Sequence[Path] = ()) -> str:
    """Hash of the code and data that figures depend on, and `extra`.

    Those are the steps from a photo to a corrected one, the simulation and what measures; not reports, pages,
    plans and other benchmarks, whose change leaves stored results as they are.

    Parameters
    ----------
    extra : sequence of Path
        Further folders or files of Python code.
    """
    own = Path(__file__).parent
    root = Path(lensmodel.__file__).parent
    code = [
        path
        for part in _PARTS
        for path in (root / part).rglob("*")
        if path.suffix in {".py", ".npz", ".json"} and path.stem not in _NO_PART
    ]
    code += [own / f"{name}.py" for name in _MEASURING]
    code += [p for path in extra for p in ([path] if path.is_file() else path.rglob("*.py"))]
    total = hashlib.sha256()
    for path in sorted(code, key=lambda path: (path.name, path.as_posix())):
        total.update(path.name.encode() + b"\0" + path.read_bytes())
    return total.hexdigest()[:16]


def key_of(case: Case, plan: Reproduction, route: str, code: str) -> str:
    """Name under which the results of a case are stored: of all that they depend on.

    The numbers of photos are no part of it, so that a later run with more of them finds what is
    there; the largest is, because it decides how many frames there are.
    """
    parts = (
        PROTOCOL,
        code,
        (case.seed, case.focal_mm, case.aperture, case.height, case.width, case.photos[-1]),
        None if case.grid is None else families.content(case.grid),
        case.condition,
        case.layout,
        plan.estimator,
        plan.methods,
        route,
        content_of(plan.files()),
    )
    return f"{case.name}-{hashlib.sha256(repr(parts).encode()).hexdigest()[:12]}"


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
    lens = families.traced(path)
    layout = layout_for(files, photos[-1] + 1, frame)
    height, width = frame or layout.frame
    return Case(
        families.number(path),
        lens.focal_mm[0],
        lens.widest(),
        photos,
        height,
        width,
        layout,
        grid=path,
    )
