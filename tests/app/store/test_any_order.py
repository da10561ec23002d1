"""Whatever owners and workers do, in whatever order: what must hold in the tables holds at every moment."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import pytest
from sqlalchemy import text
from sqlalchemy.exc import IntegrityError

from app.store import LensName, Store
from app.store.invariants import INVARIANTS
from app.store.owners import ANY_OWNER
from app.store.tables import LensRow, PhotoRow
from lensmodel.core.psf import rms_width

Steps = Any  # the fixture `steps` of conftest.py; test modules do not import each other
DEFAULT, PAPER = 1.0, 3.0
"""Widths of the kernels that the models make: by them the tests tell whose samples count."""

SEEDS = (1, 26, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3, 4)))


@pytest.fixture
def sound(store: Store) -> Callable[[], None]:
    """Check what must hold in the tables at every moment."""

    def check() -> None:
        with store.database.reading() as session:
            broken = {one.name: list(one.find(session)) for one in INVARIANTS}
        assert not any(broken.values()), broken

    return check


def lens_of(store: Store, lens_id: str) -> LensRow:
    lens = store.lenses.get(lens_id, ANY_OWNER)
    assert lens is not None
    return lens


def widths(store: Store, lens_id: str) -> list[float]:
    """Return the variances of the kernels that count, one of each photo; all of a photo are alike."""
    found: dict[str, set[float]] = {}
    for stored in store.lenses.samples_of(lens_id)[1]:
        variance = round(rms_width(stored.sample.kernel) ** 2, 0)
        found.setdefault(stored.sample.photo, set()).add(variance)
    assert all(len(one) == 1 for one in found.values()), found
    return sorted(variance for one in found.values() for variance in one)


def test_lenses_of_two_models_do_not_merge(store: Store, steps: Steps) -> None:
    paper = steps.receive(model="paper")
    steps.inspect(paper, serial="2")
    first, second = steps.lens_id(steps.counted(serial="1")), steps.lens_id(paper)

    assert not store.lenses.merge(first, second, "local")
    assert not store.lenses.merge(second, first, "local")


def test_a_counted_photo_is_not_given_to_a_lens_of_another_model(store: Store, steps: Steps) -> None:
    photo, paper = steps.counted(), steps.receive(model="paper")
    steps.inspect(paper, serial="2")
    lens_id = steps.lens_id(photo)

    assert not store.photos.change(photo.public_id, "local", {}, lens=steps.lens_id(paper))

    assert steps.lens_id(photo) == lens_id


def test_a_photo_founds_its_lens_with_the_model_that_was_asked_for(store: Store, steps: Steps) -> None:
    photo = steps.receive(model="paper")
    steps.inspect(photo)
    assert (lens_of(store, steps.lens_id(photo)).way, steps.fresh(photo).way) == ("paper", "paper")
    assert "model" not in steps.fresh(photo).given  # what was asked for is so

    nameless = steps.receive(model="paper")
    steps.inspect(nameless, serial=None)
    store.photos.change(nameless.public_id, "local", {}, lens=LensName(None, None, None, label="Mine"))

    assert lens_of(store, steps.fresh(nameless).given["lens_id"]).way == "paper"


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
            photo = self.steps.receive(**self.chance.choice([{}, {"model": "paper"}]))
            self.serials[photo.public_id] = self.chance.choice("12")
        elif received and self.chance.random() < 0.6:
            self.work(self.chance.choice(received))
        elif lenses:
            pick = self.chance.choice
            self.change(pick(photos).public_id, pick(lenses).public_id, pick(lenses).public_id)

    def work(self, photo: PhotoRow) -> None:
        self.steps.inspect(photo, serial=self.serials[photo.public_id])
        row = self.steps.fresh(photo)
        if row.given.get("model"):  # its lens has another one
            self.store.photos.fail(row.public_id, row.epoch, "conflict", "another model")
        elif self.chance.random() < 0.2:
            self.store.photos.fail(row.public_id, row.epoch, "no_usable_patches", "nothing there")
        else:
            self.steps.plan(row)
            self.steps.estimate(row, width=PAPER if row.way == "paper" else DEFAULT)
            if self.chance.random() < 0.8:  # else it is still at it when the next thing happens
                self.store.photos.finish(row.public_id, row.epoch)

    def change(self, photo: str, lens: str, other: str) -> None:
        photos, lenses = self.store.photos, self.store.lenses
        deeds: list[Callable[[], object]] = [
            lambda: photos.retry(photo, ANY_OWNER),
            lambda: photos.cancel(photo, ANY_OWNER),
            lambda: photos.delete(photo, "local"),
            lambda: photos.change(photo, "local", {}, excluded=self.chance.random() < 0.5),
            lambda: photos.change(photo, "local", {"aperture": 2.0}),
            lambda: photos.change(photo, "local", {}, lens=other),
            lambda: photos.give_up_file(photo, ()),
            lambda: lenses.merge(lens, other, "local"),
            lambda: lenses.go_back(lens, "local", 1),
        ]
        self.chance.choice(deeds)()


@pytest.mark.parametrize("seed", SEEDS)
def test_what_must_hold_holds_whatever_is_done_in_whatever_order(
    store: Store, steps: Steps, sound: Callable[[], None], seed: int
) -> None:
    owner, models = Owner(steps, seed), set()
    for _ in range(60):
        owner.act()

        sound()
        for lens in store.lenses.page("local", before=None, limit=10):
            found = set(widths(store, lens.public_id))
            assert found <= {PAPER if lens.way == "paper" else DEFAULT}
            models |= found
    assert models == {DEFAULT, PAPER}


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
