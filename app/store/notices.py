"""Notifications of changes by PostgreSQL, in place of frequent polling.

Triggers (migration 0007) notify a channel whenever a transaction that changed photos, corrections, lenses or
their history commits. A notice has no content: the listener then reads the tables, once for all that wait.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Final

from app.store.database import SERVER_DEADLINES, Database

log = logging.getLogger(__name__)

CHANNEL: Final = "lensmodel_changes"
RETRY_S: Final = 1.0
"""Seconds before a new attempt to connect, and between two looks at whether to stop (chosen): until
then changes are found by polling."""


class Notices:
    """Listens for notices in a thread of its own; SQLite has none.

    Parameters
    ----------
    database : Database
        Whose server is listened to, over a connection apart from those of transactions.
    on_change : callable
        Called in that thread after each change, and once the connection stands.
    """

    def __init__(self, database: Database, on_change: Callable[[], None]) -> None:
        self._address = "" if database.is_sqlite else _address(database)
        self._on_change = on_change
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._connected = False

    def connected(self) -> bool:
        """Whether the database announces changes at present."""
        return self._connected

    def start(self) -> None:
        """Start listening."""
        if self._address:
            self._thread = threading.Thread(target=self._run, name="notices", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Stop listening; returns once the connection is closed."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        import psycopg  # noqa: PLC0415 - only where there is such a server

        while not self._stopping.is_set():
            try:
                with psycopg.connect(self._address, autocommit=True) as connection:
                    connection.execute(f"LISTEN {CHANNEL}")
                    self._connected = True
                    self._on_change()  # something may have changed before the connection stood
                    while not self._stopping.is_set():
                        for _ in connection.notifies(timeout=RETRY_S, stop_after=1):
                            self._on_change()
            except psycopg.Error as error:
                log.info("no notices of changes, the tables are looked at instead: %s", type(error).__name__)
            finally:
                self._connected = False
            self._stopping.wait(RETRY_S)


def _address(database: Database) -> str:
    deadlines = {name: str(value) for name, value in SERVER_DEADLINES.items()}
    url = database.url.set(drivername="postgresql").update_query_dict(deadlines)
    return url.render_as_string(hide_password=False)
