"""Steps 1 and 2: from photos to a lens. One loop over photos for library and commands.

photo, photo, ... -> samples of each (`sampling`) -> added to the model
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future
from functools import partial
from pathlib import Path
from typing import Any, Final

from lensmodel import photo
from lensmodel.blind.sampling import (
    CalibrationEvent,
    Config,
    EventHook,
    ignore_event,
    photo_id,
    samples_of_bytes,
    samples_of_photo,
)
from lensmodel.core import processes
from lensmodel.core.errors import CancelledError, InvalidInputError, LensModelError
from lensmodel.core.psf import PsfSample
from lensmodel.lens import Lens
from lensmodel.model import LensModel, LensProfile
from lensmodel.model.profile import Identity, difference
from lensmodel.photo import PhotoMetadata
from lensmodel.photo.values import CORRECTED

AHEAD: Final = 32  # photos that are sent to an executor at once (chosen): a gigabyte, work for dozens


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

    `pool` estimates the cells of all photos.
    """

    def __init__(
        self, store: LensStore, config: Config, *, any_lens: bool = False, pool: Executor | None = None
    ) -> None:
        self._store, self._config, self._any_lens, self._pool = store, config, any_lens, pool

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
        on_event: EventHook = ignore_event,
    ) -> Iterator[CalibrationEvent]:
        """Learn from photos in their order, on an executor if there is one; give what becomes of each."""
        jobs: Iterable[tuple[Path, Future[list[PsfSample]] | None]] = ((path, None) for path in paths)
        if executor is not None:
            jobs = processes.in_order(executor, samples_of_bytes, paths, self._sent, ahead=ahead)
        for path, job in jobs:
            try:
                count = self.add(path, partial(self._sampled, path, job, on_event))
            except CancelledError:  # is of the whole work, not of one photo
                raise
            except (LensModelError, OSError) as error:
                yield CalibrationEvent(path, "skipped", detail=str(error), error=error)
            else:
                known = CalibrationEvent(path, "skipped", detail="its samples are in the model already")
                yield known if count is None else CalibrationEvent(path, "counted", count, count)

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
            known = LensProfile(LensModel.fit(samples, self._config.model))
        else:
            known = dataclasses.replace(lens.profile, model=lens.model.added(samples))
        names = known.lens
        if lens is None or not self._any_lens:  # a photo that may be of another lens does not name this one
            names = {**identity.names, **names}
        cameras = tuple(dict.fromkeys([*known.cameras, *identity.cameras]))
        self._store.keep(Lens(LensProfile(known.model, names, {**known.photos, key: path.name}, cameras)))
        return len(samples)

    def _sampled(
        self, path: Path, job: Future[list[PsfSample]] | None, on_event: EventHook, key: str, admit: Admit
    ) -> list[PsfSample]:
        """Estimate the samples of a photo, or wait for those that are estimated elsewhere."""
        if job is not None:
            admit(photo.inspect(path).metadata)
            return job.result()
        return samples_of_photo(
            path, self._config, key=key, admit=admit, executor=self._pool, on_event=on_event
        )

    def _sent(self, path: Path) -> tuple[Any, ...] | None:
        """What an executor needs of a photo; None where there is nothing to send, and `add` says why."""
        try:
            key = photo_id(path)
            if self.knows(key) or path.stem.endswith(CORRECTED):
                return None
            self._admitted(photo.inspect(path).metadata)
            return path.name, path.read_bytes(), self._config, key
        except (LensModelError, OSError):
            return None

    def _admitted(self, metadata: PhotoMetadata) -> Identity:
        """Return what a photo says of lens and camera, after refusing one that cannot teach this lens."""
        identity = Identity.of(metadata)
        self._require_same(self.known, identity)
        metadata.require_aperture(self._config.settings)
        return identity

    def _require_same(self, lens: Lens | None, identity: Identity) -> None:
        """Refuse a photo of another lens."""
        if lens is None or self._any_lens:
            return
        why = difference(Identity.of_profile(lens.profile), identity)
        if why is not None:
            raise InvalidInputError(
                f"it seems to be of another lens: {why}; give it a profile of its own, or allow it "
                "(--any-lens, any_lens=True)"
            )
