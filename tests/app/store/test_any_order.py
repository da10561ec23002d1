"""Whatever owners and workers do, in whatever order: what must hold in the tables holds at every moment."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest
from conftest import Steps
from sqlalchemy import text
from sqlalchemy.exc import IntegrityError

from app.runtime.doctor import broken
from app.store import Store
from app.store.owners import ANY_OWNER
from app.store.tables import PhotoRow

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
