"""Bring the database to the schema that this program needs."""

from __future__ import annotations

from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, text

import migrations
from app.store.database import Database
from app.store.tables import Base
from lensmodel.core.errors import InvalidInputError

_LOCK = 0x1E45  # any number that only this program uses


def _config(connection: Connection | None = None) -> Config:
    alembic = Config()
    alembic.set_main_option("script_location", str(Path(migrations.__file__).parent).replace("%", "%%"))
    alembic.attributes["connection"] = connection
    return alembic


def head() -> str | None:
    """Return the newest revision that this program knows."""
    return ScriptDirectory.from_config(_config()).get_current_head()


def current(database: Database) -> str | None:
    """Return the revision of the database; None if it is empty."""
    with database.reader.connect() as connection:
        return MigrationContext.configure(connection).get_current_revision()


def upgrade(database: Database) -> bool:
    """Run the missing steps, one process at a time; return whether there were any."""
    before = current(database)
    if before == head():
        return False
    known = {step.revision for step in ScriptDirectory.from_config(_config()).walk_revisions()}
    if before is not None and before not in known:
        raise InvalidInputError(
            f"the database was made by a newer program, schema {before}; update lensmodel, or use other data"
        )
    with database.writer.connect() as connection, connection.begin():
        if not database.is_sqlite:  # on SQLite BEGIN IMMEDIATE shuts the others out
            connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _LOCK})
        if MigrationContext.configure(connection).get_current_revision() is None:
            Base.metadata.create_all(connection)
            command.stamp(_config(connection), "head")
        command.upgrade(_config(connection), "head")
    return True


def check(database: Database) -> None:
    """Make sure that a database has the schema of this program."""
    present, wanted = current(database), head()
    if present != wanted:
        raise InvalidInputError(
            f"{database.url.render_as_string()} has schema {present}, this program needs {wanted}: "
            "start the service of this version on it once"
        )
