"""Create the folder of the blobs if it is new, but not if it is only unmounted."""

from __future__ import annotations

from sqlalchemy.exc import OperationalError, ProgrammingError

from app.blobs.storage import Storage
from app.store import Store


def settle_folder(store: Store, storage: Storage) -> None:
    """Create the folder of the blobs if it is new; leave one that is unmounted as it is.

    It is new as long as no row names a file. A folder that is older than the mark file is recognised by
    the file of the newest photo.
    """
    if storage.is_there or storage.folder is None:
        return
    try:
        newest = store.photos.newest_file()
    except (OperationalError, ProgrammingError):
        return  # the tables are missing or away: nothing is decided, and /readyz says so
    if newest is None or (storage.folder / newest).is_file():
        storage.create()
