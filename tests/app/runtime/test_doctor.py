"""The examination of an installation: sound ones pass, each kind of damage is found."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import delete, update
from typer.testing import CliRunner

from app.blobs.storage import Storage
from app.runtime.doctor import Violation, examine
from app.runtime.settings import Settings
from app.store import Store
from app.store.owners import now
from app.store.tables import EventRow, LensRow, PatchRow, PhotoRow, SampleRow
from lensmodel.cli.main import app


@pytest.fixture
def sound(settings: Settings, store: Store, steps: Any) -> list[PhotoRow]:
    """Make an installation with photos in all kinds of states, all as it must be."""
    counted = [steps.counted(), steps.counted(width=1.2)]
    excluded, deleted, failed = steps.counted(), steps.counted(), steps.receive()
    assert store.photos.change([excluded.public_id], "local", {}, excluded=True)
    assert store.photos.change([excluded.public_id], "local", {}, excluded=False)
    assert store.photos.change([excluded.public_id], "local", {}, excluded=True)
    store.photos.delete(deleted.public_id, "local")
    store.photos.fail(failed.public_id, 1, "no_usable_patches", "too dark")
    storage = Storage(settings.storage)
    for photo in (*counted, excluded, failed):
        storage.put(photo.blob_key, b"x" * photo.byte_size)
    return counted


@pytest.fixture
def examined(settings: Settings, store: Store) -> Callable[..., list[Violation]]:
    def run(**options: bool) -> list[Violation]:
        return examine(settings, store, Storage(settings.storage), **options)

    return run


def test_a_sound_installation_passes_every_check(
    sound: list[PhotoRow], examined: Callable[..., list[Violation]]
) -> None:
    assert examined() == []


def test_an_empty_installation_is_sound(store: Store, examined: Callable[..., list[Violation]]) -> None:
    assert examined(deep=True) == []


DAMAGES: dict[str, tuple[str, Any]] = {
    "a version without its event": (
        "the version of a lens is the number of its events",
        lambda photo: delete(EventRow).where(EventRow.photo_public_id == photo.public_id),
    ),
    "a wrong number of samples": (
        "lenses count their samples and photos rightly",
        lambda photo: update(LensRow).where(LensRow.id == photo.lens_id).values(sample_count=999),
    ),
    "a sample that does not count": (
        "exactly the samples of counted photos count",
        lambda photo: update(SampleRow).where(SampleRow.photo_id == photo.id).values(lens_id=None),
    ),
    "a sample of no version": (
        "exactly the samples of counted photos count",
        lambda photo: update(SampleRow).where(SampleRow.photo_id == photo.id).values(version_added=999),
    ),
    "a done patch without samples": (
        "patches are done exactly if they have samples",
        lambda photo: delete(SampleRow).where(SampleRow.photo_id == photo.id),
    ),
    "a wrong number of patches": (
        "photos count their patches rightly",
        lambda photo: update(PhotoRow).where(PhotoRow.id == photo.id).values(patches_done=77),
    ),
    "an unfinished patch of a counted photo": (
        "patches are done exactly if they have samples",
        lambda photo: update(PatchRow).where(PatchRow.photo_id == photo.id).values(state="pending"),
    ),
    "a counted photo without a lens": (
        "counted photos have a lens, failed ones a reason",
        lambda photo: update(PhotoRow).where(PhotoRow.id == photo.id).values(lens_id=None),
    ),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damage_to_the_tables_is_found(
    name: str, sound: list[PhotoRow], store: Store, examined: Callable[..., list[Violation]]
) -> None:
    check, damage = DAMAGES[name]
    with store.database.writing() as session:
        session.execute(damage(sound[0]))

    assert f"not so: {check}" in {finding.says for finding in examined()}


def test_a_missing_or_torn_photo_is_found(
    sound: list[PhotoRow], settings: Settings, examined: Callable[..., list[Violation]]
) -> None:
    storage = Storage(settings.storage)
    storage.delete(f"photos/{sound[0].public_id}/")
    storage.put(sound[1].blob_key, b"torn")

    says = {finding.subject: finding.says for finding in examined()}

    assert says == {
        sound[0].public_id: "the file of the photo is missing",
        sound[1].public_id: "the file of the photo is 4 bytes instead of 1000",
    }


def test_blobs_that_nobody_names_are_found_unless_they_are_to_be_deleted(
    sound: list[PhotoRow], settings: Settings, store: Store, examined: Callable[..., list[Violation]]
) -> None:
    Storage(settings.storage).put("photos/NOBODY/original", b"x")
    assert [finding.subject for finding in examined()] == ["photos/NOBODY/"]

    store.photos.expect("photos/NOBODY/", within=timedelta(0))

    assert examined() == []


def test_changed_bytes_are_found_when_all_is_read(
    sound: list[PhotoRow], store: Store, examined: Callable[..., list[Violation]]
) -> None:
    with store.database.writing() as session:
        session.execute(update(SampleRow).where(SampleRow.photo_id == sound[0].id).values(psf=b"\0" * 900))

    assert examined() == []
    checks = {finding.check for finding in examined(deep=True)}
    assert checks == {"kernels", "files"}  # the made-up files have made-up hashes


def test_work_that_nobody_does_is_found(
    steps: Any, examined: Callable[..., list[Violation]], settings: Settings
) -> None:
    photo = steps.receive()
    Storage(settings.storage).put(photo.blob_key, b"x" * photo.byte_size)

    assert [finding.check for finding in examined()] == ["work"]


def test_the_command_tells_and_ends_with_the_state_of_things(
    sound: list[PhotoRow], settings: Settings, tmp_path: Path
) -> None:
    well = CliRunner().invoke(app, ["doctor", "--data", str(settings.data_dir)])
    Storage(settings.storage).put("photos/NOBODY/original", b"x")
    ill = CliRunner().invoke(app, ["doctor", "--data", str(settings.data_dir), "--json"])
    nothing = CliRunner().invoke(app, ["doctor", "--data", str(tmp_path / "nothing")])

    assert (well.exit_code, ill.exit_code) == (0, 1), well.output + ill.output
    assert "0 findings" in well.output
    assert "no row names these blobs" in ill.output
    assert nothing.exit_code != 0
    assert not (tmp_path / "nothing").exists()


def test_photos_whose_file_is_not_kept_are_sound(
    sound: list[PhotoRow], store: Store, settings: Settings, examined: Callable[..., list[Violation]]
) -> None:
    assert store.photos.give_up_file(sound[0].public_id, ())
    Storage(settings.storage).delete(f"photos/{sound[0].public_id}/")
    with store.database.writing() as session:  # that other photos have made-up hashes is not asked here
        session.execute(update(PhotoRow).where(PhotoRow.id != sound[0].id).values(file_gone_at=now()))

    assert examined(deep=True) == []


def test_a_photo_without_its_place_is_compared_with_what_is_stored(
    store: Store, steps: Any, settings: Settings, examined: Callable[..., list[Violation]]
) -> None:
    photo, kept = steps.counted(), b"without a place".ljust(1000)
    key = f"photos/{photo.public_id}/cleaned"
    Storage(settings.storage).put(key, kept)
    store.photos.record_location(photo, "removed", key=key, digest=hashlib.sha256(kept).hexdigest())
    assert examined(deep=True) == []

    Storage(settings.storage).put(key, b"changed since".ljust(1000))

    assert [finding.check for finding in examined(deep=True)] == ["files"]
