"""Errors of the machinery rather than of a photo: recognised, and waited for until they end.

A database that restarts, an object store that is away, a full disk: none of them says anything about the
photo. So such a job is retried for hours; only then it fails, with a code of its own.
"""

from __future__ import annotations

import errno
import logging
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from obstore import exceptions as stored
from sqlalchemy import exc

log = logging.getLogger(__name__)

CODE: Final = "outage"  # error code of a job that waited in vain
_POSTGRES_FULL: Final = "53100"  # SQLSTATE disk_full (PostgreSQL documentation, appendix A)
# How the storage reports ENOSPC and EDQUOT of Linux: the disk, or the quota of its user, is full
_FULL: Final = ("os error 28", "os error 122")
_NO_ROOM: Final = frozenset({errno.ENOSPC, errno.EDQUOT})
_MACHINE: Final = _NO_ROOM | {
    *(errno.EIO, errno.EROFS, errno.ENODEV, errno.ENXIO, errno.ESTALE, errno.EBUSY),
    *(errno.ENOMEM, errno.EAGAIN, errno.EMFILE, errno.ENFILE),
    *(errno.ENETDOWN, errno.ENETUNREACH, errno.EHOSTDOWN, errno.EHOSTUNREACH),
}
# Errors of a working store; all others, including wrong credentials, can be mended while jobs wait
_OF_THE_REQUEST: Final = (
    stored.NotFoundError,
    stored.AlreadyExistsError,
    stored.InvalidPathError,
    stored.NotModifiedError,
    stored.NotSupportedError,
    stored.PreconditionError,
)


class OutageError(Exception):
    """The machinery failed: try again later."""


def is_outage(error: BaseException) -> bool:
    """Say whether an error is a fault of the machinery: the same job can succeed once it is mended."""
    if isinstance(error, exc.DBAPIError):
        code = getattr(error.orig, "sqlite_errorcode", None)
        away = isinstance(error, exc.OperationalError | exc.InterfaceError) or error.connection_invalidated
        return away and code != sqlite3.SQLITE_ERROR  # an invalid statement; all else is the machine's fault
    if isinstance(error, stored.BaseError):
        return not isinstance(error, _OF_THE_REQUEST)
    if isinstance(error, OSError):
        if error.errno is None and not isinstance(error, FileNotFoundError | PermissionError):
            return True  # how the writer of the storage reports any error
        return isinstance(error, ConnectionError | TimeoutError) or error.errno in _MACHINE
    return isinstance(error, OutageError | exc.TimeoutError | MemoryError | EOFError)


def is_no_room(error: BaseException) -> bool:
    """Say whether a disk, or the quota of its user, is full."""
    if isinstance(error, exc.DBAPIError):
        code, state = (getattr(error.orig, name, None) for name in ("sqlite_errorcode", "sqlstate"))
        return code == sqlite3.SQLITE_FULL or state == _POSTGRES_FULL
    if not isinstance(error, OSError | stored.BaseError):
        return False
    return getattr(error, "errno", None) in _NO_ROOM or any(sign in str(error) for sign in _FULL)


@contextmanager
def missable() -> Iterator[None]:
    """Ignore an outage in the block, whose effect is repeated soon or not essential."""
    try:
        yield
    except Exception as error:
        if not is_outage(error):
            raise
        log.info("left out: %s", error)
