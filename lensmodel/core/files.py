"""Files that appear complete or not at all, and frozen values as JSON: how values travel without pickle."""

from __future__ import annotations

import base64
import dataclasses
import os
import secrets
import types
import typing
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError


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
    """Write an array of a plain dtype as `numpy.save` does, which forgets that a disk was full."""
    whole = np.ascontiguousarray(array)
    np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(whole))
    file.write(whole.reshape(-1).view(np.uint8).data)


# --- frozen values as JSON, by their type hints ---

T = TypeVar("T")


def to_json(value: Any) -> Any:
    """Turn dataclasses, tuples, mappings, bytes, dates and numbers into what `json` can write."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, bytes):
        return {"base64": base64.b64encode(value).decode("ascii")}
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [to_json(item) for item in value]
    raise InvalidInputError(f"a {type(value).__name__} cannot be written as JSON")


def from_json(kind: type[T], stored: Any) -> T:
    """Build a value of type `kind` from what `to_json` made; arrays given as such are kept."""
    return _build(kind, stored)


def _build(kind: Any, stored: Any) -> Any:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if kind is Any or origin is typing.Literal or isinstance(stored, np.ndarray):
        return stored
    if origin in (typing.Union, types.UnionType):
        if stored is None and type(None) in arguments:
            return None
        return _build(next(a for a in arguments if a is not type(None)), stored)
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        hints = typing.get_type_hints(kind)
        names = [f.name for f in dataclasses.fields(kind) if f.init]
        return kind(**{name: _build(hints[name], stored[name]) for name in names if name in stored})
    if origin in (tuple, list):
        same = origin is list or arguments[-1] is Ellipsis
        kinds = arguments[:1] * len(stored) if same else arguments
        return origin(_build(a, item) for a, item in zip(kinds, stored, strict=True))
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return {key: _build(arguments[1], item) for key, item in stored.items()}
    if origin is np.ndarray:
        return np.asarray(stored)
    if kind is bytes:
        return base64.b64decode(stored["base64"], validate=True)
    if kind is datetime:
        return datetime.fromisoformat(stored)
    if kind is float and stored is not None:
        return float(stored)
    return stored
