"""What PostgreSQL tells of changes by itself, so that nobody has to ask again and again.

Triggers (migration 0007) notify a channel whenever a transaction that changed photos, corrections, lenses or
their history commits. Notices carry nothing: who hears one looks at the tables, once for all that wait.
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
"""How long it waits before it connects anew, and how long it listens before it asks whether to stop."""


class Notices:
    """Listens in a thread of its own, where the database can tell; SQLite cannot.

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
        self.heard = False

    def hears(self) -> bool:
        """Whether changes are told of at present."""
        return self.heard

    def start(self) -> None:
        """Begin to listen."""
        if self._address:
            self._thread = threading.Thread(target=self._run, name="notices", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Listen no more; returns once the connection is closed."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        import psycopg  # noqa: PLC0415 - only where there is such a server

        while not self._stopping.is_set():
            try:
                with psycopg.connect(self._address, autocommit=True) as connection:
                    connection.execute(f"LISTEN {CHANNEL}")
                    self.heard = True
                    self._on_change()  # what happened while nobody listened
                    while not self._stopping.is_set():
                        for _ in connection.notifies(timeout=RETRY_S, stop_after=1):
                            self._on_change()
            except psycopg.Error as error:
                log.info("no notices of changes, the tables are looked at instead: %s", type(error).__name__)
            finally:
                self.heard = False
            self._stopping.wait(RETRY_S)


def _address(database: Database) -> str:
    deadlines = {name: str(value) for name, value in SERVER_DEADLINES.items()}
    url = database.url.set(drivername="postgresql").update_query_dict(deadlines)
    return url.render_as_string(hide_password=False)
