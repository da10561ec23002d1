"""Which lenses at which apertures, learned from how many photos."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, TypeAlias

import numpy as np

from lab.code_version import version_of
from lab.reproduce import families
from lab.reproduce.conditions import BASE, Condition, condition
from lab.reproduce.families import FIRST_SEED, Family
from lab.reproduce.scenes import Layout, content_of, scene_files
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfField
from lensmodel.core.types import LensSettings
from lensmodel.simulate import CameraLens, SimulatedCamera, SimulatedField, draw_lens

Size: TypeAlias = Literal["quick", "small", "default", "full"]

PROTOCOL: Final = 5
"""Part of every key of a stored result; raised when what is measured changes."""

METHODS: Final = ("paper", "standard")
"""Non-blind methods; here `paper` is the deconvolution alone, Richardson-Lucy, with our own PSFs."""

HARD_METHODS: Final = ("standard",)
"""Of the correction of scenes and paths that hurt: what a user gets who chooses nothing."""

RIVALS: Final = ("schuler", "kee")


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
            return self.seed >= FIRST_SEED and self.seed not in families.SEEDS_LOOKED_AT
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
        Blind methods of others, names in `lab.rivals`; each sees one photo.
    programs : tuple of str
        Programs of others that correct the same photos, names in `lab.peers`.
    size : {"quick", "small", "default", "full"}
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


def fingerprint() -> str:
    """Hash of the code and data that figures depend on: all that is behind the work on one case.

    Rivals and programs have hashes of their own; plans and pages leave stored results as they are.
    """
    apart = (
        "lab.rivals",
        "lab.reproduce.programs",
        "lab.peers",
        "lensmodel.report",
    )
    return version_of("lab.reproduce.job", without=apart)


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
