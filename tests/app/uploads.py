"""Uploads as the tables see them, without HTTP."""

from __future__ import annotations

import time
from datetime import timedelta
from typing import Any

from app.blobs.storage import Storage
from app.store import Store
from app.store.database import new_id
from app.store.photos import Received

PHOTO = b"a photo"


def receive(store: Store, public_id: str, *, owner: str = "local", sha256: str = "", **more: Any) -> Received:
    """Store an upload that was announced; its blob is named after its id."""
    plain = {"filename": "p.dng", "kind": "dng", "byte_size": len(PHOTO), "calibrate": True, "given": {}}
    named = {"sha256": sha256 or public_id, "blob_key": f"photos/{public_id}/original"}
    return store.photos.receive(owner, public_id=public_id, **{**plain, **named, **more})


def send(
    store: Store,
    storage: Storage,
    number: int,
    *,
    owner: str = "local",
    within: timedelta = timedelta(minutes=1),
    pause_s: float = 0.0,
) -> None:
    """Announce an upload, store its blob, and after a pause its row."""
    public_id = new_id()
    store.photos.expect(f"photos/{public_id}/", within=within)
    storage.put(f"photos/{public_id}/original", PHOTO)
    time.sleep(pause_s)
    receive(store, public_id, owner=owner, sha256=f"{number:064x}")
