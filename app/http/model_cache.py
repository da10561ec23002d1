"""Lens models in memory: always current, bounded.

Each request compares the lens's version in the table (one primary-key read, microseconds) with
that of the model in memory. So the very next request in every process uses a new sample, without
messages between processes and without waiting for an entry to expire.
"""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from dataclasses import dataclass, replace
from typing import Final, TypeAlias

from app.errors import ConflictError, UnknownError
from app.runtime import metrics
from app.store import Store
from app.store.lenses import LensState
from app.store.owners import ANY_OWNER
from lensmodel.core.errors import NoSamplesError
from lensmodel.core.psf import PsfSample
from lensmodel.model import LensModel

log = logging.getLogger(__name__)

# Memory of the models of one process (chosen): some hundred lenses of a hundred photos
MAX_BYTES: Final = 1 << 30
_Key: TypeAlias = tuple[str, int | None]


@dataclass(frozen=True, slots=True)
class Fitted:
    """A model and the state of its lens."""

    lens_id: str
    state: LensState
    model: LensModel


class ModelCache:
    """Least recently used models of one process."""

    def __init__(self, store: Store, max_bytes: int = MAX_BYTES) -> None:
        self._store, self._max_bytes = store, max_bytes
        self._models: OrderedDict[_Key, Fitted] = OrderedDict()
        self._guard = threading.Lock()
        self._building: dict[str, threading.Lock] = {}

    def get(self, lens_id: str, version: int | None = None, *, state: LensState | None = None) -> Fitted:
        """Return the model of a lens, current or of an earlier version."""
        # `state` is that of the lens if the caller has just read it
        state = self._store.lenses.state_of(lens_id, ANY_OWNER) if state is None else state
        if state is None:
            raise UnknownError("lens", lens_id)
        wanted = replace(state, version=state.version if version is None else version)
        if wanted != state:
            check_version(self._store, lens_id, wanted.version, state)
        key = (lens_id, None if wanted == state else version)
        fitted = self._recall(key)
        if fitted is not None and fitted.state == wanted:
            metrics.MODELS.labels("known").inc()
            return fitted
        with self._lock_of(lens_id):  # one thread fits, the others wait for its result
            fitted = self._recall(key)
            newest = wanted if wanted != state else self._store.lenses.state_of(lens_id, ANY_OWNER)
            if fitted is not None and fitted.state == newest:
                return fitted
            metrics.MODELS.labels("fitted" if fitted is None else "extended").inc()
            return self._keep(key, self._build(lens_id, fitted, key[1]))

    def _build(self, lens_id: str, old: Fitted | None, version: int | None) -> Fitted:
        lenses = self._store.lenses
        if version is not None:
            state, samples = lenses.samples_of(lens_id, up_to_version=version)
            return _fit(lens_id, replace(state, version=version), samples)
        if old is not None:
            state, samples = lenses.samples_of(lens_id, after_version=old.state.version)
            if state.rebuild_epoch == old.state.rebuild_epoch:
                return Fitted(lens_id, state, old.model.added(samples))
        return _fit(lens_id, *lenses.samples_of(lens_id))

    def _lock_of(self, lens_id: str) -> threading.Lock:
        with self._guard:
            return self._building.setdefault(lens_id, threading.Lock())

    def _recall(self, key: _Key) -> Fitted | None:
        with self._guard:
            if key in self._models:
                self._models.move_to_end(key)
            return self._models.get(key)

    def _keep(self, key: _Key, fitted: Fitted) -> Fitted:
        with self._guard:
            self._models[key] = fitted
            self._models.move_to_end(key)
            sizes = {key: fitted.model.nbytes for key, fitted in self._models.items()}
            while len(self._models) > 1 and sum(sizes.values()) > self._max_bytes:
                dropped, _ = self._models.popitem(last=False)
                del sizes[dropped]
                metrics.MODELS.labels("dropped").inc()
                log.info("model of lens %s dropped from memory", dropped[0])
            metrics.MODEL_BYTES.set(sum(sizes.values()))
        return fitted


def _fit(lens_id: str, state: LensState, samples: list[PsfSample]) -> Fitted:
    if not samples:
        raise NoSamplesError(
            f"lens {lens_id} has no samples yet (version {state.version}): "
            "upload photos taken with it and wait until they are counted"
        )
    return Fitted(lens_id, state, LensModel.fit(samples))


def check_version(store: Store, lens_id: str, version: int, state: LensState) -> None:
    """Check that the samples of an earlier version are still complete."""
    lens = store.lenses.get(lens_id, ANY_OWNER)
    later = [] if lens is None else store.lenses.history(lens, after=version)
    if version > state.version:
        raise ConflictError(f"lens {lens_id} has no version {version} yet: the newest is {state.version}")
    gone = [event.version for event in later if event.kind != "photo_added"]
    if gone:
        raise ConflictError(
            f"version {version} of lens {lens_id} is gone: version {gone[0]} removed or changed photos; "
            f"ask for version {state.version}, or leave the version out"
        )
