"""Changes of a whole lens by its owner: rename it, merge it into another, go back to an earlier version."""

from __future__ import annotations

from sqlalchemy import select

from app.store.access.owners import ensure_owner, find_to_change
from app.store.database import Database
from app.store.lens_ways import choose_way, photos_of
from app.store.lenses import LensName, named
from app.store.removal import forget
from app.store.sample_moves import move_photo, switch
from app.store.tables import EventRow, LensRow, PhotoRow

LEARNING = ("received", "inspecting", "developing", "selecting", "estimating")


class LensChanges:
    """Changes of lenses of one owner at a time."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def create(self, owner: str, label: str) -> str:
        """Create a lens of that name; return its id."""
        with self._db.writing() as session:
            name = LensName(None, None, None, label=label)
            return named(session, ensure_owner(session, owner), name).public_id

    def rename(self, lens_id: str, owner: str, label: str | None) -> bool:
        """Set or remove the name that an owner gives a lens; False if there is no such lens."""
        with self._db.writing() as session:
            lens = find_to_change(session, LensRow, lens_id, owner)
            if lens is None:
                return False
            lens.label = label
            return True

    def choose_way(self, lens_id: str, owner: str, way: str) -> int | None:
        """Learn a lens in another way from now on, also from its earlier photos; see `app.store.lens_ways`.

        Returns how many of these prevent it because their files are gone; None if there is no such lens.
        """
        with self._db.writing(durable=True) as session:
            lens = find_to_change(session, LensRow, lens_id, owner)
            return None if lens is None else choose_way(session, lens, way)

    def merge(self, lens_id: str, into: str, owner: str) -> bool:
        """Give all photos of a lens to another one and forget it: they were one copy all along.

        False if one of the two does not exist, photos of the first are still being learned from, or the two
        are not learned in the same way.
        """
        with self._db.writing() as session:
            # always locked in the same order: two merges at once must not wait for each other
            rows = {key: find_to_change(session, LensRow, key, owner) for key in sorted((lens_id, into))}
            lens, target = rows[lens_id], rows[into]
            if lens is None or target is None or lens.id == target.id:
                return False
            if len({lens.way, lens.answering_way, target.way, target.answering_way}) > 1:
                return False
            photos = photos_of(session, lens)
            if any(photo.state in LEARNING for photo in photos):
                return False
            for photo in photos:
                move_photo(session, photo, target)
            target.complete(lens.maker, lens.model)
            session.flush()
            forget(session, lens)
            return True

    def go_back(self, lens_id: str, owner: str, version: int) -> int | None:
        """Exclude the photos that joined a lens after a version; return how many, None without a lens.

        They stay, and can be included again one by one. None as well while the lens changes its way.
        """
        with self._db.writing() as session:
            lens = find_to_change(session, LensRow, lens_id, owner)
            if lens is None or lens.way != lens.answering_way:
                return None
            events = session.scalars(
                select(EventRow).where(EventRow.lens_id == lens.id).order_by(EventRow.version)
            )
            joined: dict[str, int] = {}
            for event in events:
                if event.photo_public_id is not None and event.kind in {"photo_added", "photo_included"}:
                    joined[event.photo_public_id] = event.version
            later = [key for key, at in joined.items() if at > version]
            photos = session.scalars(
                select(PhotoRow).where(PhotoRow.public_id.in_(later), PhotoRow.lens_id == lens.id)
            )
            return sum(switch(session, photo, "excluded") for photo in photos)
