"""Servers that the service leans on elsewhere: a PostgreSQL of its own for a test."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ACCOUNT = "postgres"
"""The server refuses to run as root; Debian's package brings this account."""


def free_port() -> int:
    with contextlib.closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class Postgres:
    """One PostgreSQL server with an empty database for the tables and one for the jobs."""

    def __init__(self, programs: Path, folder: Path) -> None:
        self._programs, self._folder, self.port = programs, folder, free_port()
        self._as = {"user": ACCOUNT} if os.geteuid() == 0 else {}
        if self._as:
            shutil.chown(folder, ACCOUNT)
        self._run("initdb", "--auth=trust", "--username=lens", "--no-sync", "--pgdata", str(folder / "data"))

    def url(self, name: str) -> str:
        return f"postgresql+psycopg://lens@127.0.0.1:{self.port}/{name}"

    def start(self) -> None:
        options = f"-p {self.port} -h 127.0.0.1 -k {self._folder} -c fsync=off"
        data, log = str(self._folder / "data"), str(self._folder / "log")
        self._run("pg_ctl", "-D", data, "-l", log, "-w", "-t", "120", "-o", options, "start")

    def create(self, *names: str) -> None:
        for name in names:
            self._run("createdb", "-h", "127.0.0.1", "-p", str(self.port), "-U", "lens", name)

    def stop(self) -> None:
        """Cut all connections off, as a crash of the server does."""
        self._run("pg_ctl", "-D", str(self._folder / "data"), "-m", "immediate", "-w", "stop")

    def _run(self, program: str, *arguments: str) -> None:
        subprocess.run(
            [str(self._programs / program), *arguments],
            check=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd=self._folder,
            **self._as,  # type: ignore[call-overload]  # no user, or a name
        )


def programs_of_postgres() -> Path | None:
    installed = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    return installed[-1].parent if installed else None


@contextlib.contextmanager
def postgres() -> Iterator[Postgres]:
    """Give a running server; skip the test where none is installed."""
    programs = programs_of_postgres()
    if programs is None:
        pytest.skip("PostgreSQL is not installed (Debian: apt-get install postgresql)")
    folder = Path(tempfile.mkdtemp(prefix="lensmodel-pg-"))  # short: a socket lies in it
    try:
        server = Postgres(programs, folder)
        server.start()
        server.create("app", "jobs")
        yield server
        with contextlib.suppress(subprocess.CalledProcessError):
            server.stop()
    finally:
        shutil.rmtree(folder, ignore_errors=True)
