"""Connections: who may write, who only reads, and what a transaction means on each database.

On SQLite every writing transaction begins with BEGIN IMMEDIATE, else two that read, add one and write would
lose updates silently. Readers see a consistent snapshot (WAL) and cannot write at all. What a request reads
is of one session (`scope`).
"""

from __future__ import annotations

import secrets
import sqlite3
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, Final, ParamSpec, TypeAlias, TypeVar, cast

from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from alembic.util import CommandError
from sqlalchemy import (
    Connection,
    CursorResult,
    Engine,
    Executable,
    Select,
    create_engine,
    event,
    make_url,
    text,
)
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

import migrations
from app.store.tables import Base
from lensmodel.core.errors import InvalidInputError

# How long a transaction of SQLite waits for the one writer (chosen): transactions take milliseconds, on a
# slow disk seconds
BUSY_TIMEOUT_MS = 30_000
# Settings of libpq in seconds, `tcp_user_timeout` in ms (chosen). When the network is cut no connection is
# ever closed: without these a worker waits for a quarter of an hour, longer than any lease.
SERVER_DEADLINES: Final = {
    "connect_timeout": 5,
    "tcp_user_timeout": 15_000,
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    # the server's end, too: else what a transaction has locked stays locked for hours
    "options": "-c tcp_user_timeout=15000 -c tcp_keepalives_idle=10 -c tcp_keepalives_interval=5 "
    "-c tcp_keepalives_count=3 -c idle_in_transaction_session_timeout=600000",
}

_LOCK: Final = 0x1E45  # of migrations: any number that only this program uses


class Database:
    """The application database of one process."""

    def __init__(self, url: str) -> None:
        self.url = make_url(url)
        self.is_sqlite = self.url.get_backend_name() == "sqlite"
        if self.is_sqlite:
            self.path = Path(self.url.database or "")
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.writer = _sqlite(url, "BEGIN IMMEDIATE")
            self.reader = _sqlite(url, "BEGIN", read_only=True)
        else:
            self.writer = create_engine(
                url, pool_pre_ping=True, hide_parameters=True, connect_args=SERVER_DEADLINES
            )
            # one snapshot for each reading transaction, as on SQLite: what is read together is of one moment
            self.reader = self.writer.execution_options(
                postgresql_readonly=True, isolation_level="REPEATABLE READ"
            )

    @contextmanager
    def scope(self) -> Iterator[None]:
        """Let all that is read in the block be read in one session: that of a request."""
        with Session(self.reader, expire_on_commit=False) as session:
            token = _SCOPE.set(session)
            try:
                yield
            finally:
                _SCOPE.reset(token)

    def _in_scope(self) -> Session | None:
        session = _SCOPE.get()
        return session if session is not None and session.bind is self.reader else None

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """Give the session of the request, or one of its own, which sees one state and cannot change it."""
        session = self._in_scope()
        if session is not None:
            yield session
            return
        with Session(self.reader, expire_on_commit=False) as session, session.begin():
            yield session

    @contextmanager
    def writing(self) -> Iterator[Session]:
        """Give a session whose changes are committed together at the end, or not at all."""
        with Session(self.writer, expire_on_commit=False) as session, session.begin():
            yield session
        reads = self._in_scope()
        if reads is not None:
            reads.close()  # what the request reads next is of after the change

    def close(self) -> None:
        """Close all connections."""
        for engine in (self.writer, self.reader):
            engine.dispose()


_SCOPE: ContextVar[Session | None] = ContextVar("scope", default=None)

P = ParamSpec("P")
T = TypeVar("T")
R = TypeVar("R", bound="Repository")
B = TypeVar("B", bound=Base)


class Repository:
    """Queries and changes of one subject: each a transaction, or one of the reads of a request."""

    def __init__(self, database: Database) -> None:
        self.database = database


Method: TypeAlias = Callable[Concatenate[R, Session, P], T]
Called: TypeAlias = Callable[Concatenate[R, P], T]


def _in(
    method: Method[R, P, T], session_of: Callable[[Database], AbstractContextManager[Session]]
) -> Called[R, P, T]:
    @wraps(method)
    def run(self: R, /, *args: P.args, **options: P.kwargs) -> T:
        with session_of(self.database) as session:
            return method(self, session, *args, **options)

    return run


def reads(method: Method[R, P, T]) -> Called[R, P, T]:
    """Give a method the session that reads."""
    return _in(method, Database.reading)


def writes(method: Method[R, P, T]) -> Called[R, P, T]:
    """Give a method a transaction of its own."""
    return _in(method, Database.writing)


def _sqlite(url: str, begin: str, *, read_only: bool = False) -> Engine:
    engine = create_engine(
        url,
        connect_args={"check_same_thread": False, "timeout": BUSY_TIMEOUT_MS / 1000},
        pool_size=10,
        hide_parameters=True,  # serials are personal data: none in a log
    )

    @event.listens_for(engine, "connect")
    def _connect(connection: sqlite3.Connection, record: object) -> None:
        del record
        connection.isolation_level = None  # we say BEGIN ourselves
        connection.execute(f"PRAGMA busy_timeout={BUSY_TIMEOUT_MS}")
        connection.execute("PRAGMA journal_mode=WAL")
        # what was committed survives loss of power: an upload is accepted, its memory card formatted next
        connection.execute("PRAGMA synchronous=FULL")
        connection.execute("PRAGMA foreign_keys=ON")
        if read_only:
            connection.execute("PRAGMA query_only=ON")

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        connection.exec_driver_sql(begin)

    return engine


def insert_new(session: Session, table: type[Base], rows: Sequence[dict[str, Any]]) -> None:
    """Insert the rows that break no unique key, leave the others."""
    insert = sqlite.insert if session.get_bind().dialect.name == "sqlite" else postgresql.insert
    if rows:
        session.connection().execute(insert(table).on_conflict_do_nothing(), rows)


def find_or_insert(session: Session, query: Select[B], fresh: B) -> tuple[B, bool]:
    """Return the row of a query, or insert one, of an owner who is locked; True if inserted."""
    row = session.scalar(query)
    if row is not None:
        return row, False
    session.add(fresh)
    session.flush()
    return fresh, True


def changed(session: Session, statement: Executable) -> int:
    """Execute an UPDATE or DELETE; return how many rows it changed."""
    return cast("CursorResult[Any]", session.execute(statement)).rowcount


def new_id() -> str:
    """Return 32 hexadecimal digits: 12 of the time in ms, 20 at random, so that later ids sort later."""
    return f"{time.time_ns() // 1_000_000:012x}{secrets.token_hex(10)}"


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


def upgrade(database: Database) -> None:
    """Run the missing steps, one process at a time."""
    if current(database) == head():
        return
    with database.writer.connect() as connection, connection.begin():
        if not database.is_sqlite:  # on SQLite BEGIN IMMEDIATE shuts the others out
            connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _LOCK})
        if MigrationContext.configure(connection).get_current_revision() is None:
            Base.metadata.create_all(connection)
            command.stamp(_config(connection), "head")
        try:
            command.upgrade(_config(connection), "head")
        except CommandError as error:
            why = f"the database was made by a newer program ({error}): update lensmodel, or use other data"
            raise InvalidInputError(why) from error


def check(database: Database) -> None:
    """Make sure that a database has the schema of this program."""
    present, wanted = current(database), head()
    if present != wanted:
        raise InvalidInputError(
            f"{database.url.render_as_string()} has schema {present}, this program needs {wanted}: "
            "start the service of this version on it once"
        )
