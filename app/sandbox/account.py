"""Another account for what decodes the files of strangers, where a worker may change to one.

A child that a hostile file took over then owns no file of the service, and may signal none of its
processes, whether or not the kernel has the measures of `app.sandbox.confine`. It reaches its task's
folder because that belongs to a group of the account; the folders above let it through and show it
nothing; all else in the data folder is closed to it.

References
----------
.. [1] Linux man-pages: credentials(7), capabilities(7), capset(2).
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import pwd
import stat
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

AUTO, NONE = "auto", "none"
"""What `LENS_TASK_USER` may be besides a name: the first of `USUAL` that there is; and no other account."""

USUAL: Final = ("lens-task", "nobody")
THROUGH: Final = 0o710
"""Mode of a folder that the account may pass, if it knows what lies there, and not list."""

_NEEDED: Final = 1 << 5 | 1 << 6 | 1 << 7
"""CAP_KILL, for a child must be ended, CAP_SETGID, CAP_SETUID."""

_CAPABILITY_VERSION: Final = 0x20080522


@dataclass(frozen=True, slots=True)
class Account:
    """An account of the machine, by its numbers."""

    uid: int
    gid: int

    def become(self) -> None:
        """Change this process to the account; nothing of what it might do before is left to it.

        Raises
        ------
        OSError
            If it may not.
        """
        os.setgroups([])
        os.setresgid(self.gid, self.gid, self.gid)
        os.setresuid(self.uid, self.uid, self.uid)
        _give_up_capabilities()

    def lets_through(self, folder: Path) -> None:
        """Make a folder if it is not there; let the account pass it."""
        folder.mkdir(parents=True, exist_ok=True)
        self._grant(folder, THROUGH)

    def may_change(self, folder: Path) -> None:
        """Give the account a folder to write to, with all in it."""
        for path in _inside(folder):
            self._grant(path, 0o2770 if path.is_dir() else 0o660)

    def may_read(self, path: Path) -> None:
        """Let the account read a file, or a folder with all in it."""
        for part in _inside(path):
            self._grant(part, 0o750 if part.is_dir() else 0o640)

    def _grant(self, path: Path, mode: int) -> None:
        found = path.stat()
        if found.st_uid == self.uid:  # made by a task
            return
        if found.st_gid != self.gid:
            os.chown(path, -1, self.gid)
        if stat.S_IMODE(found.st_mode) != mode:
            path.chmod(mode)

    def is_of_use(self, data: Path) -> bool:
        """Say whether children may change to it, find the program then, and reach a data folder.

        Tried in a process of its own: call it while this one has one thread.
        """
        if not may_change():
            return False
        program = [Path(entry) for entry in [*sys.path, sys.prefix, sys.base_prefix] if entry]
        there = [path for path in [*program, Path(__file__).parents[2]] if path.exists()]
        above = [path for path in data.resolve().parents if path.exists()]
        pid = os.fork()
        if pid == 0:
            status = 1
            with contextlib.suppress(OSError):
                self.become()
                reads = all(os.access(path, os.R_OK) for path in there)
                status = 0 if reads and all(os.access(path, os.X_OK) for path in above) else 1
            os._exit(status)
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def may_change() -> bool:
    """Say whether this process may change to other accounts, and end what runs under them."""
    return _effective() & _NEEDED == _NEEDED


def find(name: str) -> Account | None:
    """Return an account by its name, or the usual one; None if there is none, or none is wanted.

    Raises
    ------
    ValueError
        If a name is given that no account has, or that of the superuser.
    """
    if name == NONE:
        return None
    for candidate in USUAL if name == AUTO else (name,):
        with contextlib.suppress(KeyError):
            entry = pwd.getpwnam(candidate)
            if entry.pw_uid == 0:
                raise ValueError(f"{candidate} is the superuser's account, which children must not have")
            return Account(entry.pw_uid, entry.pw_gid)
    if name == AUTO:
        return None
    raise ValueError(f"no account of this machine is called {name!r}")


def close_to_others(data: Path, open_folders: set[str]) -> None:
    """Close what lies in a data folder to other accounts, but for the folders of these names."""
    for path in data.iterdir():
        mode = stat.S_IMODE(path.lstat().st_mode)
        if path.name not in open_folders and not path.is_symlink() and mode & 0o077:
            path.chmod(mode & 0o700)


def _inside(path: Path) -> Iterator[Path]:
    """Give a file or folder and all below it, but for symbolic links."""
    yield path
    for folder, folders, files in os.walk(path):
        for name in [*folders, *files]:
            inner = Path(folder, name)
            if not inner.is_symlink():
                yield inner


def _effective() -> int:
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1], 16) for line in lines if line.startswith("CapEff:")), 0)


class _Header(ctypes.Structure):
    _fields_ = (("version", ctypes.c_uint32), ("pid", ctypes.c_int))


def _give_up_capabilities() -> None:
    """Only the superuser loses them by the change itself."""
    header, none = _Header(_CAPABILITY_VERSION, 0), (ctypes.c_uint32 * 6)()
    if ctypes.CDLL(None, use_errno=True).capset(ctypes.byref(header), none) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
