"""Confine a process by means of the kernel: files, network, other programs, other processes.

Each measure is enforced by the kernel and cannot be undone by the process. Which there are depends on
privileges, the kernel, and what a container allows, so each reports whether it is in force.

References
----------
.. [1] Linux man-pages: landlock(7), seccomp(2), unshare(2), prctl(2), capset(2), user_namespaces(7); Linux,
   Documentation/userspace-api/seccomp_filter.rst.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import functools
import json
import os
import platform
import resource
import signal
import struct
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

from app.sandbox import account as accounts
from app.sandbox.account import SystemAccount

# `account`: a separate one; `namespaces`: a network without interfaces and a separate count of processes;
# `files`: Landlock; `system_calls`: seccomp
MEASURES: Final = ("account", "no_new_privs", "namespaces", "files", "system_calls")
MAX_PROCESSES: Final = 128  # threads of one task at most (chosen): far more than a correction starts
PARENT: Final = "LENSMODEL_PARENT"  # environment variable with the process id of the supervisor
# linux/prctl.h, linux/seccomp.h, linux/capability.h, linux/sched.h
_PR_SET_PDEATHSIG: Final = 1
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

# linux/seccomp.h, linux/sched.h
_ALLOW, _KILL = 0x7FFF0000, 0x80000000
_NO, _UNKNOWN = 0x00050000 | errno.EPERM, 0x00050000 | errno.ENOSYS
_CLONE_THREAD: Final = 0x00010000
# __X32_SYSCALL_BIT of asm/unistd.h: marks calls of the x32 interface, which nothing uses
_X32: Final = 0x40000000
_TMPFILE: Final = 0o20000000  # __O_TMPFILE of asm-generic/fcntl.h, the same on both processors
# linux/bpf_common.h
_LOAD, _EQUAL, _AT_LEAST, _ANY_OF, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
# Offsets of the fields of `struct seccomp_data`, which is little-endian on both processors
_NUMBER, _PROCESSOR, _FIRST_ARGUMENT = 0, 4, 16
_INSTRUCTION: Final = struct.Struct("<HBBI")  # code, jump if so, jump if not, value

# By the name of `platform.machine`: AUDIT_ARCH_... of linux/audit.h, and the column of the tables below
_PROCESSORS: Final = {"x86_64": (0xC000003E, 0), "aarch64": (0xC00000B7, 1)}
# Numbers of calls on these processors, of their unistd.h; one number where they agree, 0 where there is no
# such call. What a task does not need, all "not permitted"; also calls by which an open file loses its name,
# so that whoever counts the folder of a task sees every file.
_REFUSED: Final = """
    socket=41/198 socketpair=53/199 bind=49/200 listen=50/201 accept=43/202 connect=42/203 sendto=44/206
    recvfrom=45/207 accept4=288/242 fork=57/0 vfork=58/0 execve=59/221 execveat=322/281 ptrace=101/117
    process_vm_readv=310/270 process_vm_writev=311/271 kcmp=312/272 unshare=272/97 setns=308/268 mount=165/40
    umount2=166/39 pivot_root=155/41 chroot=161/51 bpf=321/280 perf_event_open=298/241 userfaultfd=323/282
    keyctl=250/219 add_key=248/217 request_key=249/218 open_by_handle_at=304/265 name_to_handle_at=303/264
    init_module=175/105 finit_module=313/273 delete_module=176/106 kexec_load=246/104 kexec_file_load=320/294
    reboot=169/142 swapon=167/224 swapoff=168/225 settimeofday=164/170 clock_settime=227/112
    sethostname=170/161 setdomainname=171/162 acct=163/89 fanotify_init=300/262 shmget=29/194 msgget=68/186
    semget=64/190 mq_open=240/180 personality=135/92 syslog=103/116 tkill=200/130 rt_sigqueueinfo=129/138
    rt_tgsigqueueinfo=297/240 memfd_create=319/279 unlink=87/0 unlinkat=263/35 rename=82/0 renameat=264/38
    renameat2=316/276 pidfd_open=434 pidfd_getfd=438 io_uring_setup=425 io_uring_enter=426
    io_uring_register=427 open_tree=428 move_mount=429 fsopen=430 pidfd_send_signal=424 openat2=437"""
# Calls that are refused by one of their arguments: those that name a process, which must be the task itself,
# those that open files, and that which starts threads and processes
_KILL_CALLS, _PRLIMIT = "kill=62/129 tgkill=234/131", "prlimit64=302/261"
_OPEN, _OPENAT, _CLONE, _CLONE3 = "open=2/0", "openat=257/56", "clone=56/220", "clone3=435"

_DEVICES: Final = ("/dev/null", "/dev/zero", "/dev/urandom", "/dev/random")
_ROOT: Final = Path(__file__).parents[2]
# What a task reads besides: the loader, and files from which numerical libraries learn of the machine
_MACHINE: Final = (
    *("/usr", "/lib", "/lib64", "/etc/ld.so.cache", "/etc/localtime", "/sys/devices/system/cpu"),
    *("/proc/self", "/proc/cpuinfo", "/proc/meminfo"),
)
_libc = ctypes.CDLL(None, use_errno=True)


def confine(folder: Path, reads: Iterable[Path] = (), account: SystemAccount | None = None) -> list[str]:
    """Give up access to all but the program, `reads`, and a folder; return which measures the kernel took."""
    # Call it while the process has a single thread: others would keep their permissions
    if account is not None:
        become(account)
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


def become(account: SystemAccount) -> None:
    """Change this process to an account, and give up all capabilities."""
    os.setgroups([])
    os.setresgid(account.gid, account.gid, account.gid)
    os.setresuid(account.uid, account.uid, account.uid)
    # a change of account by itself clears only the superuser's capabilities
    header, none = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION, 0), (ctypes.c_uint32 * 6)()
    _check(_libc.capset(header, none))


def keep_private() -> None:
    """Close files that this process writes to other accounts, and its memory to other processes."""
    os.umask(0o077)
    if sys.platform == "linux":
        _libc.prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)


def end_with_parent() -> None:
    """Let the kernel stop this process once the supervisor has ended, however it ended."""
    parent = os.environ.pop(PARENT, None)
    if parent is not None and sys.platform == "linux":
        _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != int(parent):
            sys.exit("the supervisor has ended already")


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
    steps = _filter(platform.machine())
    listed = ctypes.create_string_buffer(steps)
    header = struct.pack("@HP", len(steps) // _INSTRUCTION.size, ctypes.addressof(listed))
    _check(_libc.prctl(_PR_SET_SECCOMP, _MODE_FILTER, header, 0, 0))


def _filter(machine: str) -> bytes:
    """Return the filter of this process for a processor, as the kernel takes it."""
    if machine not in _PROCESSORS:
        raise OSError(errno.ENOSYS, f"no filter was written for {machine}")
    audit, column = _PROCESSORS[machine]

    def numbers(table: str) -> list[int]:
        listed = [entry.partition("=")[2].split("/") for entry in table.split()]
        return [int(each[column % len(each)]) for each in listed if each[column % len(each)] != "0"]

    steps = [
        (_LOAD, 0, 0, _PROCESSOR),
        (_EQUAL, 1, 0, audit),
        (_RETURN, 0, 0, _KILL),  # calls of another processor's interface have other numbers
        (_LOAD, 0, 0, _NUMBER),
        (_AT_LEAST, 0, 1, _X32),
        (_RETURN, 0, 0, _NO),
        (_EQUAL, 0, 1, *numbers(_CLONE3)),
        (_RETURN, 0, 0, _UNKNOWN),  # the C library then falls back to clone, whose flags can be read
    ]
    for number in numbers(_REFUSED):
        steps += [(_EQUAL, 0, 1, number), (_RETURN, 0, 0, _NO)]
    # calls, position of the argument to look at, comparison with a value, answer if so, else
    rules = [
        (_KILL_CALLS, 0, _EQUAL, os.getpid(), _ALLOW, _NO),
        (_PRLIMIT, 0, _EQUAL, 0, _ALLOW, _NO),
        (_OPEN, 1, _ANY_OF, _TMPFILE, _NO, _ALLOW),
        (_OPENAT, 2, _ANY_OF, _TMPFILE, _NO, _ALLOW),
        (_CLONE, 0, _ANY_OF, _CLONE_THREAD, _ALLOW, _NO),  # threads yes, processes no
    ]
    for calls, position, comparison, value, if_so, if_not in rules:
        for call in numbers(calls):
            steps += [
                (_EQUAL, 0, 4, call),
                (_LOAD, 0, 0, _FIRST_ARGUMENT + 8 * position),
                (comparison, 0, 1, value),
                (_RETURN, 0, 0, if_so),
                (_RETURN, 0, 0, if_not),
            ]
    return b"".join(_INSTRUCTION.pack(*step) for step in [*steps, (_RETURN, 0, 0, _ALLOW)])


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
    return in_force + confine(Path("/nonexistent"))


if __name__ == "__main__":
    print(json.dumps(_trial(sys.argv[1], Path(sys.argv[2]))))  # noqa: T201 - this is its answer
