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
"""First bytes of a profile, damaged or not: the signature of a ZIP file."""


@dataclass(frozen=True, slots=True)
class Options:
    """The options of the command."""

    aperture: float | None
    estimator: str | None
    workers: int | None
    any_lens: bool
    force: bool
    family: Path | None
    no_family: bool
    unit: str | None
    scheduler: str | None = None
    selector: str = "r-map"
    model: str | None = None
    kernel_size: int | None = None


def run(names: Sequence[str], target: Path, options: Options, display: Display, *, as_json: bool) -> None:
    """Add photos to a profile, one after the other, and save it after each.

    Raises
    ------
    UsageError
        If something is wrong that can be seen before any work.
    typer.Exit
        With 1 if a photo could not be used.
    """
    paths = files.photos(names)
    _refuse(target, paths, options)
    with files.as_usage():
        chosen = _chosen(options)
        settings = LensSettings(aperture=options.aperture)
        family = None if options.family is None else files.profile_at(options.family)
    calibration = Calibration(target, options, settings, chosen, family)
    results: list[dict[str, Any]] = []
    with display.progress() as bars:
        task = bars.add_task("", total=len(paths))
        for number, (path, samples) in enumerate(cluster.estimated(options.scheduler, paths, calibration)):
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
        "model": way_of(profile.model).name if profile else None,
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


def _chosen(options: Options) -> ModelSettings:
    """Return the settings of a new profile's model, after checking that everything named exists."""
    way = way_named(options.model or "default")
    estimation.estimators.create(options.estimator or way.estimator)
    require_size(options.kernel_size or way.kernel_size)
    selectors.create(options.selector)
    return ModelSettings(mode=way.mode, unit=options.unit or MICROMETRE)


def _refuse(target: Path, photos: Sequence[Path], options: Options) -> None:
    """Refuse to replace a photo, and options that contradict each other."""
    if target.is_dir():
        raise UsageError(f"{target} is a folder; give the file of a lens profile")
    # a shell expands `--profile holiday/*.dng` to a profile and photos
    if target.suffix.lower() in ENDINGS or any(files.same(target, path) for path in photos):
        raise UsageError(
            f"{target.name} is a photo; name a new file after --profile, for example my-24mm.lensprofile"
        )
    if options.family is not None and options.no_family:
        raise UsageError("--family and --no-family exclude each other; give one of them")
    if options.family is not None and files.same(target, options.family):
        raise UsageError(f"{options.family} is the profile itself; give that of another copy after --family")


def _show(bars: Progress, task: TaskID, number: int, event: pipeline.CalibrationEvent) -> None:
    share = event.done / event.total if event.total else 0.0
    bars.update(task, description=f"{event.photo.name}: {event.stage}", completed=number + share)


