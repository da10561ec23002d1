"""Two hosts with an API and a worker each, one PostgreSQL and one S3; one host is cut off and returns.

A host is a network namespace with a cable of its own to the servers, and a data folder of its own.
"""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import httpx2
import pytest
from crew import WORKER, check_counts, quick, states
from deadline import stretched, until
from servers import missing, moto, postgres, ready
from sqlalchemy import select, text

from app.blobs.storage import Storage
from app.runtime.doctor import examine
from app.runtime.settings import Settings
from app.store import Store
from app.store.database import Database, upgrade
from app.store.owners import ensure_owner
from app.store.tables import SampleRow

PATIENCE_S = 240.0
LEASE_S = 5.0
FENCED = 70
API_PORT = 8000
SETTINGS: dict[str, Any] = {
    "storage_url": "s3://lenses",
    "storage_seconds": 5.0,
    "lease_seconds": LEASE_S,
    "worker_slots": 2,
    "min_free_mb": 0,
}
ENVIRONMENT = {name: value for name, value in os.environ.items() if not name.startswith("LENS_")}
ENVIRONMENT.setdefault("PYTHONPATH", str(Path(__file__).parents[3]))

pytestmark = [pytest.mark.slow, pytest.mark.tools]


def ip(words: str) -> str:
    return subprocess.run(["ip", *words.split()], check=True, capture_output=True, text=True).stdout


def free_subnet() -> str:
    """Return three numbers of a network that no cable has: another run may be at work, or was killed."""
    taken = ip("-o -4 addr")
    numbers = random.sample(range(256), 256)  # two runs that begin now look at different ones first
    return next(net for net in (f"10.77.{number}" for number in numbers) if f" {net}." not in taken)


class Host:
    """A network namespace with one cable."""

    def __init__(self, number: int, folder: Path) -> None:
        self.name, self.cable = f"lensmodel-{os.getpid()}-{number}", f"lm{os.getpid() % 10**6}n{number}"
        subnet = free_subnet()
        self.gateway, self.address = f"{subnet}.1", f"{subnet}.2"
        self.data, self.log = folder / f"host{number}", folder / f"host{number}.log"
        self.data.mkdir()
        self.processes: list[subprocess.Popen[bytes]] = []
        far = f"{self.cable}b"
        for words in (
            f"netns add {self.name}",
            f"link add {self.cable} type veth peer name {far} netns {self.name}",
            f"addr add {self.gateway}/30 dev {self.cable}",
            f"link set {self.cable} up",
            f"-n {self.name} addr add {self.address}/30 dev {far}",
            f"-n {self.name} link set {far} up",
            f"-n {self.name} link set lo up",
        ):
            ip(words)

    def run(self, words: list[str], environment: dict[str, str]) -> subprocess.Popen[bytes]:
        command = ["ip", "netns", "exec", self.name, *words]
        with self.log.open("a") as log:
            self.processes.append(subprocess.Popen(command, env=environment, stderr=log))
        return self.processes[-1]

    def set_cable(self, state: str) -> None:
        ip(f"link set {self.cable} {state}")

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()
        for words in (f"link del {self.cable}", f"netns del {self.name}"):
            with contextlib.suppress(subprocess.CalledProcessError):
                ip(words)


@pytest.fixture
def hosts(tmp_path: Path) -> Iterator[list[Host]]:
    if os.geteuid() != 0 or shutil.which("ip") is None:
        missing("hosts need root and iproute2")
    with contextlib.ExitStack() as stack:
        try:
            made = [stack.enter_context(contextlib.closing(Host(number, tmp_path))) for number in (1, 2)]
        except subprocess.CalledProcessError as error:
            missing(f"network namespaces cannot be made here: {error.stderr[:200]}")
        yield made


def addresses(hosts: list[Host]) -> str:
    return ",".join(["127.0.0.1", *(host.gateway for host in hosts)])


class Site:
    """Both hosts at work, seen from the servers' side."""

    def __init__(self, store: Store, settings: Settings, hosts: list[Host]) -> None:
        self.store, self.settings, self.hosts = store, settings, hosts
        self.workers: list[subprocess.Popen[bytes]] = []
        # others can reach these: they do not start without a key
        key = {"Authorization": f"Bearer {store.accounts.create_key('local', ['write'])}"}
        self.clients = [
            httpx2.Client(base_url=f"http://{h.address}:{API_PORT}", headers=key, timeout=60.0) for h in hosts
        ]

    def are_counted(self, least: int | None = None) -> bool:
        now = states(self.store)
        return set(now) == {"counted"} if least is None else now.count("counted") >= least

    def all_run(self) -> bool:
        for host in self.hosts:
            assert not any(process.poll() for process in host.processes), host.log.read_text()[-3000:]
        live = self.store.jobs.live(LEASE_S)
        return all(map(ready, self.clients)) and len(live) == len(self.hosts)

    def makers(self) -> set[str]:
        """Return which workers made the samples."""
        with self.store.database.reading() as session:
            return {entry["estimator"] for entry in session.scalars(select(SampleRow.entry))}

    def send(self, host: int, number: int) -> dict[str, Any]:
        photo = b"\xff\xd8\xff\xe0\x00\x10JFIF\x00" + number.to_bytes(4, "big") * 20
        answer = self.clients[host].post("/v1/photos", files={"file": (f"{number}.jpg", photo)})
        assert answer.status_code == 202, answer.text
        return answer.json()


@pytest.fixture
def site(hosts: list[Host], tmp_path: Path) -> Iterator[Site]:
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(postgres(addresses(hosts)))
        s3 = stack.enter_context(moto("lenses", "0.0.0.0"))
        stack.enter_context(mock.patch.dict(os.environ, s3.environment()))
        here = Settings(data_dir=tmp_path / "here", database_url=server.url("app"), **SETTINGS)
        store = stack.enter_context(contextlib.closing(Store(here)))
        upgrade(store.database)
        made = Site(store, here, hosts)
        for host, client in zip(hosts, made.clients, strict=True):
            stack.enter_context(client)
            own = {"data_dir": host.data, "database_url": server.url("app", host.gateway), "port": API_PORT}
            own |= {"host": host.address, "sandbox": "try", "allowed_hosts": "localhost"}
            ours = {f"LENS_{name.upper()}": str(value) for name, value in (SETTINGS | own).items()}
            environment = {**ENVIRONMENT, **ours, **s3.environment(host.gateway), **quick(ENVIRONMENT)}
            host.run([sys.executable, "-m", "lensmodel", "api"], environment)
            made.workers.append(host.run(WORKER, environment))
        until(made.all_run, within_s=PATIENCE_S)
        yield made


def test_two_hosts_share_the_photos_and_one_may_be_cut_off_and_return(site: Site) -> None:
    first, log = site.send(0, 0), site.hosts[0].log
    until(site.are_counted, log, PATIENCE_S)
    seen = site.clients[1].get(f"/v1/photos/{first['id']}").json()
    assert seen["state"] == "counted"  # either API tells of all

    sent = [site.send(number % 2, number) for number in range(1, 9)]
    until(lambda: site.are_counted(2), log, PATIENCE_S)
    site.hosts[1].set_cable("down")
    until(site.are_counted, log, PATIENCE_S)  # the other one finishes all
    alone = len(site.store.jobs.live(LEASE_S))
    site.hosts[1].set_cable("up")
    until(lambda: site.workers[1].poll() is not None, log, PATIENCE_S)  # late: it must not go on

    assert len(site.makers()) == 2  # both have worked
    assert alone == 1
    assert site.workers[1].returncode == FENCED
    assert site.workers[0].poll() is None
    until(lambda: ready(site.clients[1]), site.hosts[1].log, PATIENCE_S)  # its API is of use again
    check_counts(site.store, 1 + len(sent))
    assert examine(site.settings, site.store, Storage(site.settings.storage)) == []


# Holds a row of the first owner in a transaction without end
HOLDS = """
import sys, time
from pathlib import Path
from sqlalchemy import text
from app.store.database import Database

with Database(sys.argv[1]).writing() as session:
    session.execute(text("UPDATE owner SET name = name"))
    Path(sys.argv[2]).touch()
    time.sleep(600)
"""


def test_what_a_host_has_locked_is_free_again_once_it_was_cut_off(hosts: list[Host], tmp_path: Path) -> None:
    with postgres(addresses(hosts)) as server, contextlib.closing(Database(server.url("app"))) as database:
        upgrade(database)
        with database.writing() as session:
            ensure_owner(session, "local")
        held, url = tmp_path / "held", server.url("app", hosts[0].gateway)
        hosts[0].run([sys.executable, "-c", HOLDS, url, str(held)], ENVIRONMENT)
        until(held.exists, hosts[0].log, PATIENCE_S)

        hosts[0].set_cable("down")
        with database.writing() as session:
            session.execute(text(f"SET LOCAL lock_timeout = '{stretched(PATIENCE_S):.0f}s'"))
            assert session.connection().execute(text("UPDATE owner SET name = name")).rowcount == 1
