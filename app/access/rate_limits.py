"""Rate limits by token buckets: each refills at an even rate."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from typing import Final

MAX_BUCKETS: Final = 10_000
"""Buckets that are kept (chosen: a few MiB, more owners than ask at once); the one used least recently is
dropped first, and is full again by then."""


class Rates:
    """The buckets of one process, one for each name.

    Parameters
    ----------
    per_minute : int
        Requests that refill each bucket in a minute; it holds those of ten seconds, a sixth of them. 0 = no
        limit.
    """

    def __init__(self, per_minute: int) -> None:
        self._rate = per_minute / 60.0
        self._size = max(per_minute / 6.0, 1.0)
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._guard = threading.Lock()

    def wait_of(self, name: str) -> float:
        """Take one request from a bucket; return 0, or the seconds until there is one if it is empty."""
        if self._rate <= 0:
            return 0.0
        now = time.monotonic()
        with self._guard:
            left, since = self._left.pop(name, (self._size, now))
            left = min(left + (now - since) * self._rate, self._size)
            allowed = left >= 1.0
            self._left[name] = (left - 1.0 if allowed else left, now)
            if len(self._left) > MAX_BUCKETS:
                self._left.popitem(last=False)
        return 0.0 if allowed else (1.0 - left) / self._rate
