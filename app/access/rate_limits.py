"""How often somebody may ask: a bucket of requests that fills at an even rate."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from typing import Final

MOST: Final = 10_000
"""Buckets that are kept; the one used least recently goes first, and would have been full by then."""


class Rates:
    """The buckets of one process, one for each name.

    Parameters
    ----------
    per_minute : int
        Requests that come back to each bucket in a minute, and that it holds for ten seconds of haste: a
        sixth of them. 0 = no limit.
    """

    def __init__(self, per_minute: int) -> None:
        self._rate = per_minute / 60.0
        self._size = max(per_minute / 6.0, 1.0)
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._guard = threading.Lock()

    def wait_of(self, name: str) -> float:
        """Take one request out of a bucket; return 0, or the seconds until there is one where it is empty."""
        if self._rate <= 0:
            return 0.0
        now = time.monotonic()
        with self._guard:
            left, since = self._left.pop(name, (self._size, now))
            left = min(left + (now - since) * self._rate, self._size)
            allowed = left >= 1.0
            self._left[name] = (left - 1.0 if allowed else left, now)
            if len(self._left) > MOST:
                self._left.popitem(last=False)
        return 0.0 if allowed else (1.0 - left) / self._rate
