"""Confine a process by means of the kernel: files, network, other programs, other processes.

A child decodes untrusted files. Should one of them take it over, there must be little to gain: no
secret in its environment, no files but those of its task, no network, no program to start. Each
measure is enforced by the kernel and cannot be undone by the process. Only the change to another
account needs privileges; which other measures exist depends on the kernel and on what a container
allows, so each reports whether it is in force, and the service shows it under `/readyz`.

References
----------
.. [1] Linux man-pages: landlock(7), seccomp(2), unshare(2), prctl(2), user_namespaces(7).
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

from app.sandbox import account as accounts
from app.sandbox import seccomp
from app.sandbox.account import SystemAccount

# `account`: a separate one; `namespaces`: a network without interfaces and a separate count of processes;
# `files`: Landlock; `system_calls`: seccomp
MEASURES: Final = ("account", "no_new_privs", "namespaces", "files", "system_calls")
MAX_PROCESSES: Final = 128  # threads of one task at most (chosen): far more than a correction starts
# linux/prctl.h, linux/sched.h
_PR_SET_DUMPABLE: Final = 4
_PR_SET_NO_NEW_PRIVS: Final = 38
_CLONE_NEWUSER, _CLONE_NEWNET, _CLONE_NEWIPC = 0x10000000, 0x40000000, 0x08000000

# linux/landlock.h; `_HANDLED`: the file rights that each version of Landlock added
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_READ: Final = 1 << 2 | 1 << 3  # READ_FILE, READ_DIR
_FILE_RIGHTS: Final = 1 << 0 | 1 << 1 | 1 << 2 | 1 << 14  # EXECUTE, WRITE_FILE, READ_FILE, TRUNCATE
_HANDLED: Final = {1: (1 << 13) - 1, 2: 1 << 13, 3: 1 << 14, 5: 1 << 15}
_EXECUTE: Final = 1 << 0
_NETWORK_SINCE, _SCOPE_SINCE = 4, 6  # Linux 6.7 and 6.12
_TCP: Final = 1 << 0 | 1 << 1  # bind, connect
_SCOPES: Final = 1 << 0 | 1 << 1  # abstract sockets, signals
_VERSION: Final = 1 << 0
_PATH_BENEATH: Final = 1

_DEVICES: Final = ("/dev/null", "/dev/zero", "/dev/urandom", "/dev/random")
_MACHINE: Final = ("/usr", "/lib", "/lib64", "/etc/ld.so.cache", "/etc/localtime", "/sys/devices/system/cpu")
# The loader, the libraries, and files from which numerical libraries learn about the machine
_PROC: Final = ("/proc/self", "/proc/cpuinfo", "/proc/meminfo")
_libc = ctypes.CDLL(None, use_errno=True)


class _Ruleset(ctypes.Structure):
    _fields_ = (("files", ctypes.c_uint64), ("network", ctypes.c_uint64), ("scopes", ctypes.c_uint64))


class _Beneath(ctypes.Structure):
    _pack_ = 1
    _fields_ = (("allowed", ctypes.c_uint64), ("parent", ctypes.c_int32))


def confine(folder: Path, reads: Iterable[Path] = (), account: SystemAccount | None = None) -> list[str]:
    """Give up access to all but the program itself, `reads`, and a folder; return the measures in force."""
    # Call it while the process has a single thread: others would keep their permissions
    in_force = []
    if account is not None:
        account.become()
        in_force.append("account")
    if sys.platform != "linux":
        return in_force
    tried: dict[str, Callable[[], object]] = {
        "no_new_privs": lambda: _check(_libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)),
        "namespaces": _separate,
        "files": lambda: _restrict_files(folder, reads),
        "system_calls": seccomp.refuse,
    }
    for name, measure in tried.items():
        with contextlib.suppress(OSError):
            measure()
            in_force.append(name)
    return in_force


def keep_private() -> None:
    """Close files that this process writes to other accounts, and its memory to other processes."""
    os.umask(0o077)
    if sys.platform == "linux":
        _libc.prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)


def available(user: str, data: Path) -> dict[str, bool]:
    """Return which measures are available on this machine, tried once in a separate process."""
    changes = user != accounts.NONE and accounts.may_change()
    in_force = _measures_in_force(*((user, str(data.resolve())) if changes else (accounts.NONE, "")))
    return {name: name in in_force for name in MEASURES}


@functools.cache
def _measures_in_force(user: str, data: str) -> list[str]:
    try:
        command = [sys.executable, "-m", "app.sandbox.confine", user, data]
        output = subprocess.check_output(  # noqa: S603 - ourselves
            command, timeout=60, cwd=Path(__file__).parents[2], stderr=subprocess.DEVNULL
        )
        in_force: list[str] = json.loads(output)
    except (OSError, ValueError, subprocess.SubprocessError):
        return []
    return in_force


def _check(result: int) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result


def _separate() -> None:
    """Enter a network namespace without interfaces, and a user namespace, where root has no privileges."""
    _check(_libc.unshare(_CLONE_NEWUSER | _CLONE_NEWNET | _CLONE_NEWIPC))
    # Only in a user namespace: elsewhere the kernel counts all processes of the account.
    resource.setrlimit(resource.RLIMIT_NPROC, (MAX_PROCESSES, MAX_PROCESSES))


def _restrict_files(folder: Path, reads: Iterable[Path]) -> None:
    version = _check(_libc.syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), _VERSION))
    handled = sum(rights for since, rights in _HANDLED.items() if version >= since)
    ruleset = _Ruleset(
        handled, _TCP if version >= _NETWORK_SINCE else 0, _SCOPES if version >= _SCOPE_SINCE else 0
    )
    # older kernels refuse a longer structure than theirs unless the rest is zero
    rules = _check(
        _libc.syscall(_CREATE_RULESET, ctypes.byref(ruleset), ctypes.c_size_t(ctypes.sizeof(ruleset)), 0)
    )
    try:
        _allow(rules, folder, handled & ~_EXECUTE)
        for path in [*_program(folder), *reads]:
            _allow(rules, path, _READ & handled)
        for name in _DEVICES:
            _allow(rules, Path(name), handled & (_READ | 1 << 1))
        _check(_libc.syscall(_RESTRICT_SELF, rules, 0))
    finally:
        os.close(rules)


def _program(task_folder: Path) -> list[Path]:
    """Return the libraries and modules that the program reads, but no parent of the task's folder."""
    packages = [Path(__file__).parents[1], Path(json.__file__).parents[1]]
    library = Path(__file__).parents[2] / "lensmodel"
    entries = [*sys.path, sys.prefix, sys.base_prefix, *_MACHINE, *_PROC]
    listed = [*(Path(entry) for entry in entries if entry), *packages, library]
    inside = task_folder.resolve()
    return [path for path in listed if path.exists() and not inside.is_relative_to(path.resolve())]


def _allow(rules: int, path: Path, rights: int) -> None:
    try:
        opened = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except FileNotFoundError:
        return
    try:
        rights &= -1 if path.is_dir() else _FILE_RIGHTS
        beneath = _Beneath(rights, opened)
        _check(_libc.syscall(_ADD_RULE, rules, _PATH_BENEATH, ctypes.byref(beneath), 0))
    finally:
        os.close(opened)


def _trial(user: str, data: Path) -> list[str]:
    account = accounts.find(user)
    of_use = account is not None and account.is_of_use(data)
    return confine(Path("/nonexistent"), account=account if of_use else None)


if __name__ == "__main__":
    print(json.dumps(_trial(sys.argv[1], Path(sys.argv[2]))))  # noqa: T201 - this is its answer
