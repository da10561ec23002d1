"""Frozen values to JSON and back, by their type hints: how values cross processes without pickle."""

from __future__ import annotations

import base64
import dataclasses
import types
import typing
from collections.abc import Mapping
from datetime import datetime
from typing import Any, TypeVar

import numpy as np

from lensmodel.core.errors import InvalidInputError

T = TypeVar("T")


def to_json(value: Any) -> Any:
    """Turn dataclasses, tuples, mappings, bytes, dates and numbers into what `json` can write."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, bytes):
        return {"base64": base64.b64encode(value).decode("ascii")}
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, np.ndarray):
        return value.tolist()
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
