"""Stored kernels of a growing model, shared between its versions."""

from __future__ import annotations

import threading
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

_GROWTH = 1.5  # factor by which the store grows, so that each kernel is copied twice or so on average
_ROOM = 0.06  # a model grows by a twentieth before it is fitted anew


class _Buffer:
    """Rows with room for more; who owns the end may write behind it."""

    __slots__ = ("guard", "rows", "used")

    def __init__(self, capacity: int, width: int) -> None:
        self.rows = np.empty((capacity, width), dtype=np.float32)
        self.used = 0
        self.guard = threading.Lock()


class KernelStore:
    """Rows of float32 that can be extended without copying those there are.

    Stores share one buffer as long as only the newest is extended; extending an older one copies.
    A row once visible is never written again.
    """

    def __init__(self, width: int) -> None:
        self._buffer = _Buffer(8, width)
        self._count = 0

    @property
    def rows(self) -> NDArray[np.float32]:
        """The rows, shape (n, width), a view."""
        return self._buffer.rows[: self._count]

    def extended(self, rows: Iterable[NDArray[np.float32]], count: int) -> KernelStore:
        """Return a store with `count` more rows."""
        grown = KernelStore.__new__(KernelStore)
        total = self._count + count
        buffer = self._buffer
        with buffer.guard:
            fits = buffer.used == self._count and total <= buffer.rows.shape[0]
            if fits:
                buffer.used = total
        if not fits:
            spare = max(int(self._count * (_GROWTH - 1.0)), int(total * _ROOM))
            buffer = _Buffer(total + spare, self._buffer.rows.shape[1])
            buffer.rows[: self._count] = self.rows
            buffer.used = total
        for i, row in enumerate(rows):
            buffer.rows[self._count + i] = row
        grown._buffer, grown._count = buffer, total  # noqa: SLF001 - another value of this class
        return grown
