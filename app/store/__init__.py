"""Rows and library values: the only place that opens a transaction.

All functions take and give public ids. Rows are returned detached: plain values that no longer
talk to the database. State changes are conditional updates that say whether they happened, so a
step that runs twice, or loses a race against a cancel, changes nothing the second time.

There are more than fifteen modules because each thing that is stored has one: folders for photos and for
lenses would separate what one transaction changes together.
"""

from __future__ import annotations

from app.runtime.settings import Settings
from app.store.access.accounts import AccountStore
from app.store.access.keys import KeyStore
from app.store.corrections import CorrectionStore
from app.store.database import Database
from app.store.lens_changes import LensChanges
from app.store.lenses import LensName, LensStore
from app.store.patches import NewSample, PatchStore
from app.store.photos import PhotoStore
from app.store.removal import RemovalStore
from app.store.samples import SampleStore, StoredSample
from app.store.upkeep.operation import OperationStore
from app.store.windows import NewPatch
from app.store.workers import WorkerStore

__all__ = ["LensName", "NewPatch", "NewSample", "Store", "StoredSample"]


class Store:
    """All tables of the service, one store for each subject."""

    def __init__(self, settings: Settings) -> None:
        self.database = Database(settings.database, synchronous=settings.sqlite_synchronous)
        self.photos = PhotoStore(self.database)
        self.patches = PatchStore(self.database)
        self.lenses = LensStore(self.database)
        self.lens_changes = LensChanges(self.database)
        self.samples = SampleStore(self.database)
        self.corrections = CorrectionStore(self.database)
        self.removal = RemovalStore(self.database)
        self.keys = KeyStore(self.database)
        self.accounts = AccountStore(self.database)
        self.workers = WorkerStore(self.database)
        self.operation = OperationStore(self.database)

    def close(self) -> None:
        """Close all connections."""
        self.database.close()
