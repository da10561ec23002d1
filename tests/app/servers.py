"""Servers that the service leans on elsewhere: a PostgreSQL and an S3 of its own for a test."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import httpx2
import pytest

NETWORK = "10.77.0.0/16"
"""Of the hosts that tests make: any private network that nobody uses here."""

ACCOUNT = "postgres"
"""The server refuses to run as root; Debian's package brings this account."""


def free_port() -> int:
    with contextlib.closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


SMALL_LOG = ("--wal-segsize=1",)
"""MiB of each file of its log: small, so that a full disk is felt at once."""


class Postgres:
    """One PostgreSQL server with an empty database for the tables and one for the jobs."""

    def __init__(self, programs: Path, folder: Path, addresses: str = "127.0.0.1") -> None:
        self._programs, self._folder, self.port = programs, folder, free_port()
        self._addresses = addresses
        self._as = {"user": ACCOUNT} if os.geteuid() == 0 else {}
        if self._as:
            shutil.chown(folder, ACCOUNT)
        self._run(
            "initdb",
            "--auth=trust",
            "--username=lens",
            "--no-sync",
            *SMALL_LOG,
            "--pgdata",
            str(folder / "data"),
        )

        with (folder / "data" / "pg_hba.conf").open("a") as rules:
            rules.write(f"host all all {NETWORK} trust\n")

    def url(self, name: str, host: str = "127.0.0.1") -> str:
        return f"postgresql+psycopg://lens@{host}:{self.port}/{name}"

    def start(self) -> None:
        options = f"-p {self.port} -h {self._addresses} -k {self._folder} -c fsync=off"
        data, log = str(self._folder / "data"), str(self._folder / "log")
        self._run("pg_ctl", "-D", data, "-l", log, "-w", "-t", "120", "-o", options, "start")

    def start_if_down(self) -> None:
        """Start it where it ended itself, as on a full disk; one that recovers is waited for."""
        try:
            self._run("pg_ctl", "-D", str(self._folder / "data"), "status")
        except subprocess.CalledProcessError:
            self.start()

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


class Moto:
    """A server that behaves as S3 and keeps its objects in memory."""

    def __init__(self, bucket: str, address: str = "127.0.0.1") -> None:
        self.port = free_port()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "moto.server", "-H", address, "-p", str(self.port)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        end = time.monotonic() + 120.0
        while True:
            with contextlib.suppress(httpx2.HTTPError):
                httpx2.put(f"http://127.0.0.1:{self.port}/{bucket}", timeout=5.0).raise_for_status()
                return
            assert time.monotonic() < end, "moto does not start"
            time.sleep(0.2)

    @property
    def environment(self) -> dict[str, str]:
        return self.environment_at("127.0.0.1")

    def environment_at(self, host: str) -> dict[str, str]:
        return {
            "AWS_ENDPOINT_URL": f"http://{host}:{self.port}",
            "AWS_ALLOW_HTTP": "true",
            "AWS_REGION": "us-east-1",
            "AWS_ACCESS_KEY_ID": "test",
            "AWS_SECRET_ACCESS_KEY": "test",
        }

    @contextlib.contextmanager
    def hanging(self) -> Iterator[None]:
        """Let it take requests and answer none."""
        self.process.send_signal(signal.SIGSTOP)
        try:
            yield
        finally:
            self.process.send_signal(signal.SIGCONT)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()


def missing(what: str) -> NoReturn:
    """Skip a test for want of a server; fail it where servers are required, as in continuous integration."""
    if os.environ.get("LENSMODEL_REQUIRE_SERVERS"):
        pytest.fail(what)
    pytest.skip(what)


@contextlib.contextmanager
def moto(bucket: str, address: str = "127.0.0.1") -> Iterator[Moto]:
    """Give a running S3 with an empty bucket; skip the test where moto is not installed."""
    if importlib.util.find_spec("moto") is None or importlib.util.find_spec("flask") is None:
        missing("moto is not installed: pip install 'moto[server]'")
    server = Moto(bucket, address)
    try:
        yield server
    finally:
        server.close()


def programs_of_postgres() -> Path | None:
    installed = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    return installed[-1].parent if installed else None


@contextlib.contextmanager
def postgres(addresses: str = "127.0.0.1", folder: Path | None = None) -> Iterator[Postgres]:
    """Give a running server, in an empty folder if one is named; skip the test where none is installed."""
    programs = programs_of_postgres()
    if programs is None:
        missing("PostgreSQL is not installed (Debian: apt-get install postgresql)")
    made = folder is None
    folder = folder or Path(tempfile.mkdtemp(prefix="lensmodel-pg-"))  # short: a socket lies in it
    try:
        server = Postgres(programs, folder, addresses)
        server.start()
        server.create("app", "jobs")
        yield server
        with contextlib.suppress(subprocess.CalledProcessError):
            server.stop()
    finally:
        if made:
            shutil.rmtree(folder, ignore_errors=True)


def main() -> None:
    """Run both until the standard input ends; print what a service of one machine needs to use them.

    For scripts: `python tests/app/servers.py BUCKET`.
    """
    bucket = sys.argv[1]
    with postgres() as server, moto(bucket) as store:
        values = {
            "LENS_DATABASE_URL": server.url("app"),
            "LENS_STORAGE_URL": f"s3://{bucket}",
            **store.environment,
        }
        print(*(f"{name}={value}" for name, value in values.items()), sep="\n", flush=True)  # noqa: T201
        sys.stdin.read()


if __name__ == "__main__":
    main()
