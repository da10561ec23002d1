"""A filter of system calls: a task may compute, but not connect, start programs or inspect processes.

Written out for the two processors that servers have, since the libraries that would write it need a
system package besides their wheel. On another processor there is no filter, and the service says so.

References
----------
.. [1] Linux man-pages: seccomp(2); Linux, Documentation/userspace-api/seccomp_filter.rst.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
from dataclasses import dataclass
from typing import Final

# linux/prctl.h, linux/seccomp.h, linux/sched.h
_PR_SET_SECCOMP, _MODE_FILTER = 22, 2
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


def _table(text: str) -> dict[str, int]:
    return {name: int(number) for name, number in (entry.split("=") for entry in text.split())}


@dataclass(frozen=True, slots=True)
class _Processor:
    """Numbers of system calls, from a processor's unistd.h.

    `refused`: what a task does not need, all "not permitted"; also calls by which an open file loses its
    name, so that whoever counts the folder of a task sees every file. `own`: calls that name a process, which
    must be the task itself. `opening`: calls that open files, by the position of their flags.
    """

    audit: int
    clone: int
    prlimit: int
    own: tuple[int, ...]  # kill, tgkill
    opening: dict[int, int]  # open, openat
    refused: dict[str, int]


_CLONE3: Final = 435  # the same on both processors
_COMMON: Final = _table(
    "pidfd_open=434 pidfd_getfd=438 io_uring_setup=425 io_uring_enter=426 io_uring_register=427 "
    "open_tree=428 move_mount=429 fsopen=430 pidfd_send_signal=424 openat2=437"
)
PROCESSORS: Final = {
    "x86_64": _Processor(
        0xC000003E,
        clone=56,
        prlimit=302,
        own=(62, 234),
        opening={2: 1, 257: 2},
        refused=_COMMON
        | _table(
            "socket=41 connect=42 accept=43 sendto=44 recvfrom=45 bind=49 listen=50 socketpair=53 "
            "accept4=288 fork=57 vfork=58 execve=59 execveat=322 ptrace=101 process_vm_readv=310 "
            "process_vm_writev=311 kcmp=312 unshare=272 setns=308 mount=165 umount2=166 pivot_root=155 "
            "chroot=161 bpf=321 perf_event_open=298 userfaultfd=323 keyctl=250 add_key=248 "
            "request_key=249 open_by_handle_at=304 name_to_handle_at=303 init_module=175 "
            "finit_module=313 delete_module=176 kexec_load=246 kexec_file_load=320 reboot=169 swapon=167 "
            "swapoff=168 settimeofday=164 clock_settime=227 sethostname=170 setdomainname=171 acct=163 "
            "fanotify_init=300 shmget=29 msgget=68 semget=64 mq_open=240 personality=135 syslog=103 "
            "tkill=200 rt_sigqueueinfo=129 rt_tgsigqueueinfo=297 memfd_create=319 "
            "unlink=87 unlinkat=263 rename=82 renameat=264 renameat2=316"
        ),
    ),
    "aarch64": _Processor(
        0xC00000B7,
        clone=220,
        prlimit=261,
        own=(129, 131),
        opening={56: 2},
        refused=_COMMON
        | _table(
            "socket=198 socketpair=199 bind=200 listen=201 accept=202 connect=203 sendto=206 recvfrom=207 "
            "accept4=242 execve=221 execveat=281 ptrace=117 process_vm_readv=270 process_vm_writev=271 "
            "kcmp=272 unshare=97 setns=268 mount=40 umount2=39 pivot_root=41 chroot=51 bpf=280 "
            "perf_event_open=241 userfaultfd=282 keyctl=219 add_key=217 request_key=218 "
            "open_by_handle_at=265 name_to_handle_at=264 init_module=105 finit_module=273 "
            "delete_module=106 kexec_load=104 kexec_file_load=294 reboot=142 swapon=224 swapoff=225 "
            "settimeofday=170 clock_settime=112 sethostname=161 setdomainname=162 acct=89 "
            "fanotify_init=262 shmget=194 msgget=186 semget=190 mq_open=180 personality=92 syslog=116 "
            "tkill=130 rt_sigqueueinfo=138 rt_tgsigqueueinfo=240 memfd_create=279 "
            "unlinkat=35 renameat=38 renameat2=276"
        ),
    ),
}


class _Instruction(ctypes.Structure):
    _fields_ = (
        ("code", ctypes.c_uint16),
        ("if_so", ctypes.c_uint8),
        ("if_not", ctypes.c_uint8),
        ("value", ctypes.c_uint32),
    )


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_uint16), ("first", ctypes.POINTER(_Instruction)))


def refuse() -> None:
    """Put the filter in force for this thread and all that it starts; `no_new_privs` must be set."""
    processor = PROCESSORS.get(platform.machine())
    if processor is None:
        raise OSError(errno.ENOSYS, f"no filter was written for {platform.machine()}")
    steps = _steps(processor)
    listed = (_Instruction * len(steps))(*(_Instruction(*step) for step in steps))
    program = _Program(len(steps), listed)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_SECCOMP, _MODE_FILTER, ctypes.byref(program), 0, 0) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _steps(processor: _Processor) -> list[tuple[int, int, int, int]]:
    """Return the filter: `(code, jump if so, jump if not, value)`."""
    steps = [
        (_LOAD, 0, 0, _PROCESSOR),
        (_EQUAL, 1, 0, processor.audit),
        (_RETURN, 0, 0, _KILL),  # calls of another processor's interface have other numbers
        (_LOAD, 0, 0, _NUMBER),
        (_AT_LEAST, 0, 1, _X32),
        (_RETURN, 0, 0, _NO),
        (_EQUAL, 0, 1, _CLONE3),
        (_RETURN, 0, 0, _UNKNOWN),  # the C library then falls back to clone, whose flags can be read
    ]
    for number in processor.refused.values():
        steps += [(_EQUAL, 0, 1, number), (_RETURN, 0, 0, _NO)]
    # call, position of the argument to look at, comparison with a value, answer if so, else
    rules = [
        *((call, 0, _EQUAL, os.getpid(), _ALLOW, _NO) for call in processor.own),
        (processor.prlimit, 0, _EQUAL, 0, _ALLOW, _NO),
        *((call, flags, _ANY_OF, _TMPFILE, _NO, _ALLOW) for call, flags in processor.opening.items()),
        (processor.clone, 0, _ANY_OF, _CLONE_THREAD, _ALLOW, _NO),  # threads yes, processes no
    ]
    for call, position, comparison, value, if_so, if_not in rules:
        steps += [
            (_EQUAL, 0, 4, call),
            (_LOAD, 0, 0, _FIRST_ARGUMENT + 8 * position),
            (comparison, 0, 1, value),
            (_RETURN, 0, 0, if_so),
            (_RETURN, 0, 0, if_not),
        ]
    return [*steps, (_RETURN, 0, 0, _ALLOW)]
