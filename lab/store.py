"""Stored results: one JSON file each, whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import write_atomically

Unit: TypeAlias = dict[str, Any]
"""What one file holds: plain values."""


def stored(path: Path, make: Callable[[], Unit]) -> tuple[Unit, bool]:
    """Return the unit of a file, or make it and write it; the file appears whole or not at all.

    Returns
    -------
    unit : dict
    fresh : bool
        Whether it was made now.
    """
    if path.exists():
        return read(path), False
    unit = make()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps(unit, indent=1, allow_nan=False).encode())
    return unit, True


def read(path: Path) -> Unit:
    """Read a stored result."""
    try:
        unit: Unit = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"{path} is damaged; delete it and run again") from error
    return unit
