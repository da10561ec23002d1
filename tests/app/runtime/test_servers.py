"""On PostgreSQL and S3 as on files: an installation works, is examined, and outlasts deaths and outages."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from servers import Moto, Postgres, moto, postgres
from torture import Plan, in_environment, torture

from app.blobs.storage import Storage
from app.runtime import metrics
from app.runtime.doctor import examine
from app.runtime.settings import Settings
from app.store import Store, database

pytestmark = pytest.mark.tools


@pytest.fixture(scope="module")
def servers() -> Iterator[tuple[Postgres, Moto]]:
    with postgres() as server, moto("lenses") as s3, in_environment(s3.environment):
        yield server, s3


@pytest.fixture
def far(servers: tuple[Postgres, Moto], tmp_path: Path) -> Iterator[tuple[Settings, Store, Storage]]:
    """Give an empty installation on the servers."""
    server, _ = servers
    name = f"app{abs(hash(tmp_path)) % 10**9}"
    server.create(name)
    settings = Settings(
        data_dir=tmp_path / "far",
        database_url=server.url(name),
        storage_url=f"s3://lenses/{name}",
        min_free_mb=0,
    )
    with closing(Store(settings)) as store:
        database.upgrade(store.database)
        yield settings, store, Storage(settings.storage)


def test_an_installation_works_on_servers(steps: Any, far: tuple[Settings, Store, Storage]) -> None:
    away, there, blobs = far
    busy = type(steps)(there)
    for photo in (busy.counted(), busy.counted(width=1.1), busy.receive()):
        blobs.put(photo.blob_key, b"m" * photo.byte_size)

    assert there.lenses.samples_of(busy.lens_id(busy.counted()))[0].version == 3
    found = {finding.check for finding in examine(away, there, blobs, deep=True)}
    assert found == {"blobs", "files", "work"}  # of one photo there is no file, the others are made up
    assert b"lensmodel_queue_jobs{" in metrics.of_service(there, 20.0)


@pytest.mark.slow
@pytest.mark.parametrize("servers_too", [False, True], ids=["files", "servers"])
def test_deaths_and_outages_lose_nothing_and_count_nothing_twice(servers_too: bool, tmp_path: Path) -> None:
    said = torture(tmp_path, 5, servers=servers_too, plan=Plan(photos=4, kills=6, outages=2))

    assert "4 of 4 photos counted once" in said
