"""`lensmodel calibrate`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import typer
from rich.progress import Progress, TaskID

from app.commands import files
from app.commands.display import Display
from app.commands.failure import UsageError
from lensmodel import blind, pipeline
from lensmodel.errors import InvalidInputError, LensModelError
from lensmodel.regression import LensModel, LensProfile, ModelSettings, save_profile
from lensmodel.regression.answer import MICROMETRE, MIXED
from lensmodel.types import LensSettings, StepHook


@dataclass(frozen=True, slots=True)
class Wishes:
    """What the options said."""

    aperture: float | None
    estimator: str
    workers: int | None
    any_lens: bool
    force: bool
    family: Path | None
    no_family: bool
    mode: str | None
    unit: str | None


def run(names: Sequence[str], target: Path, wishes: Wishes, display: Display, *, as_json: bool) -> None:
    """Add photos to a profile, one after the other, and save it after each.

    Raises
    ------
    UsageError
        If something is wrong that can be seen before any work.
    typer.Exit
        With 1 if a photo could not be used.
    """
    paths = files.photos(names)
    with files.as_usage():
        blind.estimators.create(wishes.estimator)
        settings = LensSettings(aperture=wishes.aperture)
    with files.as_usage():
        family = None if wishes.family is None else files.profile_at(wishes.family)
        chosen = ModelSettings(mode=wishes.mode or MIXED, unit=wishes.unit or MICROMETRE)
    calibration = _Calibration(target, _known(target, force=wishes.force), wishes, settings, chosen)
    if family is not None or wishes.no_family:
        calibration.lean_on(family)
    target.parent.mkdir(parents=True, exist_ok=True)
    results: list[dict[str, Any]] = []
    with display.progress() as bars:
        task = bars.add_task("", total=len(paths))
        for number, path in enumerate(paths):
            try:
                result = calibration.add(path, partial(_show, bars, task, number))
            except (LensModelError, OSError) as error:
                code = error.code if isinstance(error, LensModelError) else "unreadable"
                result = {"state": "failed", "code": code, "reason": files.reason(error)}
                display.error(f"{path}: {result['reason']}")
            if result["state"] == "known":
                display.note(f"{path}: the profile has it already")
            results.append({"photo": str(path), **result})
            bars.update(task, completed=number + 1)
        bars.remove_task(task)
        whole = bars.add_task("joining what all photos say", total=None)
        calibration.finish(lambda done, total: bars.update(whole, completed=done, total=total))
    profile = calibration.profile
    summary = {
        "profile": str(target) if profile else None,
        "photos": len(profile.photos) if profile else 0,
        "samples": len(profile.model.samples) if profile else 0,
        "coverage": profile.model.coverage() if profile else {},
        "mode": profile.model.mode if profile else None,
        "results": results,
    }
    if as_json:
        display.document(summary)
    elif profile is not None and any(result["state"] != "failed" for result in results):
        cover = ", ".join(f"{zone} {count}" for zone, count in profile.model.coverage().items())
        display.result(f"{target}: photos {summary['photos']}, samples {summary['samples']} ({cover})")
    if profile is None:
        display.error(
            "no photo could be used, so there is no profile; the lines above say what each photo needs"
        )
    if any(result["state"] == "failed" for result in results):
        raise typer.Exit(1)


def _known(target: Path, *, force: bool) -> LensProfile | None:
    if target.is_dir():
        raise UsageError(f"{target} is a folder; give the file of a lens profile")
    if force or not target.exists():
        return None
    try:
        return files.profile_at(target)
    except InvalidInputError as error:
        raise InvalidInputError(f"{error}; --force replaces the file") from error


def _show(bars: Progress, task: TaskID, number: int, event: pipeline.CalibrationEvent) -> None:
    share = event.done / event.total if event.total else 0.0
    bars.update(task, description=f"{event.photo.name}: {event.stage}", completed=number + share)


class _Calibration:
    """A profile that grows, and the file that keeps up with it."""

    def __init__(
        self,
        target: Path,
        profile: LensProfile | None,
        wishes: Wishes,
        settings: LensSettings,
        chosen: ModelSettings,
    ) -> None:
        self.profile = profile
        self._target, self._wishes, self._settings, self._chosen = target, wishes, settings, chosen
        self._grown = False
        if profile is not None:
            model = profile.model.answering(mode=wishes.mode, unit=wishes.unit)
            self.profile, self._grown = replace(profile, model=model), model is not profile.model
        self._family: LensProfile | None = None

    def lean_on(self, family: LensProfile | None) -> None:
        """Start from the profile of another copy where this one has seen little; None no longer does."""
        self._family = family
        if self.profile is not None:
            self.profile = replace(self.profile, model=self._leaning(self.profile.model))
            self._grown = True

    def _leaning(self, model: LensModel) -> LensModel:
        if self._family is None:
            return model.with_prior(None)
        lens = self._family.lens
        name = " ".join(lens[key] for key in ("maker", "model", "serial") if lens.get(key))
        return model.with_prior(self._family.model, name=name or "another copy")

    def finish(self, on_step: StepHook) -> None:
        """Fit what takes long and need be done only once, when all photos are in."""
        if self.profile is not None and self._grown:
            self.profile = replace(self.profile, model=self.profile.model.warmed(on_step))
            save_profile(self._target, self.profile)

    def add(self, path: Path, on_event: pipeline.EventHook) -> dict[str, Any]:
        """Learn from one photo; say what became of it."""
        if path.stem.endswith(files.CORRECTED):
            raise InvalidInputError(
                "it was corrected already and tells nothing of the lens; give the original"
            )
        key = pipeline.photo_id(path)
        names = dict(self.profile.photos) if self.profile else {}
        if key in names:
            return {"state": "known"}
        lens = dict(self.profile.lens) if self.profile else {}
        seen = files.identity(path)
        if not self._wishes.any_lens:
            files.refuse_other_lens(lens, seen, "give it a profile of its own, or add --any-lens")
        samples = pipeline.samples_of_photo(
            path,
            settings=None if files.says_aperture(path) else self._settings,
            estimator=self._wishes.estimator,
            workers=self._wishes.workers,
            on_event=on_event,
        )
        if self.profile is not None:
            model = self.profile.model.added(samples)
        else:
            model = self._leaning(LensModel.fit(samples, self._chosen))
        grown = LensProfile(model, seen | lens, {**names, key: path.name})
        save_profile(self._target, grown)
        self.profile, self._grown = grown, True
        return {"state": "counted", "samples": len(samples)}
