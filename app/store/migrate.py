"""Bring the database to the schema that this program needs."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import Script, ScriptDirectory
from sqlalchemy import Connection, text

import migrations
from app.store.database import Database
from lensmodel.core.errors import InvalidInputError

_LOCK = 0x1E45  # any number that only this program uses


def alembic_config(connection: Connection | None = None) -> Config:
    """Return Alembic's configuration for the steps in `migrations/`."""
    alembic = Config()
    alembic.set_main_option("script_location", str(Path(migrations.__file__).parent).replace("%", "%%"))
    alembic.attributes["connection"] = connection
    return alembic


def head() -> str | None:
    """Return the newest revision that this program knows."""
    return ScriptDirectory.from_config(alembic_config()).get_current_head()


def steps() -> list[Script]:
    """Return all steps, the newest first."""
    return list(ScriptDirectory.from_config(alembic_config()).walk_revisions())


def current(database: Database) -> str | None:
    """Return the revision of the database; None if it is empty."""
    with database.reader.connect() as connection:
        return MigrationContext.configure(connection).get_current_revision()


def upgrade(database: Database) -> bool:
    """Run the missing steps; return whether there were any.

    Only one process at a time gets in; the others wait and then find nothing left to do. A
    SQLite file that holds data is copied first, beside itself.
    """
    before = current(database)
    if before == head():
        return False
    if before is not None and before not in {step.revision for step in steps()}:
        raise InvalidInputError(
            f"the database was made by a newer program, schema {before}; update lensmodel, or use other data"
        )
    if database.is_sqlite and before is not None:
        _copy(database.path, before)
    with _alone(database) as connection:
        command.upgrade(alembic_config(connection), "head")
    return True


def check(database: Database) -> None:
    """Make sure that a database has the schema of this program."""
    present, wanted = current(database), head()
    if present != wanted:
        raise InvalidInputError(
            f"{database.url.render_as_string()} has schema {present}, this program needs {wanted}: "
            "start the service of this version on it once"
        )


def downgrade(database: Database, revision: str) -> None:
    """Undo steps down to `revision` ("base" = all)."""
    with _alone(database) as connection:
        command.downgrade(alembic_config(connection), revision)


@contextmanager
def _alone(database: Database) -> Iterator[Connection]:
    with database.writer.connect() as connection, _without_cascades(connection), connection.begin():
        if not database.is_sqlite:  # on SQLite BEGIN IMMEDIATE shuts the others out
            connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _LOCK})
        yield connection


@contextmanager
def _without_cascades(connection: Connection) -> Iterator[None]:
    """Let SQLite copy tables: to drop the old one of a parent would delete its children with it."""
    driver = connection.connection.driver_connection
    if not isinstance(driver, sqlite3.Connection):
        yield
        return
    driver.execute("PRAGMA foreign_keys=OFF")  # within a transaction it would do nothing
    try:
        yield
    finally:
        driver.execute("PRAGMA foreign_keys=ON")


def _copy(path: Path, revision: str) -> None:
    target = path.with_name(f"{path.name}.before-{revision}")
    with closing(sqlite3.connect(path)) as source, closing(sqlite3.connect(target)) as copy:
        source.backup(copy)
