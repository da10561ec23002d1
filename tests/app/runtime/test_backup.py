"""Backups of installations at work, and installations from backups."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from app.blobs.storage import Storage
from app.runtime import backup as copies
from app.runtime.doctor import examine
from app.runtime.settings import Settings
from app.store import Store
from app.store.access.owners import ANY_OWNER
from app.store.tables import PhotoRow
from lensmodel.cli.main import app
from lensmodel.core.errors import InvalidInputError


@pytest.fixture
def storage(settings: Settings) -> Storage:
    return Storage(settings.storage)


@pytest.fixture
def photos(store: Store, steps: Any, storage: Storage) -> list[PhotoRow]:
    made = [steps.counted(), steps.counted(width=1.3), steps.receive()]
    for photo in made:
        storage.put(photo.blob_key, photo.public_id.encode().ljust(photo.byte_size))
    return made


@contextmanager
def empty(folder: Path) -> Iterator[tuple[Settings, Store, Storage]]:
    settings = Settings(data_dir=folder, min_free_mb=0)
    folder.mkdir()
    with closing(Store(settings)) as store:
        yield settings, store, Storage(settings.storage)


def kernels(store: Store, lens_id: str) -> np.ndarray:
    _, samples = store.samples.of_lens(lens_id)
    return np.stack([stored.sample.kernel for stored in samples])


def test_what_is_restored_is_what_was_backed_up(
    photos: list[PhotoRow], store: Store, steps: Any, storage: Storage, tmp_path: Path
) -> None:
    lens_id = steps.lens_id(photos[0])

    made = copies.backup(store.database, storage, tmp_path / "backup")
    with empty(tmp_path / "new") as (settings, new, blobs):
        rows = copies.restore(tmp_path / "backup", new.database, blobs)

        assert rows["photo"] == 3
        assert made.blobs == 3
        assert new.samples.of_lens(lens_id)[0] == store.samples.of_lens(lens_id)[0]
        np.testing.assert_array_equal(kernels(new, lens_id), kernels(store, lens_id))
        assert [blobs.get(photo.blob_key) for photo in photos] == [
            storage.get(photo.blob_key) for photo in photos
        ]
        assert [row[0] for row in new.photos.to_do()] == [photos[2].public_id]  # work goes on there
        assert new.lenses.unmeasured() == store.lenses.unmeasured() == [(lens_id, 2)]
        assert [f.check for f in examine(settings, new, blobs).open] == ["work"]


def test_a_second_backup_brings_the_first_up_to_date(
    photos: list[PhotoRow], store: Store, steps: Any, storage: Storage, tmp_path: Path
) -> None:
    copies.backup(store.database, storage, tmp_path / "backup")
    store.photos.delete(photos[0].public_id, "local")
    storage.delete(f"photos/{photos[0].public_id}/")
    more = steps.counted()
    storage.put(more.blob_key, b"m" * more.byte_size)

    made = copies.backup(store.database, storage, tmp_path / "backup")

    assert made.blobs == 3
    assert len(list((tmp_path / "backup").glob("rows-*.db"))) == 1
    assert not (tmp_path / "backup" / copies.BLOBS / photos[0].blob_key).exists()
    with empty(tmp_path / "new") as (_, new, blobs):
        copies.restore(tmp_path / "backup", new.database, blobs)
        assert new.photos.get(photos[0].public_id, ANY_OWNER) is None
        assert blobs.get(more.blob_key) == b"m" * more.byte_size


def test_a_backup_under_load_has_every_blob_that_its_rows_name(
    photos: list[PhotoRow], store: Store, steps: Any, storage: Storage, tmp_path: Path
) -> None:
    stop = threading.Event()

    def come_and_go() -> None:
        while not stop.is_set():
            photo = steps.receive()
            storage.put(photo.blob_key, b"x" * photo.byte_size)
            store.photos.delete(photo.public_id, "local")
            storage.delete(f"photos/{photo.public_id}/")  # at once, and not minutes later as the workers do

    busy = [threading.Thread(target=come_and_go)]
    for thread in busy:
        thread.start()
    try:
        for number in range(3):
            copies.backup(store.database, storage, tmp_path / f"backup{number}")
    except copies.BackupError:
        pass  # five times in a row a photo came between two steps: said, and nothing half is left
    finally:
        stop.set()
        for thread in busy:
            thread.join()

    whole = [path.parent for path in tmp_path.glob("backup*/backup.json")]
    assert whole
    for number, folder in enumerate(whole):
        with empty(tmp_path / f"new{number}") as (settings, new, blobs):
            copies.restore(folder, new.database, blobs)
            assert not [
                f for f in examine(settings, new, blobs).open if f.check == "blobs" and "missing" in f.says
            ]


def test_rows_without_their_blobs_are_no_backup(
    photos: list[PhotoRow], store: Store, storage: Storage, tmp_path: Path
) -> None:
    storage.delete(f"photos/{photos[1].public_id}/")

    with pytest.raises(copies.BackupError, match=photos[1].public_id):
        copies.backup(store.database, storage, tmp_path / "backup")

    assert not (tmp_path / "backup" / copies.MANIFEST).exists()


@pytest.mark.parametrize("damage", ["rows", "blob", "manifest"])
def test_a_damaged_backup_is_refused_and_nothing_is_changed(
    damage: str, photos: list[PhotoRow], store: Store, storage: Storage, tmp_path: Path
) -> None:
    folder = tmp_path / "backup"
    copies.backup(store.database, storage, folder)
    if damage == "rows":
        with next(folder.glob("rows-*.db")).open("r+b") as file:
            file.seek(5000)
            file.write(b"!")
    elif damage == "blob":
        (folder / copies.BLOBS / photos[0].blob_key).write_bytes(b"short")
    else:
        (folder / copies.MANIFEST).write_text("{")

    with empty(tmp_path / "new") as (_, new, blobs):
        with pytest.raises(copies.BackupError):
            copies.restore(folder, new.database, blobs)
        assert list(blobs.listed()) == []


def test_an_installation_that_is_in_use_is_not_overwritten(
    photos: list[PhotoRow], store: Store, storage: Storage, tmp_path: Path
) -> None:
    copies.backup(store.database, storage, tmp_path / "backup")

    with pytest.raises(InvalidInputError, match="not empty"):
        copies.restore(tmp_path / "backup", store.database, storage)


def test_the_commands_back_up_restore_and_move(
    photos: list[PhotoRow], settings: Settings, store: Store, tmp_path: Path
) -> None:
    folder, new, moved = tmp_path / "backup", tmp_path / "new", tmp_path / "moved"
    moved.mkdir()
    target = f"sqlite:///{moved}/rows.db"

    ran = [
        CliRunner().invoke(app, arguments)
        for arguments in (
            ["backup", str(folder), "--data", str(settings.data_dir), "--json"],
            ["restore", str(folder), "--data", str(new)],
            ["migrate", "--to", target, "--storage", f"file://{moved}/blobs", "--data", str(new)],
            ["migrate", "--to", target, "--data", str(new)],
        )
    ]

    assert [result.exit_code for result in ran[:3]] == [0, 0, 0], "".join(result.output for result in ran)
    assert json.loads(ran[0].stdout)["rows"]["photo"] == 3
    assert f"LENS_DATABASE_URL={target}" in ran[2].stdout
    assert "give an empty database" in str(ran[3].exception)
    there = Settings(data_dir=moved, database_url=target, storage_url=f"file://{moved}/blobs")
    with closing(Store(there)) as opened:
        found = opened.photos.get(photos[0].public_id, ANY_OWNER)
        assert found is not None
        assert found.state == "counted"
        assert Storage(there.storage).get(photos[0].blob_key).startswith(photos[0].public_id.encode())


def test_nothing_is_moved_while_a_worker_lives(
    photos: list[PhotoRow], settings: Settings, store: Store, tmp_path: Path
) -> None:
    store.workers.register("w", host="elsewhere", pid=1, pid_started=1.0)

    result = CliRunner().invoke(
        app, ["migrate", "--to", f"sqlite:///{tmp_path}/x.db", "--data", str(settings.data_dir)]
    )

    assert "stop them all" in str(result.exception)


def test_photos_whose_file_is_not_kept_are_no_hindrance(
    photos: list[PhotoRow], store: Store, storage: Storage, tmp_path: Path
) -> None:
    assert store.photos.give_up_file(photos[0].public_id, ())
    storage.delete(f"photos/{photos[0].public_id}/")

    assert copies.backup(store.database, storage, tmp_path / "backup").blobs == 2
