"""Uploads as the tables see them, without HTTP."""

from __future__ import annotations

from typing import Any

from app.store import Store
from app.store.photos import Received


def receive(store: Store, public_id: str, *, owner: str = "local", sha256: str = "", **more: Any) -> Received:
    """Store an upload that was announced; its blob is named after its id."""
    plain = {"filename": "p.dng", "kind": "dng", "byte_size": 7, "calibrate": True, "given": {}}
    named = {"sha256": sha256 or public_id, "blob_key": f"photos/{public_id}/original"}
    return store.photos.receive(owner, public_id=public_id, **{**plain, **named, **more})
