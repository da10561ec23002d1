"""The examination of an installation: sound ones pass, each kind of damage is found."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Callable
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from conftest import Steps
from sqlalchemy import text
from sqlalchemy.exc import IntegrityError
from typer.testing import CliRunner

from app.blobs.storage import Storage
from app.runtime.doctor import Violation, broken, examine
from app.runtime.settings import Settings
from app.store import Store
from app.store.owners import ANY_OWNER
from app.store.tables import PhotoRow
from lensmodel.cli.main import app

Examined = Callable[..., list[Violation]]


@pytest.fixture
def sound(store: Store, steps: Steps, storage: Storage) -> list[PhotoRow]:
    """Make an installation with photos in all kinds of states, all as it must be."""
    store.lenses.create("another owner", "theirs")
    counted = [steps.counted(), steps.counted(width=1.2)]
    excluded, deleted, failed = steps.counted(), steps.counted(), steps.receive()
    for out in (True, False, True):
        assert store.photos.change([excluded.public_id], "local", {}, excluded=out)
    store.photos.delete(deleted.public_id, "local")
    store.photos.fail(failed.public_id, 1, "no_usable_patches", "too dark")
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


def test_a_missing_or_torn_photo_is_found(
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


def test_changed_bytes_are_found_when_all_is_read(
    sound: list[PhotoRow], store: Store, examined: Examined
) -> None:
    with store.database.writing() as session:
        session.execute(text("UPDATE psf_sample SET psf = zeroblob(900)"))

    assert examined() == []
    checks = {finding.check for finding in examined(deep=True)}
    assert checks == {"kernels", "files"}  # the made-up files have made-up hashes


def test_the_command_tells_and_ends_with_the_state_of_things(
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


def test_photos_whose_file_is_not_kept_are_sound(
    steps: Steps, store: Store, storage: Storage, examined: Examined
) -> None:
    photo = steps.counted()
    storage.put(photo.blob_key, b"x" * photo.byte_size)
    assert [finding.check for finding in examined(deep=True)] == ["files"]  # its hash is made up

    assert store.photos.give_up_file(photo.public_id, ())
    storage.delete(photo.folder)

    assert examined(deep=True) == []


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
def test_what_must_hold_holds_whatever_is_done_in_whatever_order(
    store: Store, steps: Steps, seed: int
) -> None:
    owner, most = Owner(steps, seed), 0
    for _ in range(60):
        owner.act()

        with store.database.reading() as session:
            assert broken(session) == {}
        most = max([most, *(lens.sample_count for lens in store.lenses.page("local", before=None, limit=10))])
    assert most > 0


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
