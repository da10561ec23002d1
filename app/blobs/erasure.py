"""All of an owner goes: begun by his word, ended by whoever comes to it first."""

from __future__ import annotations

from app.blobs.storage import Storage
from app.store.access.accounts import AccountStore


def erase(accounts: AccountStore, storage: Storage, owner_key: int) -> None:
    """Erase what is left of an owner, rows before blobs. Killed in between, it goes on where it was."""
    while (prefixes := accounts.erase_some(owner_key)) is not None:
        for prefix in prefixes:
            storage.delete(prefix)
