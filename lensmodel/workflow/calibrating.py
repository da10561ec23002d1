"""Steps 1 and 2: from photos to a lens. One loop over photos for library and commands.

photo, photo, ... -> samples of each (`sampling`) -> added to the model
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

from lensmodel import photo
from lensmodel.core import parallel
from lensmodel.core.errors import CancelledError, InvalidInputError, LensModelError
from lensmodel.core.psf import PsfSample
from lensmodel.model import LensModel, ModelSettings
from lensmodel.photo.endings import CORRECTED
from lensmodel.workflow.developed import photo_id, require_aperture
from lensmodel.workflow.identity import Identity, difference
from lensmodel.workflow.lens import Lens
from lensmodel.workflow.sampling import (
    EventHook,
    Recipe,
    ignore_event,
    samples_of_bytes,
    samples_of_photo,
)

AHEAD: Final = 32
"""Photos that are sent to an executor at once (chosen): a gigabyte of them, work for some dozen processes."""


class LensKeeper(Protocol):
    """Where a lens is kept while it learns: in memory, or in a file that other runs may add to."""

    def lens(self) -> Lens | None:
        """Return the newest lens: the same object until another run has changed it."""

    def keep(self, lens: Lens) -> None:
        """Keep a lens that has learned from one photo more."""


class InMemory:
    """The keeper of a single run, which forgets the lens with it."""

    def __init__(self, lens: Lens | None) -> None:
        self._lens = lens

    def lens(self) -> Lens | None:
        """Return the lens that was kept last."""
        return self._lens

    def keep(self, lens: Lens) -> None:
        """Keep a lens."""
        self._lens = lens


@dataclass(frozen=True, slots=True)
class PhotoVerdict:
    """What became of a photo: how many samples it gave, None where the lens has it already; or why not."""

    photo: Path
    samples: int | None = None
    error: LensModelError | OSError | None = None


class Calibration:
    """A lens that learns from one photo after the other.

    Parameters
    ----------
    keeper : LensKeeper
        Keeps the lens after each photo.
    recipe : Recipe
        How each is estimated.
    begin : ModelSettings, optional
        Choices of the regression of a new lens; a known one keeps its own.
    any_lens : bool
        Take photos that seem to be of another lens as well.
    workers : int, optional
        Processes, where photos are estimated here.

    Raises
    ------
    UnknownMethodError, InvalidInputError
        If the recipe cannot be followed.
    """

    def __init__(
        self,
        keeper: LensKeeper,
        recipe: Recipe,
        *,
        begin: ModelSettings | None = None,
        any_lens: bool = False,
        workers: int | None = None,
    ) -> None:
        self._keeper, self._recipe = keeper, recipe
        self._begin = begin or ModelSettings(mode=recipe.way.mode)
        self._any_lens, self._workers = any_lens, workers
        self._current = keeper.lens()
        recipe.of_lens(self._current).check()

    def learn(
        self,
        paths: Iterable[Path],
        executor: Executor | None = None,
        *,
        ahead: int = AHEAD,
        on_event: EventHook = ignore_event,
    ) -> Iterator[PhotoVerdict]:
        """Learn from photos in their order, and give what becomes of each.

        Parameters
        ----------
        paths : iterable of Path
        executor : Executor, optional
            Runs whole photos, whose bytes are sent to it: of other machines too. Without one, processes of
            this machine share the patches of one photo after the other.
        ahead : int
            Photos that are sent at once.
        on_event : callable
            Learns of each step that is done here; raising `CancelledError` there stops the work.
        """

        def sent(path: Path) -> tuple[Any, ...] | None:
            return None if executor is None else self._order(path)

        jobs = parallel.in_order(
            executor or parallel.Here(), samples_of_bytes, paths, sent, ahead=1 if executor is None else ahead
        )
        for path, job in jobs:
            try:
                verdict = PhotoVerdict(path, self.add(path, job, on_event=on_event))
            except CancelledError:  # is of the whole work, not of one photo
                raise
            except (LensModelError, OSError) as error:
                verdict = PhotoVerdict(path, error=error)
            yield verdict

    def add(
        self,
        path: Path,
        estimated: Future[list[PsfSample]] | None = None,
        *,
        on_event: EventHook = ignore_event,
    ) -> int | None:
        """Learn from one photo; return how many samples it gave, None where the lens has it already."""
        key = photo_id(path)
        if self._knows(key):
            return None
        identity = self._admitted(path)
        samples = (
            samples_of_photo(
                path, self._recipe.of_lens(self._lens()), workers=self._workers, on_event=on_event
            )
            if estimated is None
            else estimated.result()
        )
        if self._knows(key):  # another run has added it meanwhile
            return None
        lens = self._lens()
        self._require_same_lens(lens, identity)
        model = LensModel.fit(samples, self._begin) if lens is None else lens.model.added(samples)
        grown = Lens.grown(lens, model, {key: path.name}, [identity], any_lens=self._any_lens)
        self._keeper.keep(grown)
        self._current = grown
        return len(samples)

    @property
    def known(self) -> Lens | None:
        """The lens as it is now; None where no photo could be used."""
        return self._lens()

    def _order(self, path: Path) -> tuple[str, bytes, Recipe] | None:
        """Return what an executor needs to estimate a photo; None if there is nothing to estimate."""
        try:
            if self._knows(photo_id(path)):
                return None
            self._admitted(path)
            return path.name, path.read_bytes(), self._recipe.of_lens(self._lens())
        except (LensModelError, OSError):  # `add` says so when its turn comes
            return None

    def _lens(self) -> Lens | None:
        """Return what is known; where another run has changed it, that contains what this one kept."""
        lens = self._keeper.lens()
        self._current = lens
        return lens

    def _knows(self, key: str) -> bool:
        lens = self._lens()
        return lens is not None and (
            key in lens.profile.photos or any(sample.photo == key for sample in lens.samples)
        )

    def _admitted(self, path: Path) -> Identity:
        """Return what a photo says of lens and camera, after refusing one that cannot teach this lens."""
        if path.stem.endswith(CORRECTED):
            raise InvalidInputError(
                "it was corrected already and says nothing about the lens; give the original"
            )
        said = photo.inspect(path).metadata
        identity = Identity.of(said)
        self._require_same_lens(self._lens(), identity)
        require_aperture(said, self._recipe.settings)
        return identity

    def _require_same_lens(self, lens: Lens | None, identity: Identity) -> None:
        if lens is None or self._any_lens:
            return
        why = difference(lens.profile.lens, lens.profile.cameras, identity)
        if why is not None:
            raise InvalidInputError(
                f"{why}; give it a profile of its own, or allow it (--any-lens, any_lens=True)"
            )
