"""Opening a photo file as far as its header."""

from __future__ import annotations

import contextlib
import mmap
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Final

from lensmodel.core.errors import ImageTooLargeError
from lensmodel.photo.headers.header import Header
from lensmodel.photo.headers.ifd import Buffer
from lensmodel.photo.headers.jpeg import read_jpeg
from lensmodel.photo.headers.png import read_png
from lensmodel.photo.headers.sniffing import HEAD_BYTES, sniff
from lensmodel.photo.headers.tiff import read_raw, read_tiff
from lensmodel.photo.values import FileKind, Limits

_PARSERS: Final[Mapping[FileKind, Callable[[Buffer, Limits], Header]]] = {
    "raw": read_raw,
    "tiff": read_tiff,
    "png": read_png,
    "jpeg": read_jpeg,
}


@contextlib.contextmanager
def opened_header(path: Path, limits: Limits) -> Iterator[Header]:
    """Map a file and parse its header; the header is valid inside the `with` only."""
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
        kind = sniff(head)
        size = file.seek(0, 2)
        if size > limits.max_bytes:
            raise ImageTooLargeError(f"the file has {size} bytes; the limit is {limits.max_bytes}")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as buffer:
            yield _PARSERS[kind](buffer, limits)
