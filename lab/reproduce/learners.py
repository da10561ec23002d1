"""From photo files to a lens model and to corrected photos, as a user goes: what is under test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from pathlib import Path
from typing import Final, Protocol, TypeAlias

import numpy as np

from lab.reproduce.cases import Case
from lensmodel.core.errors import LensModelError, NoSamplesError
from lensmodel.core.psf import PsfField
from lensmodel.core.types import Channel, FieldPosition, Kernel, LensSettings, Planes
from lensmodel.correction import correct_planes
from lensmodel.model import LensModel, ModelSettings
from lensmodel.photo import LinearPhoto, develop
from lensmodel.photo.lateral import LateralColour, resample
from lensmodel.workflow import correcting, sampling
from lensmodel.workflow.sampling import PRESETS, Preset

Place: TypeAlias = tuple[FieldPosition, Channel]
Roi: TypeAlias = tuple[int, int, int, int]
"""Row, column, height and width of a part of a frame."""

_SMALL_FRAME: Final = 2e6
"""Pixels below which the paper's way takes kernels of the default's size (chosen): 55 are of 21 MP."""


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """A PSF as the lens model gives it."""

    kernel: Kernel
    predicted_error: float  # relative L2 that the model expects of it; NaN where it says nothing


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedPhoto:
    """A photo as the lens model corrects it: its parts, in what it was."""

    planes: Planes  # in the camera's colours, linear, not white-balanced
    # gain in PSNR of linear light that the correction expects of itself, by zone, mean over the parts; None
    # where it is not sure enough to tell
    expected_db: Mapping[str, float | None] = dataclass_field(default_factory=dict)
    nothing_to_correct: bool = False  # whether the correction said so, and left every pixel as it was


class Learner(Protocol):
    """One lens that learns from photos, answers for its PSF, and corrects photos."""

    def learn(self, photo: Path) -> str:
        """Learn from one more photo; return why it did not count, or nothing.

        A photo that has been learned from before changes nothing; the answer is the same.
        """

    def answers(self, places: Sequence[Place], settings: LensSettings, size: int) -> list[Answer]:
        """Return the PSFs at some places."""

    def corrected(self, photo: Path, method: str, parts: Sequence[Roi]) -> CorrectedPhoto:
        """Correct parts of a photo that takes no part in learning, with what is known now."""


def paper_way(case: Case) -> Preset:
    """Return the paper's own way from end to end, as it suits the frames of a case."""
    if case.height * case.width >= _SMALL_FRAME:
        return PRESETS["paper"]
    return replace(PRESETS["paper"], kernel_size=sampling.DEFAULT_KERNEL_SIZE)


class LibraryLearner:
    """The library in this process, by a way of learning, on so many processes."""

    def __init__(self, way: Preset, workers: int) -> None:
        self._way, self._workers = way, workers
        self._seen: dict[str, str] = {}
        self._model: LensModel | None = None

    def learn(self, photo: Path) -> str:
        """Learn from one more photo; see `Learner`."""
        name = sampling.photo_id(photo)
        if name not in self._seen:
            self._seen[name] = self._learned(photo)
        return self._seen[name]

    def _learned(self, photo: Path) -> str:
        config = sampling.Config(estimator=self._way.estimator, kernel_size=self._way.kernel_size)
        try:
            samples = sampling.samples_of_photo(photo, config, workers=self._workers)
        except LensModelError as error:
            return str(error)
        chosen = ModelSettings(mode=self._way.mode)
        self._model = LensModel.fit(samples, chosen) if self._model is None else self._model.added(samples)
        return ""

    def answers(self, places: Sequence[Place], settings: LensSettings, size: int) -> list[Answer]:
        """Return the PSFs at some places; see `Learner`."""
        model = self._known()
        found = [model.query(place, settings.with_channel(channel), size) for place, channel in places]
        return [Answer(answer.kernel, answer.predicted_error) for answer in found]

    def corrected(self, photo: Path, method: str, parts: Sequence[Roi]) -> CorrectedPhoto:
        """Correct parts of a photo; see `Learner`."""
        developed = develop(photo)
        model, settings = self._known(), sampling.settings_of(developed)
        field = correcting.psfs_for(developed, model, settings, method=method)
        lateral = correcting.lateral_of(developed)
        planes, said, nothing = developed.planes.copy(), dict[str, list[float | None]](), True
        for roi in parts:
            done = correcting.correct_photo(
                developed, model, settings, method=method, lateral=lateral, known=field, roi=roi,
                workers=self._workers,
            )  # fmt: skip
            planes[_inside(roi)] = done.planes
            nothing &= done.nothing_to_correct
            for zone, report in done.zones.items():
                said.setdefault(zone, []).append(report.expected_gain_db)
        expected = {
            zone: None if None in told else float(np.mean([v for v in told if v is not None]))
            for zone, told in said.items()
        }
        return CorrectedPhoto(planes, expected, nothing)

    def _known(self) -> LensModel:
        if self._model is None:
            raise NoSamplesError("no photo has counted yet: learn from one with fine detail in focus")
        return self._model


def corrected_with(
    developed: LinearPhoto, field: PsfField, method: str, parts: Sequence[Roi], *, workers: int = 1
) -> Planes:
    """Correct parts of a photo with a PSF field taken as right, as learners do with theirs."""
    planes, cfa = developed.planes, developed.cfa
    lateral: LateralColour | None = correcting.lateral_of(developed)
    if method == "paper" and lateral is not None:
        # the same way as `correcting.correct_photo` goes, so that only the PSFs differ
        planes, lateral, cfa = resample(planes, developed.frame, lateral), None, None
    made = planes.copy()
    for roi in parts:
        made[_inside(roi)] = correct_planes(
            planes, field, developed.frame, method=method, noise=developed.correction_noise,
            clip=developed.clip, lateral=lateral, cfa=cfa, roi=roi, workers=workers,
        ).planes  # fmt: skip
    return made


def _inside(roi: Roi) -> tuple[slice, slice, slice]:
    row, col, height, width = roi
    return slice(None), slice(row, row + height), slice(col, col + width)
