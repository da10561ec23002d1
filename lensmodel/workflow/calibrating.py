"""Steps 1 and 2: from photos to a lens. One loop over photos for library and commands.

photo, photo, ... -> samples of each (`sampling`) -> added to the model
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

from lensmodel import photo
from lensmodel.core import processes
from lensmodel.core.errors import CancelledError, InvalidInputError, LensModelError
from lensmodel.core.names import name_key, serial_key
from lensmodel.core.psf import PsfSample
from lensmodel.measured import is_measured
from lensmodel.model import Camera, LensModel, LensProfile, ModelSettings
from lensmodel.photo import PhotoMetadata
from lensmodel.photo.values import CORRECTED
from lensmodel.workflow.lens import Lens
from lensmodel.workflow.sampling import (
    CalibrationEvent,
    Config,
    EventHook,
    ignore_event,
    photo_id,
    require_aperture,
    samples_of_bytes,
    samples_of_photo,
)

AHEAD: Final = 32
"""Photos that are sent to an executor at once (chosen): a gigabyte of them, work for some dozen processes."""

SAME_STOPS: Final = 1.0 / 3.0
"""Apertures nearer than this are one setting: cameras set thirds of a stop."""

_SAME_FOCAL: Final = 0.02  # of the focal length: what rounding in metadata changes


@dataclass(frozen=True, slots=True)
class Identity:
    """What a photo says of its lens and of its camera."""

    lens: Mapping[str, str] = field(default_factory=dict)  # maker, model, serial, as far as they are known
    camera: Camera | None = None  # the body; `None` where the photo does not name its model

    @classmethod
    def of(cls, metadata: PhotoMetadata) -> Identity:
        """Take from a photo's metadata what tells of its lens and its camera."""
        lens = metadata.lens
        named = {"maker": lens.maker, "model": lens.model, "serial": lens.serial}
        camera = Camera(metadata.camera_maker, metadata.camera_model, metadata.body_serial)
        return cls({name: value for name, value in named.items() if value}, camera if camera.model else None)

    @property
    def names_lens(self) -> bool:
        """Whether there is more than a maker, which says nothing of the lens."""
        return _names_lens(self.lens)


def difference(known: Mapping[str, str], cameras: Iterable[Camera], identity: Identity) -> str | None:
    """Say why a photo cannot be, or need not be, of the lens of a profile.

    - What both name of the lens must agree.
    - A lens that is part of a camera, and names itself after it, is as unique as the body: the serials of
      both must agree.
    - Where the photo names no lens, its camera must be one that the profile's photos were taken with: the
      lens of a compact is part of it, and two models of camera have two lenses. On the same body an
      unnamed lens may be any that was screwed on; that is for the owner to know.
    - Where only the photo names its lens, its camera recorded more than for the profile's photos, so
      nothing says that they are of one lens, unless the owner gave the profile a label.
    """
    for name, value in identity.lens.items():
        key = serial_key if name == "serial" else name_key
        if key(known.get(name, value)) != key(value):
            return (
                f"it was taken with another lens, {name} {value}, and the profile is of {name} {known[name]}"
            )
    bodies = list(cameras)
    if identity.names_lens and not _names_lens(known) and not known.get("label"):
        return f"it names its lens, {_lens_words(identity.lens)}, and the profile's photos name none"
    if identity.camera is None or not bodies:
        return None
    alike = [body for body in bodies if _same_model(body, identity.camera)]
    if not identity.names_lens and not alike:
        return (
            f"it names no lens and was taken with another camera, {identity.camera.model}, "
            f"and the profile's photos with {', '.join(body.model or 'an unknown camera' for body in bodies)}"
        )
    built_in = not _names_lens(known) if not identity.names_lens else _is_built_in(identity)
    serials = {serial_key(body.serial) for body in alike if body.serial}
    serial = identity.camera.serial
    if built_in and serial and serials and serial_key(serial) not in serials:
        return (
            f"it was taken with another copy of the camera, serial {serial}, and nothing "
            "says that the lens is the same"
        )
    return None


