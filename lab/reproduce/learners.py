"""From photo files to a lens model and to corrected photos, as a user goes: what is under test."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np

from lab.reproduce.cases import METHOD, Case
from lensmodel import api
from lensmodel.blind import sampling
from lensmodel.blind.sampling import PRESETS, Config
from lensmodel.core.errors import LensModelError, NoSamplesError
from lensmodel.core.psf import PsfField
from lensmodel.core.types import Channel, FieldPosition, Kernel, LensSettings, Planes
from lensmodel.correction import correct_planes
from lensmodel.model import LensModel, ModelSettings
from lensmodel.photo import LinearPhoto, develop

Place: TypeAlias = tuple[FieldPosition, Channel]
Roi: TypeAlias = tuple[int, int, int, int]
"""Row, column, height and width of a part of a frame."""

_SMALL_FRAME: Final = 2e6
"""Pixels below which the paper's way takes kernels of the default's size (chosen): 55 are of 21 MP."""


def paper_way(case: Case) -> Config:
    """Return the paper's own way from end to end, as it suits the frames of a case."""
    if case.height * case.width >= _SMALL_FRAME:
        return PRESETS["paper"]
    return replace(PRESETS["paper"], kernel_size=sampling.DEFAULT_KERNEL_SIZE)


class Learner:
    """One lens that learns from photos by a preset, answers for its PSF, and corrects photos."""

    def __init__(self, way: Config, workers: int) -> None:
        self.seconds = 0.0  # that learning took
        self._way, self._workers = way, workers
        self._seen: dict[str, str] = {}  # why photos did not count, by their identity
        self._model: LensModel | None = None

    def learn(self, photos: Sequence[Path]) -> list[str]:
        """Learn from photos that are new; say which of all did not count, and why."""
        began, refused = time.monotonic(), []
        for photo in photos:
            name = sampling.photo_id(photo)
            if name not in self._seen:
                self._seen[name] = self._learned(photo)
            if self._seen[name]:
                refused.append(f"{photo.stem}: {self._seen[name]}")
        self.seconds += time.monotonic() - began
        return refused

    def _learned(self, photo: Path) -> str:
        try:
            samples = sampling.samples_of_photo(photo, self._way, workers=self._workers)
        except LensModelError as error:
            return str(error)
        chosen = ModelSettings(mode=self._way.model)
        self._model = LensModel.fit(samples, chosen) if self._model is None else self._model.added(samples)
        return ""

    def answers(
        self, places: Sequence[Place], settings: LensSettings, size: int
    ) -> list[tuple[Kernel, float]]:
        """Return the PSFs at some places, and the relative L2 error that the model expects of each."""
        model = self._known()
        found = [model.query(place, settings.with_channel(channel), size) for place, channel in places]
        return [(answer.kernel, answer.predicted_error) for answer in found]

    def corrected(self, photo: Path, parts: Sequence[Roi]) -> tuple[Planes, Mapping[str, float | None]]:
        """Correct parts of a photo that takes no part in learning, with what is known now.

        Also the expected gain in PSNR of linear light by zone, mean over the parts; None if not told.
        """
        developed = develop(photo)
        model, settings = self._known(), developed.info.metadata.settings()
        field = api.psfs_for(developed, model, settings, method=self._way.method)
        lateral = api.lateral_of(developed)
        planes, said = developed.planes.copy(), dict[str, list[float | None]]()
        for roi in parts:
            done = api.correct_photo(
                developed, model, settings, method=self._way.method, lateral=lateral, known=field, roi=roi,
                workers=self._workers,
            )  # fmt: skip
            planes[_inside(roi)] = done.planes
            for zone, report in done.zones.items():
                said.setdefault(zone, []).append(report.expected_gain_db)
        expected = {
            zone: None if None in told else float(np.mean([v for v in told if v is not None]))
            for zone, told in said.items()
        }
        return planes, expected

    def _known(self) -> LensModel:
        if self._model is None:
            raise NoSamplesError("no photo has counted yet: learn from one with fine detail in focus")
        return self._model


def corrected_with(
    developed: LinearPhoto, field: PsfField, parts: Sequence[Roi], *, workers: int = 1
) -> Planes:
    """Correct parts of a photo with a PSF field taken as right, as a learner does with its own."""
    lateral, made = api.lateral_of(developed), developed.planes.copy()
    for roi in parts:
        made[_inside(roi)] = correct_planes(
            developed.planes, field, developed.frame, method=METHOD, noise=developed.correction_noise,
            clip=developed.clip, lateral=lateral, cfa=developed.cfa, roi=roi, workers=workers,
        ).planes  # fmt: skip
    return made


def _inside(roi: Roi) -> tuple[slice, slice, slice]:
    row, col, height, width = roi
    return slice(None), slice(row, row + height), slice(col, col + width)
