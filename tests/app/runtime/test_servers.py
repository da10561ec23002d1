"""On PostgreSQL and S3 as on files: an installation works, is examined, and outlasts deaths and outages."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path
from unittest import mock

import pytest
from conftest import Steps
from servers import moto, postgres
from torture import torture

from app.blobs.storage import Storage
from app.runtime import metrics
from app.runtime.doctor import examine
from app.runtime.settings import Settings
from app.store import Store, database


@pytest.mark.tools
def test_an_installation_works_on_servers(settings: Settings) -> None:
    with postgres() as server, moto("lenses") as s3, mock.patch.dict(os.environ, s3.environment()):
        addresses = {"database_url": server.url("app"), "storage_url": "s3://lenses/here"}
        away = settings.model_copy(update=addresses)
        with closing(Store(away)) as store:
            database.upgrade(store.database)
            steps, blobs = Steps(store), Storage(away.storage)
            for photo in (steps.counted(), steps.counted(width=1.1), steps.receive()):
                blobs.put(photo.blob_key, b"m" * photo.byte_size)

            assert steps.learned(steps.counted())[0].version == 3
            found = {finding.check for finding in examine(away, store, blobs, deep=True)}
            assert found == {
                "blobs",
                "files",
                "work",
            }  # of one photo there is no file, the others are made up
            assert b"lensmodel_queue_jobs{" in metrics.of_service(store, 20.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("servers_too", "kills"), [(False, 20), pytest.param(True, 6, marks=pytest.mark.tools)]
)
def test_deaths_and_outages_lose_nothing_and_count_nothing_twice(
    servers_too: bool, kills: int, tmp_path: Path
) -> None:
    said = torture(tmp_path, 5, servers=servers_too, photos=4, kills=kills, outages=2)

    assert "4 of 4 photos counted once" in said
