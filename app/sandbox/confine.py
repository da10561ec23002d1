"""Confine a process by means of the kernel: files, network, other programs, other processes.

A child decodes untrusted files. Should one of them take it over, there must be little to gain: no
secret in its environment, no files but those of its task, no network, no program to start. Each
measure is enforced by the kernel and cannot be undone by the process. Only the change to another
account needs privileges; which other measures exist depends on the kernel and on what a container
allows, so each reports whether it is in force, and the service shows it under `/readyz`.

References
----------
.. [1] Linux man-pages: landlock(7), seccomp(2), unshare(2), prctl(2), capset(2), user_namespaces(7).
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import json
import os
import platform
import resource
import struct
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
# linux/prctl.h, linux/seccomp.h, linux/capability.h, linux/sched.h
_PR_SET_DUMPABLE, _PR_SET_SECCOMP, _PR_SET_NO_NEW_PRIVS, _MODE_FILTER = 4, 22, 38, 2
_CAPABILITY_VERSION: Final = 0x20080522  # the third: two words of 32 bits for each of three sets
_CLONE_NEWUSER, _CLONE_NEWNET, _CLONE_NEWIPC = 0x10000000, 0x40000000, 0x08000000

# linux/landlock.h; `_HANDLED`: the file rights that each version of Landlock added
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_EXECUTE, _WRITE, _READ = 1 << 0, 1 << 1, 1 << 2 | 1 << 3  # READ_FILE, READ_DIR
_FILE_RIGHTS: Final = 1 << 0 | 1 << 1 | 1 << 2 | 1 << 14  # EXECUTE, WRITE_FILE, READ_FILE, TRUNCATE
_HANDLED: Final = {1: (1 << 13) - 1, 2: 1 << 13, 3: 1 << 14, 5: 1 << 15}
_NETWORK_SINCE, _SCOPE_SINCE = 4, 6  # Linux 6.7 and 6.12
_TCP: Final = 1 << 0 | 1 << 1  # bind, connect
_SCOPES: Final = 1 << 0 | 1 << 1  # abstract sockets, signals
_VERSION: Final = 1 << 0
_PATH_BENEATH: Final = 1

_DEVICES: Final = ("/dev/null", "/dev/zero", "/dev/urandom", "/dev/random")
_ROOT: Final = Path(__file__).parents[2]
# What a task reads besides: the loader, and files from which numerical libraries learn of the machine
_MACHINE: Final = (
    *("/usr", "/lib", "/lib64", "/etc/ld.so.cache", "/etc/localtime", "/sys/devices/system/cpu"),
    *("/proc/self", "/proc/cpuinfo", "/proc/meminfo"),
)
_libc = ctypes.CDLL(None, use_errno=True)


def confine(folder: Path, reads: Iterable[Path] = (), account: SystemAccount | None = None) -> None:
    """Give up access to all but the program itself, `reads`, and a folder, as far as the kernel has means."""
    # Call it while the process has a single thread: others would keep their permissions
    if account is not None:
        become(account)
    _restrict(folder, reads)


def become(account: SystemAccount) -> None:
    """Change this process to an account, and give up all capabilities."""
    os.setgroups([])
    os.setresgid(account.gid, account.gid, account.gid)
    os.setresuid(account.uid, account.uid, account.uid)
    # a change of account by itself clears only the superuser's capabilities
    header, none = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION, 0), (ctypes.c_uint32 * 6)()
    _check(_libc.capset(header, none))


def _restrict(folder: Path, reads: Iterable[Path] = ()) -> list[str]:
    """Put all measures in force but the account; return which are."""
    measures: dict[str, Callable[[], object]] = {
        "no_new_privs": lambda: _check(_libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)),
        "namespaces": _separate,
        "files": lambda: _restrict_files(folder, reads),
        "system_calls": _restrict_calls,
    }
    in_force = []
    for name, measure in measures.items() if sys.platform == "linux" else ():
        with contextlib.suppress(OSError):
            measure()
            in_force.append(name)
    return in_force


def keep_private() -> None:
    """Close files that this process writes to other accounts, and its memory to other processes."""
    os.umask(0o077)
    if sys.platform == "linux":
        _libc.prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)


@functools.cache
def available(user: str, data: Path) -> dict[str, bool]:
    """Return which measures are available on this machine, tried once in a separate process."""
    try:
        tried = subprocess.run(  # noqa: S603 - ourselves
            [sys.executable, "-m", "app.sandbox.confine", user, str(data.resolve())],
            check=True,
            timeout=60,
            cwd=_ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        in_force = json.loads(tried.stdout)
    except (OSError, ValueError, subprocess.SubprocessError):
        in_force = []
    return {name: name in in_force for name in MEASURES}


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


def _restrict_calls() -> None:
    steps = seccomp.program(platform.machine())
    listed = ctypes.create_string_buffer(steps)
    header = struct.pack("@HP", len(steps) // seccomp.INSTRUCTION.size, ctypes.addressof(listed))
    _check(_libc.prctl(_PR_SET_SECCOMP, _MODE_FILTER, header, 0, 0))


def _restrict_files(folder: Path, reads: Iterable[Path]) -> None:
    version = _check(_libc.syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), _VERSION))
    handled = sum(rights for since, rights in _HANDLED.items() if version >= since)
    # older kernels refuse a longer structure than theirs unless the rest is zero
    network, scopes = _TCP * (version >= _NETWORK_SINCE), _SCOPES * (version >= _SCOPE_SINCE)
    ruleset = struct.pack("=QQQ", handled, network, scopes)
    rules = _check(_libc.syscall(_CREATE_RULESET, ruleset, ctypes.c_size_t(len(ruleset)), 0))
    inside = folder.resolve()
    packages = [_ROOT / "app", _ROOT / "lensmodel", Path(os.__file__).parent]
    program = [*_program(), *packages, *map(Path, _MACHINE)]
    allowed = {path: _READ for path in program if not inside.is_relative_to(path.resolve())}
    allowed |= dict.fromkeys(reads, _READ) | dict.fromkeys(map(Path, _DEVICES), _READ | _WRITE)
    try:
        for path, rights in (allowed | {folder: ~_EXECUTE}).items():
            with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                _allow(rules, path, rights & handled)
        _check(_libc.syscall(_RESTRICT_SELF, rules, 0))
    finally:
        os.close(rules)


def _program() -> list[Path]:
    """Return where the program and its libraries are."""
    return [Path(entry) for entry in [*sys.path, sys.prefix, sys.base_prefix] if entry]


def _allow(rules: int, path: Path, rights: int) -> None:
    opened = os.open(path, os.O_PATH | os.O_CLOEXEC)
    try:
        beneath = struct.pack("=Qi", rights if path.is_dir() else rights & _FILE_RIGHTS, opened)
        _check(_libc.syscall(_ADD_RULE, rules, _PATH_BENEATH, beneath, 0))
    finally:
        os.close(opened)


def _trial(user: str, data: Path) -> list[str]:
    """Return the measures that can be in force; an account must read the program and reach `data`."""
    account = accounts.find(user) if accounts.may_change() else None
    needed = dict.fromkeys([*_program(), _ROOT], os.R_OK) | dict.fromkeys(data.resolve().parents, os.X_OK)
    there = [(path, mode) for path, mode in needed.items() if path.exists()]
    in_force = []
    if account is not None:
        with contextlib.suppress(OSError):
            become(account)
            in_force += ["account"] * all(os.access(path, mode) for path, mode in there)
    return in_force + _restrict(Path("/nonexistent"))


if __name__ == "__main__":
    print(json.dumps(_trial(sys.argv[1], Path(sys.argv[2]))))  # noqa: T201 - this is its answer