def _names_lens(lens: Mapping[str, str]) -> bool:
    return bool(lens.get("model") or lens.get("serial"))


def _is_built_in(identity: Identity) -> bool:
    camera = "" if identity.camera is None else name_key(identity.camera.model)
    return bool(camera) and camera in name_key(identity.lens.get("model")) and not identity.lens.get("serial")


def _same_model(one: Camera, other: Camera) -> bool:
    # makers write their name into the model or not, and in more than one way; models are not shared
    a, b = name_key(one.model), name_key(other.model)
    return bool(a) and bool(b) and (a.endswith(b) or b.endswith(a))


def _lens_words(lens: Mapping[str, str]) -> str:
    return " ".join(lens[name] for name in ("model", "serial") if lens.get(name))


class LensStore:
    """Where a lens is kept while it learns: in memory; subclasses keep it where other runs may add to it."""

    def __init__(self, lens: Lens | None = None) -> None:
        self._lens = lens

    def lens(self) -> Lens | None:
        """Return the newest lens: the same object until another run has changed it."""
        return self._lens

    def keep(self, lens: Lens) -> None:
        """Keep a lens that has learned from one photo more."""
        self._lens = lens


Admit = Callable[[PhotoMetadata], None]
Sampler = Callable[[str, Admit], Sequence[PsfSample]]
"""Makes the samples of a photo, given its name and what may refuse it by its header."""


