"""Erase an owner: begun at his request, completed by any process."""

from __future__ import annotations

from app.blobs.storage import Storage
from app.store.accounts import AccountStore


def erase(accounts: AccountStore, storage: Storage, owner_key: int) -> None:
    """Erase what is left of an owner, rows before blobs. If killed, a later call continues."""
    while (prefixes := accounts.erase_some(owner_key)) is not None:
        for prefix in prefixes:
            storage.delete(prefix)
