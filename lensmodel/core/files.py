"""Files that appear complete or not at all, and say why they do not."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Name a temporary neighbour with the same ending; once written it takes the name of `path`."""
    part = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.part{path.suffix}")
    try:
        yield part
        with part.open("rb+") as file:  # not "rb": Windows flushes only what may be written
            os.fsync(file.fileno())
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


@contextmanager
def atomic(path: Path) -> Iterator[BinaryIO]:
    """Open a temporary neighbour that takes the name of `path` once it is written and on the disk."""
    with replacing(path) as part, part.open("xb+") as file:
        yield file


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file that appears complete or not at all."""
    with atomic(path) as file:
        file.write(content)


def save_array(file: BinaryIO, array: NDArray[Any]) -> None:
    """Write an array of one axis or more and a plain dtype in NumPy's own format.

    `numpy.save` writes to files by a C function and forgets why it failed: that a disk is full would pass
    for a fault of the program.
    """
    whole = np.ascontiguousarray(array)
    np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(whole))
    file.write(whole.reshape(-1).view(np.uint8).data)
