"""Rows and library values: the only place that opens a transaction.

All functions take and give public ids. Rows are returned detached: plain values that no longer
talk to the database. State changes are conditional updates that say whether they happened, so a
step that runs twice, or loses a race against a cancel, changes nothing the second time.
"""

from __future__ import annotations

from app.runtime.settings import Settings
from app.store.accounts import AccountStore
from app.store.corrections import CorrectionStore
from app.store.database import Database
from app.store.keys import KeyStore
from app.store.lenses import LensName, LensStore
from app.store.photos import PhotoStore
from app.store.samples import NewPatch, NewSample, PatchStore, SampleStore, StoredSample
from app.store.workers import WorkerStore

__all__ = ["LensName", "NewPatch", "NewSample", "Store", "StoredSample"]


class Store:
    """All tables of the service, one store for each subject."""

    def __init__(self, settings: Settings) -> None:
        self.database = Database(settings.database)
        self.photos = PhotoStore(self.database)
        self.patches = PatchStore(self.database)
        self.lenses = LensStore(self.database)
        self.samples = SampleStore(self.database)
        self.corrections = CorrectionStore(self.database)
        self.keys = KeyStore(self.database)
        self.accounts = AccountStore(self.database)
        self.workers = WorkerStore(self.database)

    def close(self) -> None:
        """Close all connections."""
        self.database.close()
