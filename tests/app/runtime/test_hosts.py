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
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest
from deadline import Deadline, stretched
from quick_tasks import CELLS
from servers import missing, moto, postgres
from sqlalchemy import select, text
from torture import in_environment

from app.blobs.storage import Storage
from app.runtime.doctor import examine
from app.runtime.settings import Settings
from app.store import Store
from app.store.database import Database, upgrade
from app.store.owners import ensure_owner
from app.store.tables import PhotoRow, SampleRow

HERE = Path(__file__).parents[1]
STAND_INS = HERE / "stand_ins"
PATIENCE_S = 240.0
LEASE_S = 5.0
FENCED = 70
API_PORT = 8000
BUCKET = "lenses"

pytestmark = [pytest.mark.slow, pytest.mark.tools]


def ip(*words: str) -> str:
    return subprocess.run(["ip", *words], check=True, capture_output=True, text=True).stdout


def free_subnet() -> str:
    """Return three numbers of a network that no cable has: another run may be at work, or was killed."""
    taken = ip("-o", "-4", "addr")
    return next(
        net
        for number in random.sample(
            range(256), 256
        )  # not the first: two runs that begin now look at the same
        if f" {(net := f'10.77.{number}')}." not in taken
    )


class Host:
    """A network namespace with one cable."""

    def __init__(self, number: int, folder: Path) -> None:
        self.name, self.cable = f"lensmodel-{os.getpid()}-{number}", f"lm{os.getpid() % 10**6}n{number}"
        subnet = free_subnet()
        self.gateway, self.address = f"{subnet}.1", f"{subnet}.2"
        self.data = folder / f"host{number}"
        self.log = folder / f"host{number}.log"
        self.data.mkdir()
        self.processes: list[subprocess.Popen[bytes]] = []
        far = f"{self.cable}b"
        ip("netns", "add", self.name)
        ip("link", "add", self.cable, "type", "veth", "peer", "name", far)
        ip("link", "set", far, "netns", self.name)
        ip("addr", "add", f"{self.gateway}/30", "dev", self.cable)
        ip("link", "set", self.cable, "up")
        ip("-n", self.name, "addr", "add", f"{self.address}/30", "dev", far)
        ip("-n", self.name, "link", "set", far, "up")
        ip("-n", self.name, "link", "set", "lo", "up")

    def run(self, words: list[str], environment: dict[str, str]) -> subprocess.Popen[bytes]:
        with self.log.open("a") as log:
            process = subprocess.Popen(
                ["ip", "netns", "exec", self.name, sys.executable, *words], env=environment, stderr=log
            )
        self.processes.append(process)
        return process

    def cut_off(self) -> None:
        ip("link", "set", self.cable, "down")

    def reconnect(self) -> None:
        ip("link", "set", self.cable, "up")

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()
        for words in (("link", "del", self.cable), ("netns", "del", self.name)):
            with contextlib.suppress(subprocess.CalledProcessError):
                ip(*words)


@pytest.fixture
def hosts(tmp_path: Path) -> Iterator[list[Host]]:
    if os.geteuid() != 0 or shutil.which("ip") is None:
        missing("hosts need root and iproute2")
    made: list[Host] = []
    try:
        try:
            made += [Host(1, tmp_path)]
        except subprocess.CalledProcessError as error:
            missing(f"network namespaces cannot be made here: {error.stderr[:200]}")
        made += [Host(2, tmp_path)]
        yield made
    finally:
        for host in made:
            host.close()


class Installation:
    """Both hosts at work, seen from the servers' side."""

    def __init__(self, store: Store, storage: Storage, settings: Settings, hosts: list[Host]) -> None:
        self.store, self.storage, self.settings, self.hosts = store, storage, settings, hosts
        self.workers: list[subprocess.Popen[bytes]] = []
        key = store.accounts.create_key(
            "local", ["write"]
        )  # others can reach these: they do not start without
        self.clients = [
            httpx2.Client(
                base_url=f"http://{h.address}:{API_PORT}",
                headers={"Authorization": f"Bearer {key}"},
                timeout=60.0,
            )
            for h in hosts
        ]

    def until(self, condition: Callable[[], object]) -> None:
        end = time.monotonic() + stretched(PATIENCE_S)
        while not condition():
            assert time.monotonic() < end, self.logs()
            time.sleep(0.1)

    def logs(self) -> str:
        return "\n".join(host.log.read_text()[-3000:] for host in self.hosts)

    def all_run(self) -> bool:
        ended = [process.returncode for host in self.hosts for process in host.processes if process.poll()]
        assert not ended, self.logs()
        return all(ready(client) for client in self.clients)

    def states(self) -> list[str]:
        with self.store.database.reading() as session:
            return list(session.scalars(select(PhotoRow.state)))

    def makers(self) -> set[str]:
        """Return which workers made the samples."""
        with self.store.database.reading() as session:
            return {entry["estimator"] for entry in session.scalars(select(SampleRow.entry))}

    def send(self, host: int, number: int) -> dict[str, Any]:
        photo = b"\xff\xd8\xff\xe0\x00\x10JFIF\x00" + number.to_bytes(4, "big") * 20
        answer = self.clients[host].post("/v1/photos", files={"file": (f"{number}.jpg", photo)})
        assert answer.status_code == 202, answer.text
        found: dict[str, Any] = answer.json()
        return found


