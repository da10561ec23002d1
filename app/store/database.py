"""Connections: who may write, who only reads, and what a transaction means on each database.

By default the SQLite driver opens a transaction at the first write, so that two processes
which read, add one and write lose updates silently. Here every writing transaction
begins with BEGIN IMMEDIATE: one writer at a time, waiting rather than failing. Readers see a
consistent snapshot (WAL) and cannot write at all. What a request reads is of one session (`scope`).
"""

from __future__ import annotations

import secrets
import sqlite3
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from functools import partial, wraps
from pathlib import Path
from typing import Any, Concatenate, Final, ParamSpec, TypeAlias, TypeVar, cast

from sqlalchemy import Connection, CursorResult, Engine, Executable, Select, create_engine, event, make_url
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from app.errors import BusyError
from app.store.tables import Base

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
    "-c tcp_keepalives_count=3",
}


# How often to look again for a row of the same key (chosen: 80 simultaneous uploads and deletions of the same
# bytes on PostgreSQL all end)
TRIES: Final = 100


class Database:
    """The application database of one process."""

    def __init__(self, url: str) -> None:
        self.url = make_url(url)
        self.is_sqlite = self.url.get_backend_name() == "sqlite"
        if self.is_sqlite:
            self.path = Path(self.url.database or "")
            self.path.parent.mkdir(parents=True, exist_ok=True)
            # NORMAL never corrupts, but can lose the last commits when the power fails; each commit of FULL
            # waits for the disk, which would delay leases where that is slow
            self.writer = _sqlite(url, "BEGIN IMMEDIATE", "NORMAL")
            self.durable = _sqlite(url, "BEGIN IMMEDIATE", "FULL")
            self.reader = _sqlite(url, "BEGIN", "NORMAL", read_only=True)
        else:
            self.writer = self.durable = create_engine(
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
    def writing(self, *, durable: bool = False) -> Iterator[Session]:
        """Give a session whose changes are committed together at the end, or not at all."""
        # `durable` also survives loss of power: for what a caller may rely on afterwards, such as an accepted
        # upload whose memory card is formatted next
        engine = self.durable if durable else self.writer
        with Session(engine, expire_on_commit=False) as session, session.begin():
            yield session
        reads = self._in_scope()
        if reads is not None:
            reads.close()  # what the request reads next is of after the change

    def close(self) -> None:
        """Close all connections."""
        for engine in (self.writer, self.durable, self.reader):
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


def writes_durably(method: Method[R, P, T]) -> Called[R, P, T]:
    """Give a method a transaction of its own that survives loss of power once it has returned."""
    return _in(method, partial(Database.writing, durable=True))


def _sqlite(url: str, begin: str, synchronous: str, *, read_only: bool = False) -> Engine:
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
        connection.execute(f"PRAGMA synchronous={synchronous}")
        connection.execute("PRAGMA foreign_keys=ON")
        if read_only:
            connection.execute("PRAGMA query_only=ON")

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        connection.exec_driver_sql(begin)

    return engine


def insert_new(session: Session, table: type[Base], rows: Sequence[dict[str, Any]]) -> int:
    """Insert the rows that break no unique key, leave the others; return how many went in."""
    session.flush()
    dialect = session.get_bind().dialect.name
    insert = sqlite.insert if dialect == "sqlite" else postgresql.insert
    # RETURNING shows on both databases what went in; on PostgreSQL the row count does not
    statement = insert(table).on_conflict_do_nothing().returning(table.__mapper__.primary_key[0])
    connection, inserted = session.connection(), 0
    for row in rows:  # values given here, not in the statement, which else is made anew for each row
        inserted += len(connection.execute(statement, row).all())
    return inserted


def insert_or_find(
    session: Session, table: type[B], fresh: dict[str, Any], query: Select[B], what: str
) -> tuple[B, bool]:
    """Insert a row, or find the one of the same unique key by a query; True if inserted."""
    # On PostgreSQL another transaction may delete that one after it blocked our insert and before our select
    for _ in range(TRIES):
        created = insert_new(session, table, [fresh]) == 1
        row = session.scalar(query)
        if row is not None:
            return row, created
    raise BusyError(f"{TRIES} times the {what} came and went: send it again")


def changed(session: Session, statement: Executable) -> int:
    """Execute an UPDATE or DELETE; return how many rows it changed."""
    return cast("CursorResult[Any]", session.execute(statement)).rowcount


def new_id() -> str:
    """Return 32 hexadecimal digits: 12 of the time in ms, 20 at random, so that later ids sort later."""
    return f"{time.time_ns() // 1_000_000:012x}{secrets.token_hex(10)}"
