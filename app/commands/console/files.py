"""From the words of a command line to photos and profiles."""

from __future__ import annotations

import glob
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from app.commands.console.failure import UsageError
from lensmodel.core.errors import InvalidInputError, LensModelError
from lensmodel.model import LensProfile, load_profile
from lensmodel.photo.endings import CORRECTED, ENDINGS, RAW_ENDINGS


def photos(names: Iterable[str]) -> list[Path]:
    """Turn files, folders and patterns into a list of photos without repeats.

    Of folders and patterns, corrected photos are left out, and what is no RAW file beside a RAW file
    of the same name, which shows the same exposure again.
    """
    unique: dict[Path, None] = {}
    for name in names:
        path = Path(name).expanduser()
        if path.is_dir():
            inside = (p for p in path.iterdir() if p.suffix.lower() in ENDINGS and not p.name.startswith("."))
            matches = _sources(p for p in inside if p.is_file())
            if not matches:
                raise UsageError(
                    f"no photo in the folder {name}; give one that holds RAW, TIFF, PNG or JPEG files"
                )
        elif path.is_file():
            matches = [path]
        else:
            every = (Path(p) for p in glob.glob(str(path), recursive=True))  # noqa: PTH207 - absolute patterns too
            matches = _sources(p for p in every if p.is_file())
            if not matches:
                raise UsageError(f"no photo called {name}; check the name and the folder")
        unique.update(dict.fromkeys(matches))
    return list(unique)


def _sources(paths: Iterable[Path]) -> list[Path]:
    given = sorted(p for p in paths if not p.stem.endswith(CORRECTED))
    raw = {p.with_suffix("") for p in given if p.suffix.lower() in RAW_ENDINGS}
    return [p for p in given if p.suffix.lower() in RAW_ENDINGS or p.with_suffix("") not in raw]


def same(first: Path, second: Path) -> bool:
    """Tell whether two names are of one file."""
    return first.exists() and second.exists() and first.samefile(second)


def profile_at(path: Path) -> LensProfile:
    """Open a profile."""
    if path.is_dir():
        raise UsageError(f"{path} is a folder; give the file of a lens profile")
    if not path.exists():
        raise UsageError(
            f"no lens profile at {path}; make it with `lensmodel calibrate PHOTO... --profile {path}`"
        )
    return load_profile(path)


def refuse_existing(*paths: Path | None, force: bool) -> None:
    """Make sure, before any work, that nothing is replaced that the user did not give up."""
    for path in paths:
        if path is not None and not force and path.exists():
            raise UsageError(f"{path} is there already; --force replaces it")


@contextmanager
def as_usage() -> Iterator[None]:
    """Turn a refused value into wrong usage: nothing was begun."""
    try:
        yield
    except InvalidInputError as error:
        raise UsageError(str(error)) from error


def reason(error: Exception) -> str:
    """Say why a file could not be used; the system's errors in words."""
    if isinstance(error, OSError) and error.strerror:
        return (
            f"{error.strerror[:1].lower()}{error.strerror[1:]}; check the file, its folder and their rights"
        )
    return str(error)


def failed(error: LensModelError | OSError) -> dict[str, Any]:
    """Say in a command's document that a photo could not be used, and why."""
    code = error.code if isinstance(error, LensModelError) else "unreadable"
    return {"state": "failed", "code": code, "reason": reason(error)}
