"""Backups that installations go on from, and the doctor: sound ones pass, each kind of damage is found."""

from __future__ import annotations

import hashlib
import json
import random
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Steps
from sqlalchemy import text
from sqlalchemy.exc import IntegrityError
from typer.testing import CliRunner

from app.blobs.storage import Storage
from app.errors import ServiceError
from app.runtime import backup as copies
from app.runtime.doctor import Violation, broken, examine
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
    # five times in a row a photo may come between two steps: said, and nothing half is left
    with suppress(ServiceError):
        for number in range(3):
            copies.backup(store.database, storage, tmp_path / f"backup{number}")
    stop.set()
    busy.join()

    whole = [path.parent for path in tmp_path.glob(f"backup*/{copies.ROWS}")]
    assert whole
    for folder in whole:
        with opened(folder) as (settings, new, blobs):
            found = examine(settings, new, blobs)
        assert not [f for f in found if f.check == "blobs" and "missing" in f.says]


def test_rows_without_blobs_are_refused(
    backup: Made, photos: list[PhotoRow], storage: Storage, folder: Path
) -> None:
    storage.delete(photos[1].folder)

    with pytest.raises(ServiceError, match=photos[1].public_id):
        backup()

    assert not (folder / copies.ROWS).exists()


def test_rows_of_a_server_are_left_to_its_own_means(storage: Storage, folder: Path) -> None:
    with (
        closing(Database("postgresql+psycopg://lens@db/lens")) as server,
        pytest.raises(InvalidInputError, match="pg_dump"),
    ):
        copies.backup(server, storage, folder)


# --- the doctor -------------------------------------------------------------------------------

Examined = Callable[..., list[Violation]]


@pytest.fixture
def sound(store: Store, steps: Steps, storage: Storage) -> list[PhotoRow]:
    """Make an installation with photos in all kinds of states, all as it must be."""
    store.lenses.create("another owner", "theirs")
    counted = [steps.counted(), steps.counted(width=1.2)]
    excluded, deleted, failed, given_up = steps.counted(), steps.counted(), steps.receive(), steps.counted()
    for out in (True, False, True):
        assert store.photos.change([excluded.public_id], "local", {}, excluded=out)
    store.photos.delete(deleted.public_id, "local")
    store.photos.fail(failed.public_id, 1, "no_usable_patches", "too dark")
    assert store.photos.give_up_file(given_up.public_id, ())
    for photo in (*counted, excluded, failed):
        storage.put(photo.blob_key, b"x" * photo.byte_size)
    return counted


@pytest.fixture
def examined(settings: Settings, store: Store, storage: Storage) -> Examined:
    return partial(examine, settings, store, storage)


def test_a_sound_installation_passes_every_check(sound: list[PhotoRow], examined: Examined) -> None:
    assert examined() == []


@pytest.mark.parametrize(
    ("check", "damage"),
    [
        ("the version of a lens is the number of its events", "DELETE FROM calibration_event"),
        (
            "each counted photo joined its lens by an event",
            "UPDATE calibration_event SET kind = 'photo_changed'",
        ),
        ("lenses count their samples and photos rightly", "UPDATE lens SET sample_count = 999"),
        ("exactly the samples of counted photos count", "UPDATE psf_sample SET lens_id = NULL"),
        ("exactly the samples of counted photos count", "UPDATE psf_sample SET version_added = 999"),
        ("patches are done exactly if they have samples", "DELETE FROM psf_sample"),
        ("patches are done exactly if they have samples", "UPDATE patch SET state = 'pending'"),
        ("photos count their patches rightly", "UPDATE photo SET patches_done = 77"),
        ("counted photos have a lens, failed ones a reason", "UPDATE photo SET lens_id = NULL"),
        ("photos teach lenses of their owner", "UPDATE photo SET lens_id = (SELECT min(id) FROM lens)"),
    ],
)
def test_damage_to_the_tables_is_found(
    check: str, damage: str, sound: list[PhotoRow], store: Store, examined: Examined
) -> None:
    with store.database.writing() as session:
        session.execute(text(damage))

    assert f"not so: {check}" in {finding.says for finding in examined()}


def test_missing_and_torn_photos_are_found(
    sound: list[PhotoRow], storage: Storage, examined: Examined
) -> None:
    storage.delete(sound[0].folder)
    storage.put(sound[1].blob_key, b"torn")

    assert {finding.subject: finding.says for finding in examined()} == {
        sound[0].public_id: "the file of the photo is missing",
        sound[1].public_id: "the file of the photo is 4 bytes instead of 1000",
    }


def test_blobs_that_nobody_names_are_found_unless_they_are_to_be_deleted(
    storage: Storage, store: Store, examined: Examined
) -> None:
    storage.put("photos/NOBODY/original", b"x")
    assert [finding.subject for finding in examined()] == ["photos/NOBODY/"]

    store.photos.expect("photos/NOBODY/", within=timedelta(0))

    assert examined() == []


def test_changed_bytes_are_found_by_reading_all(
    sound: list[PhotoRow], store: Store, examined: Examined
) -> None:
    with store.database.writing() as session:
        session.execute(text("UPDATE psf_sample SET psf = zeroblob(900)"))

    assert examined() == []
    checks = {finding.check for finding in examined(deep=True)}
    assert checks == {"kernels", "files"}  # the made-up files have made-up hashes


