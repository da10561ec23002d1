"""A filter of system calls: a task may compute, but not connect, start programs or inspect processes.

Written out for the two processors that servers have, since the libraries that would write it need a
system package besides their wheel. On another processor there is no filter, and the service says so.

References
----------
.. [1] Linux man-pages: seccomp(2); Linux, Documentation/userspace-api/seccomp_filter.rst.
"""

from __future__ import annotations

import errno
import os
import struct
from typing import Final

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
INSTRUCTION: Final = struct.Struct("<HBBI")  # code, jump if so, jump if not, value

# By the name of `platform.machine`: AUDIT_ARCH_... of linux/audit.h, and the column of the tables below
PROCESSORS: Final = {"x86_64": (0xC000003E, 0), "aarch64": (0xC00000B7, 1)}
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


def program(machine: str) -> bytes:
    """Return the filter of this process for a processor, as the kernel takes it."""
    if machine not in PROCESSORS:
        raise OSError(errno.ENOSYS, f"no filter was written for {machine}")
    audit, column = PROCESSORS[machine]

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
    return b"".join(INSTRUCTION.pack(*step) for step in [*steps, (_RETURN, 0, 0, _ALLOW)])
