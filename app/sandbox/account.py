"""A separate account for processes that decode untrusted files, where a worker may change to one.

A child that was taken over by a hostile file then owns no file of the service, and may signal none of
its processes, whether or not the kernel has the measures of `app.sandbox.confine`. It reaches its
task's folder because that belongs to the group of the account; it may pass the folders above without
listing them; everything else in the data folder is closed to it.

References
----------
.. [1] Linux man-pages: credentials(7), capabilities(7), capset(2).
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import pwd
import re
import stat
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

# Special values of `LENS_TASK_USER`: the first of `USUAL` that exists; no separate account
AUTO, NONE = "auto", "none"
USUAL: Final = ("lens-task", "nobody")
THROUGH: Final = 0o710  # mode of a folder that the account may pass through but not list
# CAP_KILL, to end children, CAP_SETGID and CAP_SETUID (linux/capability.h)
_NEEDED: Final = 1 << 5 | 1 << 6 | 1 << 7
# _LINUX_CAPABILITY_VERSION_3 of linux/capability.h: two words of 32 bits for each set
_CAPABILITY_VERSION: Final = 0x20080522


@dataclass(frozen=True, slots=True)
class SystemAccount:
    """An account of the machine, by its numbers."""

    uid: int
    gid: int

    def become(self) -> None:
        """Change this process to the account, and give up all capabilities."""
        os.setgroups([])
        os.setresgid(self.gid, self.gid, self.gid)
        os.setresuid(self.uid, self.uid, self.uid)
        _give_up_capabilities()

    def lets_through(self, folder: Path) -> None:
        """Create a folder if it is missing; let the account pass through it."""
        folder.mkdir(parents=True, exist_ok=True)
        self._grant(folder, THROUGH)

    def may_change(self, folder: Path) -> None:
        """Let the account write to a folder and everything in it."""
        for path in _inside(folder):
            self._grant(path, 0o2770 if path.is_dir() else 0o660)

    def may_read(self, path: Path) -> None:
        """Let the account read a file, or a folder and everything in it."""
        for part in _inside(path):
            self._grant(part, 0o750 if part.is_dir() else 0o640)

    def _grant(self, path: Path, mode: int) -> None:
        status = path.stat()
        if status.st_uid == self.uid:  # created by a task
            return
        if status.st_gid != self.gid:
            os.chown(path, -1, self.gid)
        if stat.S_IMODE(status.st_mode) != mode:
            path.chmod(mode)

    def is_of_use(self, data: Path) -> bool:
        """Say whether children may change to it, and can then read the program and reach a data folder."""
        # Tried in a forked process: call it while this one has a single thread
        if not may_change():
            return False
        program = [*sys.path, sys.prefix, sys.base_prefix, str(Path(__file__).parents[2])]
        needed = {Path(entry): os.R_OK for entry in program if entry}
        needed |= dict.fromkeys(data.resolve().parents, os.X_OK)
        there = [(path, mode) for path, mode in needed.items() if path.exists()]
        pid = os.fork()
        if pid == 0:
            status = 1
            with contextlib.suppress(OSError):
                self.become()
                status = int(not all(os.access(path, mode) for path, mode in there))
            os._exit(status)
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


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
    for folder, folders, files in os.walk(path):
        for name in [*folders, *files]:
            inner = Path(folder, name)
            if not inner.is_symlink():
                yield inner


class _Header(ctypes.Structure):
    _fields_ = (("version", ctypes.c_uint32), ("pid", ctypes.c_int))


def _give_up_capabilities() -> None:
    """Clear all capabilities: a change of account by itself clears only the superuser's."""
    header, none = _Header(_CAPABILITY_VERSION, 0), (ctypes.c_uint32 * 6)()
    if ctypes.CDLL(None, use_errno=True).capset(ctypes.byref(header), none) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
