"""Cache of rendered pictures by tag: rendered once, however many ask at once."""

from __future__ import annotations

import threading
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

MAX_BYTES: Final = 32 << 20
"""Memory of the cache (chosen): some hundred maps of a field."""


class DrawnPicture(NamedTuple):
    """A picture as it is sent, and the headers that say how it came about."""

    data: bytes
    headers: Mapping[str, str]


class Drawn:
    """The least recently used pictures of one process.

    A tag contains the version of the lens and the whole query, so that a picture is never out of date.
    """

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self._max_bytes = max_bytes
        self._kept: OrderedDict[str, DrawnPicture] = OrderedDict()
        self._guard = threading.Lock()
        self._drawing: defaultdict[str, threading.Lock] = defaultdict(threading.Lock)

    def get(self, tag: str, draw: Callable[[], DrawnPicture]) -> DrawnPicture:
        """Return the picture of a tag; render it if it is missing, once for simultaneous calls."""
        with self._guard:
            alone = self._drawing[tag]
        with alone:
            with self._guard:
                if tag in self._kept:
                    self._kept.move_to_end(tag)
                    return self._kept[tag]
            try:
                picture = draw()
            finally:
                with self._guard:
                    self._drawing.pop(tag, None)
            with self._guard:
                self._kept[tag] = picture
                while len(self._kept) > 1 and self._size() > self._max_bytes:
                    self._kept.popitem(last=False)
            return picture

    def _size(self) -> int:
        return sum(len(picture.data) for picture in self._kept.values())