@pytest.fixture
def installed(hosts: list[Host], tmp_path: Path) -> Iterator[Installation]:
    addresses = ",".join(["127.0.0.1", *(host.gateway for host in hosts)])
    with postgres(addresses) as server, moto(BUCKET, "0.0.0.0") as s3, in_environment(s3.environment):
        common: dict[str, Any] = {
            "storage_url": f"s3://{BUCKET}",
            "storage_seconds": 5.0,
            "lease_seconds": LEASE_S,
            "worker_slots": 2,
            "min_free_mb": 0,
        }
        here = Settings(data_dir=tmp_path / "here", database_url=server.url("app"), **common)
        store = Store(here)
        upgrade(store.database)
        site = Installation(store, Storage(here.storage), here, hosts)
        for host in hosts:
            variables = {f"LENS_{name.upper()}": str(value) for name, value in common.items()}
            environment = {
                **{k: v for k, v in os.environ.items() if not k.startswith("LENS_")},
                **variables,
                **s3.environment_at(host.gateway),
                "LENS_DATA_DIR": str(host.data),
                "LENS_DATABASE_URL": server.url("app", host.gateway),
                "LENS_HOST": host.address,
                "LENS_PORT": str(API_PORT),
                "LENS_SANDBOX": "try",  # whatever this machine has
                "LENS_ALLOWED_HOSTS": "localhost",
                "PYTHONPATH": os.pathsep.join(
                    [str(STAND_INS), os.environ.get("PYTHONPATH", str(HERE.parents[1]))]
                ),
            }
            host.run(["-m", "lensmodel", "api"], environment)
            site.workers.append(host.run([str(STAND_INS / "quick_worker.py")], environment))
        try:
            site.until(site.all_run)
            site.until(lambda: len(store.jobs.live(LEASE_S)) == len(hosts))
            yield site
        finally:
            for client in site.clients:
                client.close()
            store.close()


def ready(client: httpx2.Client) -> bool:
    with contextlib.suppress(httpx2.HTTPError):
        return client.get("/readyz").status_code == 200
    return False


def test_two_hosts_share_the_photos_and_one_may_be_cut_off_and_return(installed: Installation) -> None:
    first = installed.send(0, 0)
    installed.until(lambda: installed.states() == ["counted"])
    seen = installed.clients[1].get(f"/v1/photos/{first['id']}").json()
    assert seen["state"] == "counted"  # either API tells of all

    sent = [installed.send(number % 2, number) for number in range(1, 9)]
    installed.until(lambda: installed.states().count("counted") >= 2)
    installed.hosts[1].cut_off()
    installed.until(lambda: set(installed.states()) == {"counted"})  # the other one finishes all
    alone = len(installed.store.jobs.live(LEASE_S))
    installed.hosts[1].reconnect()
    installed.until(lambda: installed.workers[1].poll() is not None)  # late: it must not go on

    photos = 1 + len(sent)
    assert len(installed.makers()) == 2  # both have worked
    assert alone == 1
    assert installed.workers[1].returncode == FENCED
    assert installed.workers[0].poll() is None
    installed.until(lambda: ready(installed.clients[1]))  # its API is of use again
    lens = installed.store.lenses.page("local", before=None, limit=2)
    assert [(one.version, one.photo_count, one.sample_count) for one in lens] == [
        (photos, photos, photos * CELLS * 3)
    ]
    assert examine(installed.settings, installed.store, installed.storage) == []


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
    environment = {**os.environ, "PYTHONPATH": os.environ.get("PYTHONPATH", str(HERE.parents[1]))}
    with postgres(",".join(["127.0.0.1", *(host.gateway for host in hosts)])) as server:
        database = Database(server.url("app"))
        upgrade(database)
        with database.writing() as session:
            ensure_owner(session, "local")
        held = tmp_path / "held"
        hosts[0].run(["-c", HOLDS, server.url("app", hosts[0].gateway), str(held)], environment)
        deadline = Deadline(PATIENCE_S)
        while not held.exists():
            assert not deadline.passed(), hosts[0].log.read_text()
            time.sleep(0.1)

        hosts[0].cut_off()
        with database.writing() as session:
            session.execute(text(f"SET LOCAL lock_timeout = '{stretched(PATIENCE_S):.0f}s'"))
            assert session.connection().execute(text("UPDATE owner SET name = name")).rowcount == 1
        database.close()
