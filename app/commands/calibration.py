"""`lensmodel calibrate`."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import typer
from rich.progress import Progress, TaskID

from app.commands import cluster
from app.commands.console import files
from app.commands.console.display import Display
from app.commands.console.failure import UsageError
from lensmodel import estimation
from lensmodel.core.errors import InvalidInputError, LensModelError, MetadataMissingError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import ZONE_WORDS, LensSettings, StepHook
from lensmodel.estimation.estimator import require_size
from lensmodel.estimation.patches import selectors
from lensmodel.model import LensModel, LensProfile, ModelSettings, save_profile
from lensmodel.model.answer import MICROMETRE
from lensmodel.photo.endings import ENDINGS
from lensmodel.workflow import pipeline
from lensmodel.workflow.identity import Identity, difference
from lensmodel.workflow.lens import Lens
from lensmodel.workflow.ways import Way, way_named, way_of

_ZIP: Final = b"PK"
"""How a profile begins, damaged or not."""


@dataclass(frozen=True, slots=True)
class Wishes:
    """What the options said."""

    aperture: float | None
    estimator: str | None
    workers: int | None
    any_lens: bool
    force: bool
    family: Path | None
    no_family: bool
    mode: str | None
    unit: str | None
    scheduler: str | None = None
    selector: str = "r-map"
    model: str | None = None
    kernel_size: int | None = None


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
    _refuse(target, paths, wishes)
    with files.as_usage():
        chosen = _chosen(wishes)
        settings = LensSettings(aperture=wishes.aperture)
        family = None if wishes.family is None else files.profile_at(wishes.family)
    calibration = Calibration(target, wishes, settings, chosen, family)
    results: list[dict[str, Any]] = []
    with display.progress() as bars:
        task = bars.add_task("", total=len(paths))
        for number, (path, samples) in enumerate(cluster.estimated(wishes.scheduler, paths, calibration)):
            try:
                result = calibration.add(path, partial(_show, bars, task, number), samples)
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
        cover = ", ".join(f"{ZONE_WORDS[zone]} {count}" for zone, count in profile.model.coverage().items())
        display.result(f"{target}: photos {summary['photos']}, samples {summary['samples']} ({cover})")
    if profile is None:
        display.error(
            "no photo could be used, so there is no profile; the lines above say what each photo needs"
        )
    if any(result["state"] == "failed" for result in results):
        raise typer.Exit(1)


def _chosen(wishes: Wishes) -> ModelSettings:
    """Choose the model of a new profile; make sure that everything that was named is there."""
    way = way_named(wishes.model or "default")
    estimation.estimators.create(wishes.estimator or way.estimator)
    require_size(wishes.kernel_size or way.kernel_size)
    selectors.create(wishes.selector)
    return ModelSettings(mode=wishes.mode or way.mode, unit=wishes.unit or MICROMETRE)


def _refuse(target: Path, photos: Sequence[Path], wishes: Wishes) -> None:
    """Make sure that no photo is replaced, and that the options do not contradict each other."""
    if target.is_dir():
        raise UsageError(f"{target} is a folder; give the file of a lens profile")
    # of `--profile holiday/*.dng` a shell makes a profile and photos
    if target.suffix.lower() in ENDINGS or any(files.same(target, path) for path in photos):
        raise UsageError(
            f"{target.name} is a photo; name a new file after --profile, for example my-24mm.lensprofile"
        )
    if wishes.model is not None and wishes.mode is not None:
        raise UsageError("--model and --mode exclude each other: a model has its own mode; give one of them")
    if wishes.family is not None and wishes.no_family:
        raise UsageError("--family and --no-family exclude each other; give one of them")
    if wishes.family is not None and files.same(target, wishes.family):
        raise UsageError(f"{wishes.family} is the profile itself; give that of another copy after --family")


def _show(bars: Progress, task: TaskID, number: int, event: pipeline.CalibrationEvent) -> None:
    share = event.done / event.total if event.total else 0.0
    bars.update(task, description=f"{event.photo.name}: {event.stage}", completed=number + share)


class Calibration:
    """A profile that grows, and the file that keeps up with it.

    Another run may add to the same file meanwhile: before each look at the profile it is read again
    if it changed, so that no run drops what another one learned.
    """

    def __init__(
        self,
        target: Path,
        wishes: Wishes,
        settings: LensSettings,
        chosen: ModelSettings,
        family: LensProfile | None,
    ) -> None:
        self.profile: LensProfile | None = None
        self._target, self._wishes, self._settings, self._chosen = target, wishes, settings, chosen
        self._family, self._grown = family, False
        self._seen = _stamp(target) if wishes.force else None
        self._follow()

    def finish(self, on_step: StepHook) -> None:
        """Fit what takes long and need be done only once, when all photos are in."""
        self._follow()
        if self.profile is not None and self._grown:
            whole = replace(self.profile, model=self.profile.model.warmed(on_step))
            if _stamp(self._target) == self._seen:  # else another run goes on, and fits it at its own end
                self._save(whole)

    def order(self, path: Path) -> tuple[Any, ...] | None:
        """Return what a cluster needs to estimate a photo; None where nothing is to be estimated of it."""
        if path.stem.endswith(files.CORRECTED) or self._has(pipeline.photo_id(path)):
            return None
        if self._settings.aperture is None and not files.says_aperture(path):
            return None
        wishes, count = self._wishes, pipeline.DEFAULT_PATCHES
        settings = (self._settings, self._estimator, count, wishes.selector, self._kernel_size)
        return path.name, path.read_bytes(), *settings

    def add(
        self, path: Path, on_event: pipeline.EventHook, estimated: Future[list[PsfSample]] | None = None
    ) -> dict[str, Any]:
        """Learn from one photo, whose samples may come from elsewhere; say what became of it."""
        if path.stem.endswith(files.CORRECTED):
            raise InvalidInputError(
                "it was corrected already and says nothing about the lens; give the original"
            )
        key = pipeline.photo_id(path)
        if self._has(key):
            return {"state": "known"}
        seen = files.identity(path)
        self._refuse_other_lens(seen)
        if self._settings.aperture is None and not files.says_aperture(path):
            raise MetadataMissingError("it does not say its aperture; add it, for example --aperture 2.8")
        samples = (
            pipeline.samples_of_photo(
                path,
                settings=self._settings,
                estimator=self._estimator,
                selector=self._wishes.selector,
                kernel_size=self._kernel_size,
                workers=self._wishes.workers,
                on_event=on_event,
            )
            if estimated is None
            else estimated.result()
        )
        if self._has(key):
            return {"state": "known"}
        self._refuse_other_lens(seen)
        if self.profile is None:
            lens, model = None, self._leaning(LensModel.fit(samples, self._chosen))
        else:
            lens, model = Lens(self.profile), self.profile.model.added(samples)
        grown = Lens.grown(lens, model, {key: path.name}, [seen], any_lens=self._wishes.any_lens)
        self._save(grown.profile)
        self._grown = True
        return {"state": "counted", "samples": len(samples)}

    @property
    def _way(self) -> Way:
        """The way the lens is learned: as was wished, or as it was before."""
        if self._wishes.model is not None or self.profile is None:
            return way_named(self._wishes.model or "default")
        return way_of(self.profile.model)

    @property
    def _estimator(self) -> str:
        return self._wishes.estimator or self._way.estimator

    @property
    def _kernel_size(self) -> int:
        return self._wishes.kernel_size or self._way.kernel_size

    def _has(self, photo: str) -> bool:
        self._follow()
        return self.profile is not None and photo in self.profile.photos

    def _refuse_other_lens(self, seen: Identity) -> None:
        if self.profile is None or self._wishes.any_lens:
            return
        why = difference(self.profile.lens, self.profile.cameras, seen)
        if why is not None:
            raise InvalidInputError(f"{why}; give it a profile of its own, or add --any-lens")

    def _follow(self) -> None:
        """Read the profile if it is not as this run left it, and make it answer as was wished."""
        stamp = _stamp(self._target)
        if stamp in {None, self._seen}:
            return
        profile = _opened(self._target)
        mode = self._wishes.mode if self._wishes.model is None else way_named(self._wishes.model).mode
        model = self._leaning(profile.model.answering(mode=mode, unit=self._wishes.unit))
        self.profile, self._seen = replace(profile, model=model), stamp
        self._grown = self._grown or model is not profile.model

    def _leaning(self, model: LensModel) -> LensModel:
        """Start from the profile of another copy where this one has seen little, if that was wished."""
        if self._wishes.no_family:
            return model.with_prior(None)
        if self._family is None:
            return model
        lens = self._family.lens
        name = " ".join(lens[key] for key in ("maker", "model", "serial") if lens.get(key))
        return model.with_prior(self._family.model, name=name or "another copy")

    def _save(self, profile: LensProfile) -> None:
        self._target.parent.mkdir(parents=True, exist_ok=True)
        save_profile(self._target, profile)
        self.profile, self._seen = profile, _stamp(self._target)


def _opened(target: Path) -> LensProfile:
    try:
        return files.profile_at(target)
    except InvalidInputError as error:
        with target.open("rb") as file:
            damaged = file.read(len(_ZIP)) == _ZIP
        remedy = "--force replaces the file" if damaged else "name a new file after --profile"
        raise InvalidInputError(f"{error}; {remedy}") from error


def _stamp(path: Path) -> tuple[int, int, int] | None:
    """What changes when a file is replaced; None where there is none."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns
