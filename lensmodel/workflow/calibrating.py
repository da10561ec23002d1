"""Steps 1 and 2: from photos to a lens. One loop over photos for library and commands.

photo, photo, ... -> samples of each (`sampling`) -> added to the model
"""

from __future__ import annotations

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


@dataclass(frozen=True, slots=True)
class PhotoVerdict:
    """What became of a photo: how many samples it gave, None where the lens has it already; or why not."""

    photo: Path
    samples: int | None = None
    error: LensModelError | OSError | None = None


def _verdict(path: Path, learn: Callable[[], int | None]) -> PhotoVerdict:
    try:
        return PhotoVerdict(path, learn())
    except CancelledError:  # is of the whole work, not of one photo
        raise
    except (LensModelError, OSError) as error:
        return PhotoVerdict(path, error=error)


class Calibration:
    """A lens that learns from one photo after the other, kept in a store.

    `begin` are the choices of the regression of a new lens; a known one keeps its own. `pool` estimates the
    cells of all photos, where they are estimated here; without one each photo starts and ends processes of
    its own.
    """

    def __init__(
        self,
        store: LensStore,
        config: Config,
        *,
        begin: ModelSettings | None = None,
        any_lens: bool = False,
        pool: Executor | None = None,
    ) -> None:
        self._store, self._config = store, config
        self._begin = begin or ModelSettings(mode=config.preset.mode)
        self._any_lens, self._pool = any_lens, pool
        config.of_lens(self.known).check()

    @property
    def known(self) -> Lens | None:
        """The lens as it is now, with what other runs added; None where no photo could be used."""
        return self._store.lens()

    def learn(
        self,
        paths: Iterable[Path],
        executor: Executor | None = None,
        *,
        ahead: int = AHEAD,
        on_event: EventHook = ignore_event,
    ) -> Iterator[PhotoVerdict]:
        """Learn from photos in their order, on an executor if there is one, and give what becomes of each."""
        paths = list(paths)
        if executor is None:
            for path in paths:
                yield _verdict(path, partial(self.add, path, siblings=paths, on_event=on_event))
            return
        orders: dict[Path, tuple[str, Identity]] = {}

        def sent(path: Path) -> tuple[Any, ...] | None:
            """What the executor needs; None where there is nothing to send, and `add` says why."""
            try:
                key = photo_id(path)
                if self._knows(key):
                    return None
                require_original(path)
                orders[path] = key, self._admitted(photo.inspect(path).metadata)
                return path.name, path.read_bytes(), self._config.of_lens(self.known), key
            except (LensModelError, OSError):
                return None

        for path, job in processes.in_order(executor, samples_of_bytes, paths, sent, ahead=ahead):
            if job is None:
                yield _verdict(path, partial(self.add, path, siblings=paths, on_event=on_event))
            else:
                yield _verdict(path, partial(self._received, path, *orders[path], job))

    def add(
        self, path: Path, *, siblings: Iterable[Path] = (), on_event: EventHook = ignore_event
    ) -> int | None:
        """Learn from one photo; return how many samples it gave, None where the lens has it already.

        `siblings` are other photos, which tell of the defects of the sensor.
        """
        key = photo_id(path)
        if self._knows(key):
            return None
        require_original(path)
        identities: list[Identity] = []
        samples = samples_of_photo(
            path,
            self._config.of_lens(self.known),
            key=key,
            admit=lambda metadata: identities.append(self._admitted(metadata)),
            executor=self._pool,
            siblings=siblings,
            on_event=on_event,
        )
        return self._keep(path, key, identities[0], samples)

    def _received(self, path: Path, key: str, identity: Identity, job: Future[list[PsfSample]]) -> int | None:
        """Wait for the samples of a photo, and add them."""
        return self._keep(path, key, identity, job.result())

    def _keep(self, path: Path, key: str, identity: Identity, samples: Sequence[PsfSample]) -> int | None:
        """Add the samples of a photo to the lens as it is now."""
        if self._knows(key):  # another run has added it meanwhile
            return None
        lens = self.known
        if lens is not None and not self._any_lens:
            require_same_lens(lens, identity)
        model = LensModel.fit(samples, self._begin) if lens is None else lens.model.added(samples)
        self._store.keep(grown(lens, model, key, path, identity, any_lens=self._any_lens))
        return len(samples)

    def _knows(self, key: str) -> bool:
        lens = self.known
        return lens is not None and (
            key in lens.profile.photos or any(sample.photo == key for sample in lens.samples)
        )

    def _admitted(self, metadata: PhotoMetadata) -> Identity:
        """Return what a photo says of lens and camera, after refusing one that cannot teach this lens."""
        identity, lens = Identity.of(metadata), self.known
        if lens is not None and not self._any_lens:
            require_same_lens(lens, identity)
        require_aperture(metadata, self._config.settings)
        return identity


def require_same_lens(lens: Lens, identity: Identity) -> None:
    """Refuse a photo of another lens."""
    why = difference(lens.profile.lens, lens.profile.cameras, identity)
    if why is not None:
        raise InvalidInputError(
            f"{why}; give it a profile of its own, or allow it (--any-lens, any_lens=True)"
        )


def require_original(path: Path) -> None:
    """Refuse a photo that this program has corrected."""
    if path.stem.endswith(CORRECTED):
        raise InvalidInputError("it was corrected already and says nothing about the lens; give the original")


def grown(
    lens: Lens | None, model: LensModel, key: str, path: Path, identity: Identity, *, any_lens: bool = False
) -> Lens:
    """Return a lens whose model has learned from one photo more, with names and cameras of both.

    A photo that may be of another lens (`any_lens`) does not name this one.
    """
    known = LensProfile(model) if lens is None else lens.profile
    names, camera = known.lens, identity.camera
    if lens is None or not any_lens:
        names = {**identity.lens, **names}
    new = () if camera is None or camera in known.cameras else (camera,)
    return Lens(LensProfile(model, names, {**known.photos, key: path.name}, (*known.cameras, *new)))


def joined(
    model: LensModel | None,
    samples: Sequence[PsfSample],
    *,
    replace: bool = False,
) -> LensModel:
    """Add measured samples to a model, or begin one with them."""
    if model is None:
        return LensModel.fit(samples)
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
