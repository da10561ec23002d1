"""A separate account for processes that decode untrusted files, where a worker may change to one.

A child reaches its task's folder because that belongs to the group of the account; it may pass the folders
above without listing them; everything else in the data folder is closed to it.

References
----------
.. [1] Linux man-pages: credentials(7), capabilities(7).
"""

from __future__ import annotations

import contextlib
import os
import pwd
import re
import stat
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

# Special values of `LENS_TASK_USER`: the first of `USUAL` that exists; no separate account
AUTO, NONE = "auto", "none"
USUAL: Final = ("lens-task", "nobody")
THROUGH: Final = 0o710  # mode of a folder that the account may pass through but not list
# CAP_KILL, to end children, CAP_SETGID and CAP_SETUID (linux/capability.h)
_NEEDED: Final = 1 << 5 | 1 << 6 | 1 << 7


@dataclass(frozen=True, slots=True)
class SystemAccount:
    """An account of the machine, by its numbers."""

    uid: int
    gid: int

    def lets_through(self, folder: Path) -> None:
        """Create a folder if it is missing; let the account pass through it."""
        folder.mkdir(parents=True, exist_ok=True)
        self._grant([folder], THROUGH, 0)

    def may_change(self, folder: Path) -> None:
        """Let the account write to a folder and everything in it."""
        self._grant(_inside(folder), 0o2770, 0o660)

    def may_read(self, path: Path) -> None:
        """Let the account read a file, or a folder and everything in it."""
        self._grant(_inside(path), 0o750, 0o640)

    def _grant(self, paths: Iterable[Path], of_folders: int, of_files: int) -> None:
        for path in paths:
            status = path.stat()
            if status.st_uid == self.uid:  # created by a task
                continue
            if status.st_gid != self.gid:
                os.chown(path, -1, self.gid)
            mode = of_folders if stat.S_ISDIR(status.st_mode) else of_files
            if stat.S_IMODE(status.st_mode) != mode:
                path.chmod(mode)


def may_change() -> bool:
    """Say whether this process may change to other accounts, and end their processes."""
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
    except OSError:
        return False
    effective = re.search(r"^CapEff:\s*(\w+)", status, re.MULTILINE)
    return effective is not None and int(effective[1], 16) & _NEEDED == _NEEDED


def find(name: str) -> SystemAccount | None:
    """Return an account by its name, or the usual one; None if there is none, or with `NONE`."""
    if name == NONE:
        return None
    for candidate in USUAL if name == AUTO else (name,):
        with contextlib.suppress(KeyError):
            entry = pwd.getpwnam(candidate)
            if entry.pw_uid == 0:
                raise ValueError(f"{candidate} is the superuser's account, which children must not have")
            return SystemAccount(entry.pw_uid, entry.pw_gid)
    if name == AUTO:
        return None
    raise ValueError(f"no account of this machine is called {name!r}")


def close_to_others(data: Path, open_folders: set[str]) -> None:
    """Close everything in a data folder to other accounts, except the folders of these names."""
    for path in data.iterdir():
        mode = stat.S_IMODE(path.lstat().st_mode)
        if path.name not in open_folders and not path.is_symlink() and mode & 0o077:
            path.chmod(mode & 0o700)


def _inside(path: Path) -> Iterator[Path]:
    """Yield a file or folder and everything below it, except symbolic links."""
    yield path
    yield from (inner for inner in below(path) if not inner.is_symlink())


def below(folder: Path, on_error: Callable[[OSError], object] | None = None) -> Iterator[Path]:
    """Yield everything below a folder; links are not followed."""
    for place, folders, files in os.walk(folder, onerror=on_error):
        yield from (Path(place, name) for name in [*folders, *files])
