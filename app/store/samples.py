"""Samples as the model reads them: library values, in the order in which they joined."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

from sqlalchemy import Row, and_, bindparam, select
from sqlalchemy.orm import aliased

from app.store.access.owners import is_id
from app.store.database import Database
from app.store.sample_rows import COLUMNS, sample_in
from app.store.tables import LensRow, OwnerRow, PhotoRow, SampleRow
from lensmodel.core.psf import PsfSample

_STATE = select(LensRow.version, LensRow.rebuild_epoch, LensRow.answering_way).where(
    LensRow.public_id == bindparam("lens"), LensRow.deleted_at.is_(None)
)
_ME, _OTHER = aliased(LensRow), aliased(LensRow)
_RELATIVES = (
    _OTHER.public_id,
    _OTHER.version,
    _OTHER.rebuild_epoch,
    _OTHER.sample_count,
)
_MAY_BE_RELATED = and_(
    _OTHER.owner_id == _ME.owner_id,
    _OTHER.id != _ME.id,
    _OTHER.deleted_at.is_(None),
    _OTHER.sample_count > 0,
    _OTHER.kind_key == _ME.kind_key,
    _ME.answering_way == "default",  # the paper's way uses no other copies
    _OTHER.answering_way == "default",
)
_THIS = and_(_ME.public_id == bindparam("lens"), _ME.deleted_at.is_(None))
_OTHERS = (
    select(*_RELATIVES)
    .select_from(_ME)
    .join(_OTHER, _MAY_BE_RELATED)
    .where(_THIS)
    .order_by(_OTHER.public_id.desc())
)
_KNOWN = (
    select(
        _ME.version.label("my_version"), _ME.rebuild_epoch.label("my_epoch"), _ME.answering_way, *_RELATIVES
    )
    .select_from(_ME)
    .join(OwnerRow, OwnerRow.id == _ME.owner_id)
    .outerjoin(_OTHER, _MAY_BE_RELATED)
    .where(_THIS, OwnerRow.name == bindparam("owner"))
    .order_by(_OTHER.public_id.desc())
)
MAX_FAMILY_SAMPLES: Final = 2000
"""Most samples of other copies that a model leans on (chosen): more take longer to fit."""


@dataclass(frozen=True, slots=True)
class LensState:
    """Version of a lens: shows whether a fitted model is up to date, and in which way it was learned."""

    version: int
    rebuild_epoch: int
    way: str = "default"


@dataclass(frozen=True, slots=True)
class Relative:
    """Another copy of a lens model, of the same owner, at one of its versions."""

    lens_id: str
    state: LensState

    def named(self) -> dict[str, Any]:
        """Return it as the parameters of a correction store it."""
        state = {"version": self.state.version, "rebuild_epoch": self.state.rebuild_epoch}
        return {"lens_id": self.lens_id, "state": state}


Family: TypeAlias = tuple[Relative, ...]


@dataclass(frozen=True, slots=True, eq=False)
class StoredSample:
    """A sample with its key and the version at which it joined."""

    id: int
    version_added: int
    sample: PsfSample


class SampleStore:
    """The samples that count."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def state_of(self, lens_id: str) -> LensState | None:
        """Return the version of a lens by one read through its key; None if there is no such lens."""
        with self._db.reader.connect() as connection:
            row = connection.execute(_STATE, {"lens": lens_id}).one_or_none()
            return None if row is None else LensState(row[0], row[1], row[2])

    def family_of(self, lens_id: str) -> Family:
        """Return the other copies of a lens: same owner, maker and model, with samples that count.

        The newest first, as many as are needed for `MAX_FAMILY_SAMPLES` samples.
        """
        with self._db.reader.connect() as connection:
            return _family(connection.execute(_OTHERS, {"lens": lens_id}).all())

    def known_of(self, lens_id: str, owner: str) -> tuple[LensState, Family] | None:
        """Return `state_of` and `family_of` by one read; None if the owner has no such lens."""
        if not is_id(lens_id):
            return None
        with (
            self._db.reader.connect() as connection
        ):  # no session, which costs time: part of every request that a cached model answers
            rows = connection.execute(_KNOWN, {"lens": lens_id, "owner": owner}).all()
        if not rows:
            return None
        state = LensState(rows[0].my_version, rows[0].my_epoch, rows[0].answering_way)
        return state, _family([row for row in rows if row.public_id is not None])

    def of_family(self, family: Iterable[Relative]) -> list[StoredSample]:
        """Return the samples of other copies at the given versions, without those removed since."""
        return [
            stored
            for relative in family
            for stored in self.of_lens(relative.lens_id, up_to_version=relative.state.version)[1]
        ]

    def of_lens(
        self, lens_id: str, *, after_version: int = 0, up_to_version: int | None = None
    ) -> tuple[LensState, list[StoredSample]]:
        """Return the state of a lens and its samples that joined after a version.

        Both are of one moment. Versions grow under the lens's row lock, so no sample of a
        version that was seen can turn up later.
        """
        query = (
            select(SampleRow.id, SampleRow.version_added, *COLUMNS)
            .join(PhotoRow, PhotoRow.id == SampleRow.photo_id)
            .join(LensRow, LensRow.id == SampleRow.lens_id)
            .where(LensRow.public_id == lens_id, SampleRow.version_added > after_version)
            .order_by(SampleRow.version_added, SampleRow.id)
        )
        if up_to_version is not None:
            query = query.where(SampleRow.version_added <= up_to_version)
        with self._db.reading() as session:
            state = session.execute(
                select(LensRow.version, LensRow.rebuild_epoch, LensRow.answering_way).where(
                    LensRow.public_id == lens_id
                )
            ).one_or_none()
            if state is None:
                return LensState(0, 0), []
            stored = [
                StoredSample(row.id, row.version_added, sample_in(row)) for row in session.execute(query)
            ]
            return LensState(state[0], state[1], state[2]), stored


def _family(rows: Iterable[Row[*tuple[Any, ...]]]) -> Family:
    """Return the first relatives that together have `MAX_FAMILY_SAMPLES` samples."""
    relatives: list[Relative] = []
    samples = 0
    for row in rows:
        if samples < MAX_FAMILY_SAMPLES:
            relatives.append(Relative(row.public_id, LensState(row.version, row.rebuild_epoch)))
            samples += row.sample_count
    return tuple(relatives)
