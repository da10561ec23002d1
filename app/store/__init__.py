"""Rows and library values: the only place that opens a transaction.

All functions take and give public ids. State changes are conditional updates that say whether they
happened, so a step that runs twice, or loses a race against a cancel, changes nothing the second time.
"""

from __future__ import annotations

from app.runtime.settings import Settings
from app.store.accounts import Accounts
from app.store.database import Database
from app.store.jobs import Jobs
from app.store.lenses import Lenses, LensName
from app.store.photos import Photos

__all__ = ["LensName", "Store"]


class Store:
    """All tables of the service."""

    def __init__(self, settings: Settings) -> None:
        self.database = Database(settings.database)
        self.photos = Photos(self.database)
        self.lenses = Lenses(self.database)
        self.jobs = Jobs(self.database)
        self.accounts = Accounts(self.database)

    def close(self) -> None:
        """Close all connections."""
        self.database.close()
