"""Ways from photo files to a lens model and to corrected photos: what is under test."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from pathlib import Path
from typing import Final, Protocol, TypeAlias

from lab.reproduce.cases import Case
from lensmodel.core import psf
from lensmodel.core.errors import LensModelError, NoSamplesError
from lensmodel.core.psf import PsfField
from lensmodel.core.types import Channel, FieldPosition, Kernel, LensSettings, Planes
from lensmodel.correction import correct_planes
from lensmodel.model import LensModel, LensProfile, ModelSettings, load_profile, save_profile
from lensmodel.photo import LinearPhoto, develop
from lensmodel.photo.lateral import LateralColour, resample
from lensmodel.workflow import pipeline
from lensmodel.workflow.ways import WAYS, Way

Place: TypeAlias = tuple[FieldPosition, Channel]


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """A PSF as the route gives it.

    Parameters
    ----------
    kernel : Kernel
    predicted_error : float
        Relative L2 that the model expects of it; NaN where it says nothing.
    """

    kernel: Kernel
    predicted_error: float


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedPhoto:
    """A photo as the route corrects it.

    Parameters
    ----------
    planes : Planes
        In the camera's colours, linear, not white-balanced.
    expected_db : mapping of str to float or None
        Gain in PSNR of linear light that the correction expects of itself, by zone; None where it is not
        sure enough to tell.
    nothing_to_correct : bool
        Whether the correction said so, and left every pixel as it was.
    """

    planes: Planes
    expected_db: Mapping[str, float | None] = dataclass_field(default_factory=dict)
    nothing_to_correct: bool = False


class Route(Protocol):
    """One lens that learns from photos, answers for its PSF, and corrects photos."""

    def learn(self, photo: Path) -> str:
        """Learn from one more photo; return why it did not count, or nothing.

        A photo that has been learned from before changes nothing.
        """

    def answers(self, places: Sequence[Place], settings: LensSettings, size: int) -> list[Answer]:
        """Return the PSFs at some places.

        Raises
        ------
        NoSamplesError
            If no photo has counted yet.
        """

    def corrected(self, photo: Path, method: str) -> CorrectedPhoto:
        """Correct a photo that takes no part in learning, with what is known now."""


_SMALL_FRAME: Final = 2e6
"""Pixels below which the paper's way estimates kernels of the default's size (chosen): its 55 pixels are of
frames of 21 megapixels, a hundredth of their width, and take several times as long."""


def paper_way(case: Case) -> Way:
    """Return the paper's own way from end to end, as it suits the frames of a case."""
    if case.height * case.width >= _SMALL_FRAME:
        return WAYS["paper"]
    return replace(WAYS["paper"], kernel_size=pipeline.DEFAULT_KERNEL_SIZE)


OpenRoute: TypeAlias = Callable[[Case, Path], AbstractContextManager[Route]]
"""Opens the route of a case; the folder keeps what was learned, should the run be stopped."""


class DirectRoute:
    """The library in this process, without the service.

    Parameters
    ----------
    folder : Path
        Where models are kept between runs.
    estimator : str or None
        Name in the registry of blind estimators; None takes that of the way.
    workers : int or None
        Processes; None takes all cores.
    way : Way
        How the lens is learned.
    """

    def __init__(
        self,
        folder: Path,
        estimator: str | None = None,
        workers: int | None = None,
        *,
        way: Way = WAYS["default"],
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._workers = folder, workers
        self._way = way if estimator is None else replace(way, estimator=estimator)
        self._seen: list[str] = []
        self._model: LensModel | None = None

    def learn(self, photo: Path) -> str:
        """Learn from one more photo; see `Route`."""
        name = pipeline.photo_id(photo)
        if name in self._seen:
            return ""
        self._seen.append(name)
        chosen = ModelSettings(mode=self._way.mode)
        stored = self._folder / f"{name}.lensprofile"
        refused = self._folder / f"{name}.json"
        if refused.exists():
            return str(json.loads(refused.read_text(encoding="utf-8")))
        if stored.exists():
            samples = load_profile(stored).model.samples
        else:
            try:
                samples = tuple(
                    pipeline.samples_of_photo(
                        photo,
                        pipeline.Recipe(estimator=self._way.estimator, kernel_size=self._way.kernel_size),
                        workers=self._workers,
                    )
                )
            except LensModelError as error:
                refused.write_text(json.dumps(str(error)), encoding="utf-8")
                return str(error)
            save_profile(stored, LensProfile(LensModel.fit(samples, chosen)))
        self._model = LensModel.fit(samples, chosen) if self._model is None else self._model.added(samples)
        return ""

    def answers(self, places: Sequence[Place], settings: LensSettings, size: int) -> list[Answer]:
        """Return the PSFs at some places; see `Route`."""
        model = self._known()
        found = [model.query(place, settings.with_channel(channel), size) for place, channel in places]
        return [Answer(answer.kernel, answer.predicted_error) for answer in found]

    def corrected(self, photo: Path, method: str) -> CorrectedPhoto:
        """Correct a photo; see `Route`."""
        developed = develop(photo)
        done = pipeline.correct_photo(
            developed,
            self._known(),
            pipeline.settings_of(developed),
            method=method,
            lateral=pipeline.lateral_of(developed),
            workers=self._workers or os.cpu_count() or 1,
        )
        expected: dict[str, float | None] = {
            zone: report.expected_gain_db for zone, report in done.zones.items()
        }
        return CorrectedPhoto(done.planes, expected, done.nothing_to_correct)

    def _known(self) -> LensModel:
        if self._model is None:
            raise NoSamplesError("no photo has counted yet: learn from one with fine detail in focus")
        return self._model


@dataclass(frozen=True, slots=True, eq=False)
class Remembered:
    """A PSF field whose kernels are made once: several photos are corrected with it."""

    field: PsfField
    _known: dict[tuple[float, float, Channel, int], Kernel] = dataclass_field(default_factory=dict)

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel of a place; see `PsfField`."""
        key = (position.r, position.phi, channel, size)
        if key not in self._known:
            self._known[key] = self.field.kernel_at(position, channel, size)
        return self._known[key]


@dataclass(frozen=True, slots=True)
class PointField:
    """A lens without any blur: what is left of a correction with it is denoising and demosaicing."""

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return a point."""
        del position, channel
        return psf.delta(size)


def corrected_with(developed: LinearPhoto, field: PsfField, method: str, *, workers: int = 1) -> Planes:
    """Correct a photo with a PSF field taken as right, as the routes do with theirs."""
    planes, cfa = developed.planes, developed.cfa
    lateral: LateralColour | None = pipeline.lateral_of(developed)
    if method == "paper" and lateral is not None:
        # the same way as `pipeline.correct_photo` goes, so that only the PSFs differ
        planes, lateral, cfa = resample(planes, developed.frame, lateral), None, None
    return correct_planes(
        planes,
        field,
        developed.frame,
        method=method,
        noise=developed.correction_noise,
        clip=developed.clip,
        lateral=lateral,
        cfa=cfa,
        workers=workers,
    ).planes