class Calibration:
    """A profile that grows, and its file.

    Another run may add to the same file meanwhile: the profile is read again whenever the file has
    changed, so that no run drops what another one learned.
    """

    def __init__(
        self,
        target: Path,
        options: Options,
        settings: LensSettings,
        chosen: ModelSettings,
        family: LensProfile | None,
    ) -> None:
        self.profile: LensProfile | None = None
        self._target, self._options, self._settings, self._chosen = target, options, settings, chosen
        self._family, self._changed = family, False
        self._stamp_read = _stamp(target) if options.force else None
        self._follow()

    def finish(self, on_step: StepHook) -> None:
        """Do the slow fits, once, after all photos."""
        self._follow()
        if self.profile is not None and self._changed:
            whole = replace(self.profile, model=self.profile.model.warmed(on_step))
            if (
                _stamp(self._target) == self._stamp_read
            ):  # else another run is adding photos, and does this at its end
                self._save(whole)

    def order(self, path: Path) -> tuple[Any, ...] | None:
        """Return what a cluster needs to estimate a photo; None if there is nothing to estimate."""
        if path.stem.endswith(files.CORRECTED) or self._has(pipeline.photo_id(path)):
            return None
        if self._settings.aperture is None and not files.says_aperture(path):
            return None
        options, count = self._options, pipeline.DEFAULT_PATCHES
        settings = (self._settings, self._estimator, count, options.selector, self._kernel_size)
        return path.name, path.read_bytes(), *settings

    def add(
        self, path: Path, on_event: pipeline.EventHook, estimated: Future[list[PsfSample]] | None = None
    ) -> dict[str, Any]:
        """Learn from one photo, whose samples may come from a cluster; return what became of it."""
        if path.stem.endswith(files.CORRECTED):
            raise InvalidInputError(
                "it was corrected already and says nothing about the lens; give the original"
            )
        key = pipeline.photo_id(path)
        if self._has(key):
            return {"state": "known"}
        identity = files.identity(path)
        self._refuse_other_lens(identity)
        if self._settings.aperture is None and not files.says_aperture(path):
            raise MetadataMissingError("it does not say its aperture; add it, for example --aperture 2.8")
        samples = (
            pipeline.samples_of_photo(
                path,
                settings=self._settings,
                estimator=self._estimator,
                selector=self._options.selector,
                kernel_size=self._kernel_size,
                workers=self._options.workers,
                on_event=on_event,
            )
            if estimated is None
            else estimated.result()
        )
        if self._has(key):
            return {"state": "known"}
        self._refuse_other_lens(identity)
        if self.profile is None:
            lens, model = None, self._with_family(LensModel.fit(samples, self._chosen))
        else:
            lens, model = Lens(self.profile), self.profile.model.added(samples)
        grown = Lens.grown(lens, model, {key: path.name}, [identity], any_lens=self._options.any_lens)
        self._save(grown.profile)
        self._changed = True
        return {"state": "counted", "samples": len(samples)}

    @property
    def _way(self) -> Way:
        """The way the lens is learned: as the options say, else as before."""
        if self._options.model is not None or self.profile is None:
            return way_named(self._options.model or "default")
        return way_of(self.profile.model)

    @property
    def _estimator(self) -> str:
        return self._options.estimator or self._way.estimator

    @property
    def _kernel_size(self) -> int:
        return self._options.kernel_size or self._way.kernel_size

    def _has(self, photo: str) -> bool:
        self._follow()
        return self.profile is not None and photo in self.profile.photos

    def _refuse_other_lens(self, identity: Identity) -> None:
        if self.profile is None or self._options.any_lens:
            return
        why = difference(self.profile.lens, self.profile.cameras, identity)
        if why is not None:
            raise InvalidInputError(f"{why}; give it a profile of its own, or add --any-lens")

    def _follow(self) -> None:
        """Read the profile if another run changed it, and apply the options to it."""
        stamp = _stamp(self._target)
        if stamp in {None, self._stamp_read}:
            return
        profile = _opened(self._target)
        mode = None if self._options.model is None else way_named(self._options.model).mode
        model = self._with_family(profile.model.answering(mode=mode, unit=self._options.unit))
        self.profile, self._stamp_read = replace(profile, model=model), stamp
        self._changed = self._changed or model is not profile.model

    def _with_family(self, model: LensModel) -> LensModel:
        """Add the profile of another copy as a prior, as the options say."""
        if self._options.no_family:
            return model.with_prior(None)
        if self._family is None:
            return model
        lens = self._family.lens
        name = " ".join(lens[key] for key in ("maker", "model", "serial") if lens.get(key))
        return model.with_prior(self._family.model, name=name or "another copy")

    def _save(self, profile: LensProfile) -> None:
        self._target.parent.mkdir(parents=True, exist_ok=True)
        save_profile(self._target, profile)
        self.profile, self._stamp_read = profile, _stamp(self._target)


def _opened(target: Path) -> LensProfile:
    try:
        return files.profile_at(target)
    except InvalidInputError as error:
        with target.open("rb") as file:
            damaged = file.read(len(_ZIP)) == _ZIP
        remedy = "--force replaces the file" if damaged else "name a new file after --profile"
        raise InvalidInputError(f"{error}; {remedy}") from error


def _stamp(path: Path) -> tuple[int, int, int] | None:
    """Return inode, size and time of a file, which change when it is replaced; None without file."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns
