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
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import httpx2
import pytest
from deadline import until

NETWORK = "10.77.0.0/16"
"""Of the hosts that tests make: any private network that nobody uses here."""

ACCOUNT = "postgres"
"""The server refuses to run as root; Debian's package brings this account."""


SILENT = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


def free_port() -> int:
    with contextlib.closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def ready(client: httpx2.Client) -> bool:
    """Whether a service answers that it is ready."""
    with contextlib.suppress(httpx2.HTTPError):
        return client.get("/readyz").status_code == 200
    return False


def environment_of_s3(address: str) -> dict[str, str]:
    return {
        "AWS_ENDPOINT_URL": f"http://{address}",
        "AWS_ALLOW_HTTP": "true",
        "AWS_REGION": "us-east-1",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
    }


class Postgres:
    """One PostgreSQL server with an empty database for the tables and one for the jobs."""

    def __init__(self, programs: Path, folder: Path, addresses: str = "127.0.0.1") -> None:
        self._programs, self._folder, self.port = programs, folder, free_port()
        self._addresses, self._data = addresses, folder / "data"
        self._as = {"user": ACCOUNT} if os.geteuid() == 0 else {}
        if self._as:
            shutil.chown(folder, ACCOUNT)
        # small files of its log, so that a full disk is felt at once
        options = ("--auth=trust", "--username=lens", "--no-sync", "--wal-segsize=1")
        self._run("initdb", *options, "--pgdata", str(self._data))
        with (self._data / "pg_hba.conf").open("a") as rules:
            rules.write(f"host all all {NETWORK} trust\n")

    def url(self, name: str, host: str = "127.0.0.1") -> str:
        return f"postgresql+psycopg://lens@{host}:{self.port}/{name}"

    def start(self) -> None:
        options = f"-p {self.port} -h {self._addresses} -k {self._folder} -c fsync=off"
        self._control("-l", str(self._folder / "log"), "-w", "-t", "120", "-o", options, "start")

    def start_if_down(self) -> None:
        """Start it where it ended itself, as on a full disk; one that recovers is waited for."""
        try:
            self._control("status")
        except subprocess.CalledProcessError:
            self.start()

    def create(self, *names: str) -> None:
        for name in names:
            self._run("createdb", "-h", "127.0.0.1", "-p", str(self.port), "-U", "lens", name)

    def stop(self) -> None:
        """Cut all connections off, as a crash of the server does."""
        self._control("-m", "immediate", "-w", "stop")

    def _control(self, *arguments: str) -> None:
        self._run("pg_ctl", "-D", str(self._data), *arguments)

    def _run(self, program: str, *arguments: str) -> None:
        command = [str(self._programs / program), *arguments]
        subprocess.run(command, check=True, cwd=self._folder, **self._as, **SILENT)


class Moto:
    """A server that behaves as S3 and keeps its objects in memory."""

    def __init__(self, bucket: str, address: str = "127.0.0.1") -> None:
        self.port = free_port()
        command = [sys.executable, "-m", "moto.server", "-H", address, "-p", str(self.port)]
        self.process = subprocess.Popen(command, **SILENT)

        def begun() -> bool:
            with contextlib.suppress(httpx2.HTTPError):
                return httpx2.put(f"http://127.0.0.1:{self.port}/{bucket}", timeout=5.0).is_success
            return False

        until(begun)

    def environment(self, host: str = "127.0.0.1") -> dict[str, str]:
        return environment_of_s3(f"{host}:{self.port}")

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


@contextlib.contextmanager
def postgres(addresses: str = "127.0.0.1", folder: Path | None = None) -> Iterator[Postgres]:
    """Give a running server, in an empty folder if one is named; skip the test where none is installed."""
    installed = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    if not installed:
        missing("PostgreSQL is not installed (Debian: apt-get install postgresql)")
    with tempfile.TemporaryDirectory(prefix="lensmodel-pg-") as own:  # short: a socket lies in it
        server = Postgres(installed[-1].parent, folder or Path(own), addresses)
        server.start()
        server.create("app", "jobs")
        try:
            yield server
        finally:
            with contextlib.suppress(subprocess.CalledProcessError):
                server.stop()


def main() -> None:
    """Run both until the standard input ends; print what a service of one machine needs to use them.

    For scripts: `python tests/app/servers.py BUCKET`.
    """
    bucket = sys.argv[1]
    with postgres() as server, moto(bucket) as store:
        ours = {"LENS_DATABASE_URL": server.url("app"), "LENS_STORAGE_URL": f"s3://{bucket}"}
        values = ours | store.environment()
        print(*(f"{name}={value}" for name, value in values.items()), sep="\n", flush=True)  # noqa: T201
        sys.stdin.read()


if __name__ == "__main__":
    main()
