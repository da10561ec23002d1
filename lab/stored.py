"""Stored results, whole or not at all, and the version of the code that they depend on."""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Final, TypeAlias

import lensmodel
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import write_atomically

ROOT: Final = Path(lensmodel.__file__).parents[1]
_DATA: Final = (".npz", ".json")


def version_of(*modules: str, root: Path = ROOT) -> str:
    """Hash of the code and data behind some modules: 16 hexadecimal digits, wherever the tree lies."""
    total = hashlib.sha256()
    for path in code_of(*modules, root=root):
        total.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return total.hexdigest()[:16]


def code_of(*modules: str, root: Path = ROOT) -> list[Path]:
    """Files behind some modules, sorted: what they import anywhere, functions included, and their data."""
    left, seen = list(modules), dict[str, Path]()
    while left:
        name = left.pop()
        path = _file_of(name, root)
        if name in seen or path is None:
            continue
        seen[name] = path
        left += _imports(path, root)
    folders = {folder for path in seen.values() for folder in (path.parent, path.parent / "data")}
    beside = {path for folder in folders if folder.is_dir() for path in folder.iterdir()}
    return sorted({*seen.values(), *(path for path in beside if path.suffix in _DATA)})


def _file_of(name: str, root: Path) -> Path | None:
    base = root.joinpath(*name.split("."))
    return next((path for path in (base.with_suffix(".py"), base / "__init__.py") if path.is_file()), None)


@cache
def _imports(path: Path, root: Path) -> list[str]:
    """Names that may be modules; of a package only what is taken from it, where that is all modules."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            found += names if all(_file_of(name, root) for name in names) else [*names, node.module]
    return found


Unit: TypeAlias = dict[str, Any]  # what one file holds: plain values


def stored(path: Path, make: Callable[[], Unit]) -> Unit:
    """Return the unit of a file, or make it and write it; the file appears whole or not at all."""
    if path.exists():
        return read(path)
    unit = make()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps(unit, indent=1, allow_nan=False).encode())
    return unit


def read(path: Path) -> Unit:
    """Read a stored result."""
    try:
        unit: Unit = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"{path} is damaged; delete it and run again") from error
    return unit
