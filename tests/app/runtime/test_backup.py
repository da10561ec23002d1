"""Backups of installations at work, and installations that go on from them."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Steps
from typer.testing import CliRunner

from app.blobs.storage import Storage
from app.errors import ServiceError
from app.runtime import backup as copies
from app.runtime.doctor import examine
from app.runtime.settings import Settings
from app.store import Store
from app.store.database import Database
from app.store.jobs import Job
from app.store.owners import ANY_OWNER
from app.store.tables import PhotoRow
from lensmodel.cli.main import app
from lensmodel.core.errors import InvalidInputError

Made = Callable[[], dict[str, Any]]


@pytest.fixture
def photos(steps: Steps, storage: Storage) -> list[PhotoRow]:
    made = [steps.counted(), steps.counted(width=1.3), steps.receive()]
    for photo in made:
        storage.put(photo.blob_key, photo.public_id.encode().ljust(photo.byte_size))
    return made


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "backup"


@pytest.fixture
def backup(photos: list[PhotoRow], store: Store, storage: Storage, folder: Path) -> Made:
    return partial(copies.backup, store.database, storage, folder)


@contextmanager
def opened(folder: Path) -> Iterator[tuple[Settings, Store, Storage]]:
    settings = Settings(data_dir=folder, min_free_mb=0)
    with closing(Store(settings)) as store:
        yield settings, store, Storage(settings.storage, create=False)


def kernels(store: Store, lens_id: str) -> np.ndarray:
    return np.stack([sample.kernel for sample in store.lenses.samples_of(lens_id)[1]])


def test_a_service_goes_on_from_a_backup(
    backup: Made, photos: list[PhotoRow], store: Store, steps: Steps, storage: Storage, folder: Path
) -> None:
    lens_id = steps.lens_id(photos[0])

    made = backup()

    assert (made["photos"], made["blobs"]) == (3, 3)
    with opened(folder) as (settings, new, blobs):
        assert new.lenses.samples_of(lens_id)[0] == store.lenses.samples_of(lens_id)[0]
        np.testing.assert_array_equal(kernels(new, lens_id), kernels(store, lens_id))
        for photo in photos:
            assert blobs.get(photo.blob_key) == storage.get(photo.blob_key)
        photo = Job("photo", (photos[2].public_id, 1), "local")  # work goes on there
        assert new.jobs.to_do() == store.jobs.to_do() == [Job("measure", (lens_id, 2)), photo]
        assert [f.check for f in examine(settings, new, blobs)] == ["work"]


def test_a_second_backup_brings_the_first_up_to_date(
    backup: Made, photos: list[PhotoRow], store: Store, steps: Steps, storage: Storage, folder: Path
) -> None:
    backup()
    store.photos.delete(photos[0].public_id, "local")
    assert store.photos.give_up_file(photos[1].public_id, ())  # which is no hindrance
    for gone in photos[:2]:
        storage.delete(gone.folder)
    more = steps.counted()
    storage.put(more.blob_key, b"m" * more.byte_size)

    assert backup()["blobs"] == 2

    for gone in photos[:2]:
        assert not (folder / copies.BLOBS / gone.blob_key).exists()
    with opened(folder) as (_, new, blobs):
        assert new.photos.get(photos[0].public_id, ANY_OWNER) is None
        assert blobs.get(more.blob_key) == b"m" * more.byte_size


def test_a_backup_under_load_has_every_blob_that_its_rows_name(
    photos: list[PhotoRow], store: Store, steps: Steps, storage: Storage, tmp_path: Path
) -> None:
    stop = threading.Event()

    def come_and_go() -> None:
        while not stop.is_set():
            photo = steps.receive()
            storage.put(photo.blob_key, b"x" * photo.byte_size)
            store.photos.delete(photo.public_id, "local")
            storage.delete(photo.folder)  # at once, and not minutes later as the workers do

    busy = threading.Thread(target=come_and_go)
    busy.start()
    try:
        for number in range(3):
            copies.backup(store.database, storage, tmp_path / f"backup{number}")
    except ServiceError:
        pass  # five times in a row a photo came between two steps: said, and nothing half is left
    finally:
        stop.set()
        busy.join()

    whole = [path.parent for path in tmp_path.glob(f"backup*/{copies.ROWS}")]
    assert whole
    for folder in whole:
        with opened(folder) as (settings, new, blobs):
            found = examine(settings, new, blobs)
        assert not [f for f in found if f.check == "blobs" and "missing" in f.says]


def test_rows_without_their_blobs_are_no_backup(
    backup: Made, photos: list[PhotoRow], storage: Storage, folder: Path
) -> None:
    storage.delete(photos[1].folder)

    with pytest.raises(ServiceError, match=photos[1].public_id):
        backup()

    assert not (folder / copies.ROWS).exists()


def test_the_command_makes_a_data_folder(photos: list[PhotoRow], settings: Settings, folder: Path) -> None:
    made = CliRunner().invoke(app, ["backup", str(folder), "--data", str(settings.data_dir)])
    checked = CliRunner().invoke(app, ["doctor", "--deep", "--data", str(folder), "--json"])

    assert made.exit_code == 0, made.output
    assert f"{folder}: 3 photos and " in made.stdout
    assert {finding["check"] for finding in json.loads(checked.stdout)["findings"]} <= {"work", "files"}


def test_rows_of_a_server_are_left_to_its_own_means(storage: Storage, folder: Path) -> None:
    with (
        closing(Database("postgresql+psycopg://lens@db/lens")) as server,
        pytest.raises(InvalidInputError, match="pg_dump"),
    ):
        copies.backup(server, storage, folder)
