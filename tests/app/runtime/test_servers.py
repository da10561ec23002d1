"""On PostgreSQL and S3 as on files: an installation moves there and back, is backed up and examined there."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from servers import Moto, Postgres, moto, postgres
from torture import Plan, in_environment, torture

from app.blobs.storage import Storage
from app.runtime import backup as copies
from app.runtime.doctor import examine
from app.runtime.metrics import Tables
from app.runtime.settings import Settings
from app.store import Store
from app.store.tables import PhotoRow

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
        jobs_url=server.url("jobs"),
        storage_url=f"s3://lenses/{name}",
        min_free_mb=0,
    )
    with closing(Store(settings)) as store:
        yield settings, store, Storage(settings.storage)


@pytest.fixture
def photos(settings: Settings, store: Store, steps: Any) -> list[PhotoRow]:
    made = [steps.counted(), steps.counted(width=1.3), steps.receive()]
    storage = Storage(settings.storage)
    for photo in made:
        storage.put(photo.blob_key, photo.public_id.encode().ljust(photo.byte_size))
    return made


def test_an_installation_moves_to_servers_works_there_and_moves_back(
    settings: Settings,
    store: Store,
    photos: list[PhotoRow],
    steps: Any,
    far: tuple[Settings, Store, Storage],
    tmp_path: Path,
) -> None:
    away, there, blobs = far
    lens_id = steps.lens_id(photos[0])

    copies.move((store.database, Storage(settings.storage)), (there.database, blobs))

    assert [
        finding.check for finding in examine(away, there, blobs, deep=True).open if finding.check != "photos"
    ] == ["work"]
    assert there.samples.of_lens(lens_id)[0] == store.samples.of_lens(lens_id)[0]
    assert blobs.get(photos[0].blob_key) == Storage(settings.storage).get(photos[0].blob_key)
    busy = type(steps)(there)
    busy._numbers = itertools.count(100)  # other bytes than those of the first photos
    more = busy.counted(width=1.1)  # keys go on behind those that were copied
    blobs.put(more.blob_key, b"m" * more.byte_size)
    assert there.samples.of_lens(lens_id)[0].version == 3
    assert next(iter(Tables(there, 20.0).collect())).samples

    folder = tmp_path / "backup"
    copies.backup(there.database, blobs, folder)
    home = Settings(data_dir=tmp_path / "home", min_free_mb=0)
    with closing(Store(home)) as back:
        copies.restore(folder, back.database, Storage(home.storage))
        assert back.samples.of_lens(lens_id)[0] == there.samples.of_lens(lens_id)[0]
        assert [finding.check for finding in examine(home, back, Storage(home.storage)).open] == ["work"]


@pytest.mark.slow
@pytest.mark.parametrize("servers_too", [False, True], ids=["files", "servers"])
def test_deaths_and_outages_lose_nothing_and_count_nothing_twice(servers_too: bool, tmp_path: Path) -> None:
    said = torture(tmp_path, 5, servers=servers_too, plan=Plan(photos=4, kills=6, outages=2))

    assert "4 of 4 photos counted once" in said
