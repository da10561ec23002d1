"""Copy all rows of a database into an empty one: from SQLite to a server, into a backup and out of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

from sqlalchemy import JSON, Connection, MetaData, Table, func, insert, select, text

from app.store.database import Database
from app.store.tables import Base, WorkerRow
from app.store.upkeep import migrate
from lensmodel.core.errors import InvalidInputError

AT_ONCE: Final = 200
"""Rows in one statement (chosen): with kernels they are some megabytes."""

_OF_PROCESSES: Final = {WorkerRow.__tablename__}
"""Tables of running processes, which are not copied."""


@contextmanager
def snapshot(database: Database) -> Iterator[Connection]:
    """Give a connection that sees one moment of all tables, while others go on to write."""
    with database.reader.begin() as connection:
        yield connection


def copy(source: Connection, target: Database) -> dict[str, int]:
    """Copy every row of a snapshot into an empty database of the same schema; return how many by table.

    One transaction: all or nothing.
    """
    copied = {}
    with target.writer.begin() as connection:
        for table in _tables():
            if connection.execute(select(func.count()).select_from(table)).scalar_one():
                raise InvalidInputError(
                    f"{target.url.render_as_string()} has rows in table {table.name}: give an empty database"
                )
        for table in _tables():
            copied[table.name] = 0 if table.name in _OF_PROCESSES else _copy(source, connection, table)
            _count_on(connection, table)
    return copied


def counts(source: Connection) -> dict[str, int]:
    """Return the number of rows by table."""
    return {
        table.name: int(source.execute(select(func.count()).select_from(table)).scalar_one())
        for table in _tables()
        if table.name not in _OF_PROCESSES
    }


def check_schema(database: Database) -> None:
    """Make sure that a database has the schema of this program."""
    present, wanted = migrate.current(database), migrate.head()
    if present != wanted:
        raise InvalidInputError(
            f"{database.url.render_as_string()} has schema {present}, this program needs {wanted}: "
            "start the service of this version on it once"
        )


def _tables() -> list[Table]:
    """Return all tables, referenced ones first; NULL in a JSON column does not become a JSON null."""
    copies = MetaData()
    for table in Base.metadata.sorted_tables:
        for column in table.to_metadata(copies).columns:
            if isinstance(column.type, JSON):
                column.type = JSON(none_as_null=True)
    return list(copies.sorted_tables)


def _copy(source: Connection, target: Connection, table: Table) -> int:
    # in the order of the keys: rows refer to earlier ones of their own table, if at all
    rows = source.execution_options(yield_per=AT_ONCE).execute(
        select(table).order_by(*table.primary_key.columns)
    )
    number = 0
    for page in rows.mappings().partitions(AT_ONCE):
        values: list[dict[str, Any]] = [dict(row) for row in page]
        target.execute(insert(table), values)
        number += len(values)
    return number


def _count_on(connection: Connection, table: Table) -> None:
    """Set a server's sequence to continue after the keys that were copied."""
    key, *more = table.primary_key.columns
    if connection.dialect.name != "postgresql" or more:
        return
    named = connection.execute(
        text("SELECT pg_get_serial_sequence(:table, :column)"), {"table": table.name, "column": key.name}
    ).scalar()
    if named is not None:
        last = connection.execute(select(func.max(key))).scalar()
        if last is not None:
            connection.execute(text("SELECT setval(:sequence, :last)"), {"sequence": named, "last": last})
