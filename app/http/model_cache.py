"""Fitted lens models in memory: always current, fitted once, bounded.

Each request compares the lens's version in the table (one primary-key read, microseconds) with
that of the model in memory. So the very next request in every process uses a new sample, without
messages between processes and without waiting for an entry to expire.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeAlias

from obstore.exceptions import BaseError

from app.blobs.storage import Storage
from app.errors import ConflictError, UnknownLensError
from app.runtime import metrics
from app.runtime.outage import is_outage
from app.schemas import PsfModel
from app.store import Store, StoredSample
from app.store.samples import Family, LensState
from app.store.versions import learned_key
from lensmodel.core.errors import InvalidInputError, NoSamplesError
from lensmodel.core.psf import PsfSample
from lensmodel.model import LensModel, ModelSettings, Prior
from lensmodel.workflow.ways import WAYS

log = logging.getLogger(__name__)

LOOK_S = 1.0
"""Seconds between two looks for the fit of a worker (chosen): each is a request to the storage."""

MAX_STORED = 1000
"""Keys of stored fits that are remembered (chosen): until they are loaded, which the next request does."""

BYTES_FACTOR = 4
"""Size of a fitted model over that of its kernels (chosen): it also holds splines of them."""


_Key: TypeAlias = tuple[str, int | str | None]
_LEANING: Final = "leaning"


@dataclass(frozen=True, slots=True)
class Fitted:
    """A model and the state of its lens.

    `learned` means that a worker has fitted it completely. Until then requests are answered by a model
    without the wavefront of the lens, which takes seconds to fit. `family` are the other copies that
    `model` leans on; `own` is then the model without them.
    """

    lens_id: str
    state: LensState
    model: LensModel
    pixel_pitch_um: float | None
    size_bytes: int
    learned: bool
    family: Family = ()
    own: LensModel | None = None

    @property
    def way(self) -> PsfModel:
        """The way of the answers; `paper` also where the service is configured so for all lenses."""
        return "paper" if self.model.settings.mode == WAYS["paper"].mode else "default"


class ModelCache:
    """Least recently used models of one process.

    Parameters
    ----------
    store : Store
        Where the samples are.
    max_bytes : int
        Estimated size at most; the model in use is kept in any case.
    storage : Storage, optional
        Where workers store fitted models.
    family : bool
        Whether lenses lean on other copies at all.
    settings : ModelSettings, optional
        Settings of models of the default way, and except for the mode of the others; must be those of the
        workers, whose fitted models cannot be used otherwise.
    """

    def __init__(
        self,
        store: Store,
        max_bytes: int,
        storage: Storage | None = None,
        *,
        family: bool = True,
        settings: ModelSettings | None = None,
    ) -> None:
        self._store, self._max_bytes, self._storage = store, max_bytes, storage
        self._family, self._settings = family, settings or ModelSettings()
        self._looked_at: dict[str, float] = {}
        self._stored: set[str] = set()
        self._looking = False
        self._models: OrderedDict[_Key, Fitted] = OrderedDict()
        self._guard = threading.Lock()
        self._building: dict[str, threading.Lock] = {}

    def get(
        self,
        lens_id: str,
        version: int | None = None,
        *,
        state: LensState | None = None,
        family: bool = True,
        relatives: Family | None = None,
    ) -> Fitted:
        """Return the model of a lens, current or of an earlier version.

        `state` and `relatives` are those of the lens if the caller has just read them. Without a version the
        model leans on the owner's other copies of the lens as they are now, unless `family` is false; the
        model of a given version rests on the photos of that lens alone, and never changes.
        """
        own = self._of_lens(lens_id, version, state)
        if not (self._family and family and version is None):
            return own
        return self._with_family(
            own, self._store.samples.family_of(lens_id) if relatives is None else relatives
        )

    def _of_lens(self, lens_id: str, version: int | None, state: LensState | None) -> Fitted:
        state = self._store.samples.state_of(lens_id) if state is None else state
        if state is None:
            raise UnknownLensError(f"there is no lens {lens_id}: GET /v1/lenses lists those there are")
        if version is not None and version != state.version:
            return self._earlier(lens_id, version, state)
        fitted = self._recall((lens_id, None))
        if fitted is not None and fitted.state == state and not self._superseded(fitted):
            metrics.MODELS.labels("known").inc()
            return fitted
        with self._lock_of(lens_id):  # one thread fits, the others wait for its result
            fitted = self._recall((lens_id, None))
            same = fitted is not None and fitted.state == self._store.samples.state_of(lens_id)
            if fitted is not None and same and not self._superseded(fitted):
                return fitted
            metrics.MODELS.labels("fitted" if fitted is None or same else "extended").inc()
            return self._keep((lens_id, None), self._build(lens_id, None if same else fitted))

    def _with_family(self, own: Fitted, family: Family) -> Fitted:
        """Let a model lean on the other copies of its lens, if there are any."""
        if not family:
            return own
        key: _Key = (own.lens_id, _LEANING)
        cached = self._recall(key)
        if cached is not None and cached.family == family and cached.own is own.model:
            return cached
        with self._lock_of(own.lens_id):
            cached = self._recall(key)
            prior = None if cached is None or cached.family != family else cached.model.prior
            if prior is None:
                others = self._store.samples.of_family(family)
                if not others:  # removed meanwhile
                    return own
                source = LensModel.fit([stored.sample for stored in others], self._settings_of(own.state))
                prior = Prior(source, name=family_name(family))
            leaning = own.model.with_prior(prior.source, name=prior.name)
            size = own.size_bytes
            if isinstance(prior.source, LensModel):
                size += BYTES_FACTOR * sum(sample.kernel.nbytes for sample in prior.source.samples)
            return self._keep(key, replace(own, model=leaning, size_bytes=size, family=family, own=own.model))

    def _superseded(self, fitted: Fitted) -> bool:
        """Whether a worker has stored its fit of these samples, as far as is known by now.

        It is looked up every `LOOK_S` in a thread of its own: no answer waits for the storage.
        """
        if fitted.learned or self._storage is None:
            return False
        key = learned_key(fitted.lens_id, fitted.state.version, fitted.state.rebuild_epoch)
        now = time.monotonic()
        with self._guard:
            if key in self._stored:
                return True
            if now - self._looked_at.get(key, -math.inf) < LOOK_S or self._looking:
                return False
            self._looked_at = {key: now, **{k: t for k, t in self._looked_at.items() if now - t < LOOK_S}}
            self._looking = True
        threading.Thread(target=self._look, args=(self._storage, key), daemon=True).start()
        return False

    def _look(self, storage: Storage, key: str) -> None:
        try:
            storage.info(key)
            self._stored = {key, *list(self._stored)[:MAX_STORED]}
        except FileNotFoundError:
            pass
        except Exception as error:
            if not is_outage(error):
                raise
            log.info("whether %s is stored is not known: %s", key, error)
        finally:
            self._looking = False

    def _build(self, lens_id: str, old: Fitted | None) -> Fitted:
        if old is not None:
            state, samples = self._store.samples.of_lens(lens_id, after_version=old.state.version)
            if (state.rebuild_epoch, state.way) == (old.state.rebuild_epoch, old.state.way):
                model = old.model.grown([stored.sample for stored in samples])
                size = old.size_bytes + _size(samples)
                return Fitted(lens_id, state, model, model.pitch_um, size, learned=False)
        state, samples = self._store.samples.of_lens(lens_id)
        return self._fit(lens_id, state, samples)

    def _earlier(self, lens_id: str, version: int, state: LensState) -> Fitted:
        check_version(self._store, lens_id, version, state)
        key = (lens_id, version)
        with self._lock_of(lens_id):
            fitted = self._recall(key)
            if fitted is not None and fitted.state.rebuild_epoch == state.rebuild_epoch:
                return fitted
            _, samples = self._store.samples.of_lens(lens_id, up_to_version=version)
            return self._keep(key, self._fit(lens_id, replace(state, version=version), samples))

    def _fit(self, lens_id: str, state: LensState, samples: Sequence[StoredSample]) -> Fitted:
        if not samples:
            raise NoSamplesError(
                f"lens {lens_id} has no samples yet (version {state.version}): "
                "upload photos taken with it and wait until they are counted"
            )
        values = [stored.sample for stored in samples]
        model = self._restored(lens_id, state, values)
        learned = model is not None
        model = model or LensModel.fit(values, self._settings_of(state))
        return Fitted(lens_id, state, model, model.pitch_um, _size(samples), learned)

    def _settings_of(self, state: LensState) -> ModelSettings:
        """Return the settings of the model of a lens, with the mode of its way unless that is the default."""
        return (
            self._settings if state.way == "default" else replace(self._settings, mode=WAYS[state.way].mode)
        )

    def _restored(self, lens_id: str, state: LensState, samples: Sequence[PsfSample]) -> LensModel | None:
        if self._storage is None:
            return None
        key = learned_key(lens_id, state.version, state.rebuild_epoch)
        self._stored = self._stored - {key}  # looked for again if it cannot be used
        try:
            stored = self._storage.get(key)
            return LensModel.restored(samples, stored, self._settings_of(state))
        except FileNotFoundError:
            return None
        except (BaseError, OSError) as error:
            if not is_outage(error):
                raise
            log.warning("model of lens %s is fitted here, the storage is away: %s", lens_id, error)
            return None
        except InvalidInputError as error:
            log.info("model of lens %s is fitted here: %s", lens_id, error)
            return None

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
            while (
                len(self._models) > 1 and sum(m.size_bytes for m in self._models.values()) > self._max_bytes
            ):
                dropped, _ = self._models.popitem(last=False)
                metrics.MODELS.labels("dropped").inc()
                log.info("model of lens %s dropped from memory", dropped[0])
            metrics.MODEL_BYTES.set(sum(m.size_bytes for m in self._models.values()))
        return fitted


def family_name(family: Family) -> str:
    """Return a phrase for the copies that a model leans on."""
    return "another copy" if len(family) == 1 else f"{len(family)} other copies"


def check_version(store: Store, lens_id: str, version: int, state: LensState) -> None:
    """Check that the samples of an earlier version are still complete."""
    lens = store.lenses.get(lens_id)
    later = [] if lens is None else store.lenses.history(lens, after=version)
    if version > state.version:
        raise ConflictError(f"lens {lens_id} has no version {version} yet: the newest is {state.version}")
    gone = [event.version for event in later if event.kind != "photo_added"]
    if gone:
        raise ConflictError(
            f"version {version} of lens {lens_id} is gone: version {gone[0]} removed or changed photos; "
            f"ask for version {state.version}, or leave the version out"
        )


def _size(samples: Sequence[StoredSample]) -> int:
    return BYTES_FACTOR * sum(stored.sample.kernel.nbytes for stored in samples)