def test_the_command_of_the_doctor_ends_with_the_state_of_things(
    settings: Settings, storage: Storage, tmp_path: Path
) -> None:
    def doctor(data: Path, *options: str) -> Any:
        return CliRunner().invoke(app, ["doctor", "--data", str(data), *options])

    well = doctor(settings.data_dir)
    storage.put("photos/NOBODY/original", b"x")
    ill, nothing = doctor(settings.data_dir, "--json"), doctor(tmp_path / "nothing")

    assert (well.exit_code, ill.exit_code) == (0, 1), well.output + ill.output
    assert "0 findings" in well.output
    assert "no row names these blobs" in ill.output
    assert nothing.exit_code != 0
    assert not (tmp_path / "nothing").exists()


def test_a_photo_without_its_place_is_compared_with_what_is_stored(
    store: Store, steps: Steps, storage: Storage, examined: Examined
) -> None:
    photo, kept = steps.counted(), b"without a place".ljust(1000)
    key = f"photos/{photo.public_id}/cleaned"
    storage.put(key, kept)
    store.photos.record_location(photo, "removed", key=key, digest=hashlib.sha256(kept).hexdigest())
    assert examined(deep=True) == []

    storage.put(key, b"changed since".ljust(1000))

    assert [finding.check for finding in examined(deep=True)] == ["files"]


# --- whatever owners and workers do, in whatever order, what must hold holds at every moment -------

SEEDS = (1, 26, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3, 4)))


class Owner:
    """Does what owners and workers do, in an order that the seed says."""

    def __init__(self, steps: Steps, seed: int) -> None:
        self.steps, self.store, self.chance = steps, steps.store, random.Random(seed)
        self.serials: dict[str, str] = {}  # that the files of the photos say

    def act(self) -> None:
        photos = self.store.photos.page("local", before=None, limit=100)
        received = [photo for photo in photos if photo.state == "received" and photo.file_gone_at is None]
        lenses = self.store.lenses.page("local", before=None, limit=10)
        if len(photos) < 3 or self.chance.random() < 0.1:
            photo = self.steps.receive()
            self.serials[photo.public_id] = self.chance.choice("12")
        elif received and self.chance.random() < 0.6:
            self.work(self.chance.choice(received))
        elif lenses:
            pick = self.chance.choice
            self.change(pick(photos).public_id, pick(lenses).public_id, pick(lenses).public_id)

    def work(self, photo: PhotoRow) -> None:
        self.steps.inspect(photo, serial=self.serials[photo.public_id])
        row = self.steps.fresh(photo)
        if self.chance.random() < 0.2:
            self.store.photos.fail(row.public_id, row.epoch, "no_usable_patches", "nothing there")
        else:
            self.steps.plan(row)
            self.steps.estimate(row)
            if self.chance.random() < 0.8:  # else it is still at it when the next thing happens
                self.store.photos.finish(row.public_id, row.epoch)

    def change(self, photo: str, lens: str, other: str) -> None:
        photos, lenses = self.store.photos, self.store.lenses
        deeds: list[Callable[[], object]] = [
            lambda: photos.retry(photo, ANY_OWNER),
            lambda: photos.cancel(photo, ANY_OWNER),
            lambda: photos.delete(photo, "local"),
            lambda: photos.change([photo], "local", {}, excluded=self.chance.random() < 0.5),
            lambda: photos.change([photo], "local", {"aperture": 2.0}),
            lambda: photos.change([photo], "local", {}, lens=other),
            lambda: photos.give_up_file(photo, ()),
            lambda: lenses.merge(lens, other, "local"),
        ]
        self.chance.choice(deeds)()


@pytest.mark.parametrize("seed", SEEDS)
def test_invariants_hold_in_any_order_of_steps(store: Store, steps: Steps, seed: int) -> None:
    owner, most = Owner(steps, seed), 0
    for _ in range(60):
        owner.act()

        with store.database.reading() as session:
            assert broken(session) == {}
        most = max([most, *(lens.sample_count for lens in store.lenses.page("local", before=None, limit=10))])
    assert most > 0


def test_a_backup_by_the_command_is_a_data_folder(
    photos: list[PhotoRow], settings: Settings, folder: Path
) -> None:
    made = CliRunner().invoke(app, ["backup", str(folder), "--data", str(settings.data_dir)])
    checked = CliRunner().invoke(app, ["doctor", "--deep", "--data", str(folder), "--json"])

    assert made.exit_code == 0, made.output
    assert f"{folder}: 3 photos and " in made.stdout
    assert {finding["check"] for finding in json.loads(checked.stdout)["findings"]} <= {"work", "files"}


def test_the_schema_guards_the_history(store: Store, steps: Steps) -> None:
    steps.counted()
    for statement in (
        "UPDATE calibration_event SET kind = 'nonsense'",
        "INSERT INTO calibration_event (lens_id, version, kind, photo_public_id, epoch, samples_added,"
        " samples, photos, created_at) SELECT lens_id, 9, kind, photo_public_id, epoch, 0, 0, 0, created_at"
        " FROM calibration_event",
    ):
        with pytest.raises(IntegrityError), store.database.writing() as session:
            session.execute(text(statement))