class Calibration:
    """A lens that learns from one photo after the other, kept in a store.

    `begin` are the choices of the regression of a new lens; a known one keeps its own. `pool` estimates the
    cells of all photos, where they are estimated here; without one each photo starts and ends processes of
    its own. `replace` drops what was learned blindly at the settings of new, measured samples.
    """

    def __init__(
        self,
        store: LensStore,
        config: Config,
        *,
        begin: ModelSettings | None = None,
        any_lens: bool = False,
        replace: bool = False,
        pool: Executor | None = None,
    ) -> None:
        self._store, self._config = store, config
        self._begin = begin or ModelSettings(mode=config.preset.mode)
        self._any_lens, self._replace, self._pool = any_lens, replace, pool
        config.of_lens(self.known).check()

    @property
    def known(self) -> Lens | None:
        """The lens as it is now, with what other runs added; None where no photo could be used."""
        return self._store.lens()

    def knows(self, key: str) -> bool:
        """Whether the lens was learned from a photo already."""
        lens = self.known
        return lens is not None and (
            key in lens.profile.photos or any(sample.photo == key for sample in lens.samples)
        )

    def learn(
        self,
        paths: Iterable[Path],
        executor: Executor | None = None,
        *,
        ahead: int = AHEAD,
        siblings: Iterable[Path] | None = None,
        on_event: EventHook = ignore_event,
    ) -> Iterator[CalibrationEvent]:
        """Learn from photos in their order, on an executor if there is one; give what becomes of each.

        `siblings` are the photos that tell of the defects of the sensor; by default all of them.
        """
        paths = list(paths)
        jobs: Iterable[tuple[Path, Future[list[PsfSample]] | None]] = ((path, None) for path in paths)
        if executor is not None:
            jobs = processes.in_order(executor, samples_of_bytes, paths, self._sent, ahead=ahead)
        for path, job in jobs:
            sampler = partial(
                self._sampled,
                path,
                job=job,
                siblings=paths if siblings is None else siblings,
                on_event=on_event,
            )
            try:
                count = self.add(path, sampler)
            except CancelledError:  # is of the whole work, not of one photo
                raise
            except (LensModelError, OSError) as error:
                yield CalibrationEvent(path, "skipped", detail=str(error), error=error)
            else:
                if count is None:
                    yield CalibrationEvent(path, "skipped", detail="its samples are in the model already")
                else:
                    yield CalibrationEvent(path, "counted", count, count)

    def add(self, path: Path, sampler: Sampler) -> int | None:
        """Learn from one photo; return how many samples it gave, None where the lens has it already."""
        key = photo_id(path)
        if self.knows(key):
            return None
        if path.stem.endswith(CORRECTED):
            raise InvalidInputError(
                "it was corrected already and says nothing about the lens; give the original"
            )
        identities: list[Identity] = []
        samples = sampler(key, lambda metadata: identities.append(self._admitted(metadata)))
        if self.knows(key):  # another run has added it meanwhile
            return None
        lens, identity = self.known, identities[0]
        self._require_same(lens, identity)
        if lens is None:
            known = LensProfile(LensModel.fit(samples, self._begin))
        else:
            model = joined(lens.model, samples, replace=self._replace)
            known = dataclasses.replace(lens.profile, model=model)
        names, camera = known.lens, identity.camera
        if lens is None or not self._any_lens:  # a photo that may be of another lens does not name this one
            names = {**identity.lens, **names}
        cameras = known.cameras if camera is None or camera in known.cameras else (*known.cameras, camera)
        photos = {**known.photos, key: path.name}
        if self._replace:  # which may have taken all samples of a photo
            left = {sample.photo for sample in known.model.samples}
            photos = {name: label for name, label in photos.items() if name in left}
        self._store.keep(Lens(LensProfile(known.model, names, photos, cameras)))
        return len(samples)

    def _sampled(
        self,
        path: Path,
        key: str,
        admit: Admit,
        *,
        job: Future[list[PsfSample]] | None,
        siblings: Iterable[Path],
        on_event: EventHook,
    ) -> list[PsfSample]:
        """Estimate the samples of a photo, or wait for those that are estimated elsewhere."""
        if job is not None:
            admit(photo.inspect(path).metadata)
            return job.result()
        return samples_of_photo(
            path,
            self._config.of_lens(self.known),
            key=key,
            admit=admit,
            executor=self._pool,
            siblings=siblings,
            on_event=on_event,
        )

    def _sent(self, path: Path) -> tuple[Any, ...] | None:
        """What an executor needs of a photo; None where there is nothing to send, and `add` says why."""
        try:
            key = photo_id(path)
            if self.knows(key) or path.stem.endswith(CORRECTED):
                return None
            self._admitted(photo.inspect(path).metadata)
            return path.name, path.read_bytes(), self._config.of_lens(self.known), key
        except (LensModelError, OSError):
            return None

    def _admitted(self, metadata: PhotoMetadata) -> Identity:
        """Return what a photo says of lens and camera, after refusing one that cannot teach this lens."""
        identity = Identity.of(metadata)
        self._require_same(self.known, identity)
        require_aperture(metadata, self._config.settings)
        return identity

    def _require_same(self, lens: Lens | None, identity: Identity) -> None:
        """Refuse a photo of another lens."""
        if lens is None or self._any_lens:
            return
        why = difference(lens.profile.lens, lens.profile.cameras, identity)
        if why is not None:
            raise InvalidInputError(
                f"{why}; give it a profile of its own, or allow it (--any-lens, any_lens=True)"
            )


def joined(model: LensModel, samples: Sequence[PsfSample], *, replace: bool = False) -> LensModel:
    """Add samples to a model; `replace` drops its blind ones of the same settings."""
    if not replace:
        return model.added(samples)
    kept = [old for old in model.samples if is_measured(old) or not any(_alike(old, new) for new in samples)]
    return LensModel.fit([*kept, *samples], model.settings)


def _alike(old: PsfSample, new: PsfSample) -> bool:
    """Whether two samples are of one setting of the lens."""
    a, b = old.settings.stops, new.settings.stops
    if a is not None and b is not None and abs(a - b) >= SAME_STOPS:
        return False
    f, g = old.settings.focal_mm, new.settings.focal_mm
    return f is None or g is None or abs(f - g) < _SAME_FOCAL * g
