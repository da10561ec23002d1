"""A lens changes its way: what counts, what waits, what is taken back; at no moment samples of two ways."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import pytest
from sqlalchemy import select, text
from sqlalchemy.exc import IntegrityError

from app.store import LensName, Store
from app.store.access.owners import ANY_OWNER
from app.store.tables import LensRow, PatchRow, PhotoRow, SampleRow
from app.store.upkeep.invariants import INVARIANTS
from lensmodel.core.psf import rms_width

Steps = Any  # the fixture `steps` of conftest.py; test modules do not import each other
BEFORE, AFTER = 1.0, 3.0
"""Widths of the kernels that the ways make: by them the tests tell whose samples count."""

SEEDS = (1, 26, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3, 4)))
"""Of which a lens changes at least once."""


@pytest.fixture
def sound(store: Store) -> Callable[[], None]:
    """Check what must hold in the tables at every moment."""

    def check() -> None:
        with store.database.reading() as session:
            broken = {one.name: list(one.find(session)) for one in INVARIANTS}
        assert not any(broken.values()), broken

    return check


def choose(store: Store, lens_id: str, way: str = "paper") -> int | None:
    return store.lens_changes.choose_way(lens_id, "local", way)


def lens_of(store: Store, lens_id: str) -> LensRow:
    lens = store.lenses.get(lens_id, ANY_OWNER)
    assert lens is not None
    return lens


def learn(steps: Steps, photo: PhotoRow, *, width: float = AFTER) -> int | None:
    """Do what a worker does with a photo that was received."""
    fresh = steps.fresh(photo)
    steps.inspect(fresh)
    steps.plan(fresh)
    steps.estimate(fresh, width=width)
    version: int | None = steps.store.photos.finish(fresh.public_id, fresh.epoch)
    return version


def widths(store: Store, lens_id: str) -> list[float]:
    """Return the variances of the kernels that count, one of each photo; all of a photo are alike."""
    found: dict[str, set[float]] = {}
    for stored in store.samples.of_lens(lens_id)[1]:
        variance = round(rms_width(stored.sample.kernel) ** 2, 0)
        found.setdefault(stored.sample.photo, set()).add(variance)
    assert all(len(one) == 1 for one in found.values()), found
    return sorted(variance for one in found.values() for variance in one)


def test_a_lens_answers_as_before_until_all_its_photos_are_estimated_anew(
    store: Store, steps: Steps, sound: Callable[[], None]
) -> None:
    photos = [steps.counted(width=BEFORE) for _ in range(3)]
    lens_id = steps.lens_id(photos[0])

    assert choose(store, lens_id) == 0
    for done, photo in enumerate(photos):
        assert (lens_of(store, lens_id).way, lens_of(store, lens_id).answering_way) == ("paper", "default")
        assert widths(store, lens_id) == [BEFORE] * 3
        assert (lens_of(store, lens_id).version, lens_of(store, lens_id).photo_count) == (3, 3)
        assert store.lenses.coverage_of([lens_of(store, lens_id)])[lens_of(store, lens_id).id] == (
            [1.4],
            [24.0],
        )
        sound()
        assert (learn(steps, photo) is None) == (done < 2)

    assert lens_of(store, lens_id).answering_way == "paper"
    assert widths(store, lens_id) == [AFTER] * 3
    history = store.lenses.history(lens_of(store, lens_id))
    assert [(event.kind, event.way) for event in history[2:]] == [
        ("photo_added", "default"),
        ("model_changed", "paper"),
    ]
    assert (history[-1].samples_added, history[-1].samples, history[-1].photos) == (0, 18, 3)
    assert not any(steps.fresh(photo).relearning for photo in photos)
    with store.database.reading() as session:
        epochs = set(session.scalars(select(PatchRow.epoch)))
    assert epochs == {2}  # nothing is kept of what was replaced
    sound()


def test_choosing_the_same_way_again_changes_nothing(store: Store, steps: Steps) -> None:
    photo = steps.counted()
    lens_id = steps.lens_id(photo)

    assert choose(store, lens_id, "default") == 0
    assert steps.fresh(photo).state == "counted"
    assert choose(store, lens_id) == 0
    epoch = steps.fresh(photo).epoch
    assert choose(store, lens_id) == 0

    assert steps.fresh(photo).epoch == epoch
    assert choose(store, "nowhere") is None


def test_a_lens_that_knows_nothing_changes_at_once(store: Store, steps: Steps) -> None:
    photo = steps.receive()
    steps.inspect(photo)
    lens_id = steps.lens_id(photo)

    assert choose(store, lens_id) == 0

    assert lens_of(store, lens_id).answering_way == "paper"
    again = steps.fresh(photo)
    assert (again.state, again.epoch) == ("received", 2)  # it had begun in the other way
    assert learn(steps, photo) == 1
    assert steps.fresh(photo).way == "paper"


@pytest.mark.parametrize("begun", ["nothing", "one", "failed"])
def test_the_way_before_can_be_chosen_again_at_any_moment(
    store: Store, steps: Steps, sound: Callable[[], None], begun: str
) -> None:
    photos = [steps.counted(width=BEFORE) for _ in range(2)]
    lens_id = steps.lens_id(photos[0])
    choose(store, lens_id)
    if begun == "one":
        learn(steps, photos[0])
    if begun == "failed":
        first = steps.fresh(photos[0])
        assert store.photos.fail(first.public_id, first.epoch, "no_usable_patches", "nothing there")

    assert choose(store, lens_id, "default") == 0

    assert [steps.fresh(photo).state for photo in photos] == ["counted", "counted"]
    assert [steps.fresh(photo).error_code for photo in photos] == [None, None]
    assert widths(store, lens_id) == [BEFORE] * 2
    assert (lens_of(store, lens_id).version, lens_of(store, lens_id).answering_way) == (2, "default")
    assert not store.photos.is_live(photos[1].public_id, 2)  # work that was begun is void
    assert store.photos.finish(photos[1].public_id, 2) is None
    sound()
    choose(store, lens_id)
    for photo in photos:
        learn(steps, photo)
    assert widths(store, lens_id) == [AFTER] * 2
    sound()


def test_a_new_photo_waits_until_the_lens_has_changed(
    store: Store, steps: Steps, sound: Callable[[], None]
) -> None:
    old = steps.counted(width=BEFORE)
    lens_id = steps.lens_id(old)
    choose(store, lens_id)
    new = steps.receive()

    assert learn(steps, new) is None

    assert (steps.fresh(new).state, widths(store, lens_id)) == ("counted", [BEFORE])
    sound()
    assert learn(steps, old) == 3
    assert widths(store, lens_id) == [AFTER] * 2
    kinds = [event.kind for event in store.lenses.history(lens_of(store, lens_id))]
    assert kinds == ["photo_added", "model_changed", "photo_added"]
    sound()


def test_what_waited_starts_again_when_the_change_is_given_up(
    store: Store, steps: Steps, sound: Callable[[], None]
) -> None:
    old = steps.counted(width=BEFORE)
    lens_id = steps.lens_id(old)
    choose(store, lens_id)
    new = steps.receive()
    learn(steps, new)

    choose(store, lens_id, "default")

    assert (steps.fresh(new).state, steps.fresh(old).state) == ("received", "counted")
    sound()
    assert learn(steps, new, width=BEFORE) == 2
    assert widths(store, lens_id) == [BEFORE] * 2
    sound()


@pytest.mark.parametrize("how", ["fail", "cancel", "delete", "move"])
def test_the_last_photo_need_not_succeed(
    store: Store, steps: Steps, sound: Callable[[], None], how: str
) -> None:
    good, bad = (steps.counted(width=BEFORE) for _ in range(2))
    other = steps.lens_id(steps.counted(serial="other"))
    lens_id = steps.lens_id(good)
    choose(store, lens_id)
    learn(steps, good)
    assert widths(store, lens_id) == [BEFORE] * 2

    if how == "fail":
        store.photos.fail(bad.public_id, 2, "no_usable_patches", "nothing there")
    elif how == "cancel":
        store.photos.cancel(bad.public_id, ANY_OWNER)
    elif how == "delete":
        store.photos.delete(bad.public_id, "local")
    else:
        store.photos.change(bad.public_id, "local", {}, lens=other)

    assert widths(store, lens_id) == [AFTER]
    assert lens_of(store, lens_id).answering_way == "paper"
    sound()
    if how == "move":
        learn(steps, bad, width=BEFORE)
        assert widths(store, other) == [BEFORE] * 2
        sound()


def test_a_lens_none_of_whose_photos_can_be_estimated_anew_keeps_what_it_has(
    store: Store, steps: Steps, sound: Callable[[], None]
) -> None:
    photo = steps.counted(width=BEFORE)
    lens_id = steps.lens_id(photo)
    choose(store, lens_id)
    store.photos.fail(photo.public_id, 2, "no_usable_patches", "nothing there")

    assert widths(store, lens_id) == [BEFORE]
    assert lens_of(store, lens_id).answering_way == "default"
    sound()
    assert store.photos.retry(photo.public_id, ANY_OWNER)
    assert widths(store, lens_id) == [BEFORE]
    assert learn(steps, photo) == 2
    assert widths(store, lens_id) == [AFTER]
    sound()


def test_a_photo_left_out_before_is_estimated_anew_when_it_is_brought_back(
    store: Store, steps: Steps, sound: Callable[[], None]
) -> None:
    kept, out = (steps.counted(width=BEFORE) for _ in range(2))
    lens_id = steps.lens_id(kept)
    store.photos.change(out.public_id, "local", {}, excluded=True)
    choose(store, lens_id)
    learn(steps, kept)

    assert store.photos.change(out.public_id, "local", {}, excluded=False)

    assert (steps.fresh(out).state, widths(store, lens_id)) == ("received", [AFTER])
    learn(steps, out)
    assert widths(store, lens_id) == [AFTER] * 2
    sound()


def test_photos_whose_files_are_gone_keep_a_lens_from_changing(store: Store, steps: Steps) -> None:
    photos = [steps.counted() for _ in range(3)]
    lens_id = steps.lens_id(photos[0])
    for photo in photos[:2]:
        assert store.photos.give_up_file(photo.public_id, ())

    assert choose(store, lens_id) == 2

    assert lens_of(store, lens_id).way == "default"
    assert steps.fresh(photos[2]).state == "counted"
    for photo in photos[:2]:
        store.photos.change(photo.public_id, "local", {}, excluded=True)
    assert choose(store, lens_id) == 0
    assert not store.photos.change(photos[0].public_id, "local", {}, excluded=False)
    assert steps.fresh(photos[0]).state == "excluded"


def test_a_photo_that_is_given_to_a_lens_of_another_way_is_estimated_anew(
    store: Store, steps: Steps, sound: Callable[[], None]
) -> None:
    mine, other = steps.counted(width=BEFORE), steps.counted(serial="other", width=BEFORE)
    lens_id = steps.lens_id(other)
    choose(store, lens_id)
    learn(steps, other)

    assert store.photos.change(mine.public_id, "local", {}, lens=lens_id)

    assert steps.fresh(mine).state == "received"
    assert widths(store, lens_id) == [AFTER]
    learn(steps, mine)
    assert widths(store, lens_id) == [AFTER] * 2
    sound()


def test_new_settings_of_a_photo_that_is_estimated_anew_hold_for_what_counts(
    store: Store, steps: Steps, sound: Callable[[], None]
) -> None:
    photo = steps.counted()
    lens_id = steps.lens_id(photo)
    choose(store, lens_id)

    assert store.photos.change(photo.public_id, "local", {"aperture": 4.0})

    assert lens_of(store, lens_id).version == 2
    state, stored = store.samples.of_lens(lens_id)
    assert {one.sample.settings.aperture for one in stored} == {4.0}
    assert state.way == "default"
    sound()


def test_lenses_of_two_ways_do_not_merge(store: Store, steps: Steps) -> None:
    one, two = (steps.counted(serial=serial) for serial in ("1", "2"))
    first, second = steps.lens_id(one), steps.lens_id(two)

    choose(store, first)
    assert not store.lens_changes.merge(first, second, "local")
    learn(steps, one)

    assert not store.lens_changes.merge(first, second, "local")
    assert not store.lens_changes.merge(second, first, "local")


def test_a_lens_does_not_go_back_while_it_changes(store: Store, steps: Steps) -> None:
    photos = [steps.counted() for _ in range(2)]
    lens_id = steps.lens_id(photos[0])
    choose(store, lens_id)

    assert store.lens_changes.go_back(lens_id, "local", 1) is None

    for photo in photos:
        learn(steps, photo)
    assert store.lens_changes.go_back(lens_id, "local", 1) == 1  # by when a photo joined first
    assert steps.fresh(photos[1]).state == "excluded"


def test_a_lens_that_is_deleted_while_it_changes_takes_both_epochs_with_it(
    store: Store, steps: Steps, sound: Callable[[], None]
) -> None:
    photos = [steps.counted() for _ in range(2)]
    lens_id = steps.lens_id(photos[0])
    choose(store, lens_id)
    learn(steps, photos[0])

    assert store.removal.lens(lens_id, ANY_OWNER)

    with store.database.reading() as session:
        assert list(session.scalars(select(SampleRow.id))) == []
    assert not any(steps.fresh(photo).relearning for photo in photos)
    sound()


def test_a_photo_founds_its_lens_with_the_way_that_was_asked_for(store: Store, steps: Steps) -> None:
    photo = steps.receive(model="paper")
    steps.inspect(photo)
    lens = lens_of(store, steps.lens_id(photo))
    assert (lens.way, lens.answering_way, steps.fresh(photo).way) == ("paper", "paper", "paper")
    assert "model" not in steps.fresh(photo).given  # what was asked for is so

    nameless = steps.receive(model="paper")
    steps.inspect(nameless, serial=None)
    store.photos.change(nameless.public_id, "local", {}, lens=LensName(None, None, None, label="Mine"))

    assert lens_of(store, steps.fresh(nameless).given["lens_id"]).way == "paper"


def test_a_photo_is_left_out_while_its_lens_changes(
    store: Store, steps: Steps, sound: Callable[[], None]
) -> None:
    first, second = (steps.counted(width=BEFORE) for _ in range(2))
    lens_id = steps.lens_id(first)
    choose(store, lens_id)
    learn(steps, first)

    assert store.photos.change(first.public_id, "local", {}, excluded=True)

    assert widths(store, lens_id) == [BEFORE]  # of the other, as before
    sound()
    assert store.photos.change(first.public_id, "local", {}, excluded=False)
    sound()
    learn(steps, second)
    assert widths(store, lens_id) == [AFTER] * 2
    sound()


def test_a_photo_that_was_left_out_comes_back_while_its_lens_changes_to_the_way_that_it_has(
    store: Store, steps: Steps, sound: Callable[[], None]
) -> None:
    kept, out = (steps.counted(width=BEFORE) for _ in range(2))
    lens_id = steps.lens_id(kept)
    store.photos.change(out.public_id, "local", {}, excluded=True)
    choose(store, lens_id)
    learn(steps, kept)
    choose(store, lens_id, "default")

    assert store.photos.change(out.public_id, "local", {}, excluded=False)

    assert (steps.fresh(out).state, widths(store, lens_id)) == ("counted", [AFTER])
    sound()
    learn(steps, kept, width=BEFORE)
    assert widths(store, lens_id) == [BEFORE] * 2
    assert store.lenses.history(lens_of(store, lens_id))[-1].kind == "photo_included"
    sound()


def test_a_photo_that_was_estimated_anew_and_waits_can_be_given_to_another_lens(
    store: Store, steps: Steps, sound: Callable[[], None]
) -> None:
    photos = [steps.counted(width=BEFORE) for _ in range(2)]
    other = steps.receive(model="paper")
    steps.inspect(other, serial="other")
    lens_id, target = steps.lens_id(photos[0]), steps.lens_id(other)
    choose(store, lens_id)
    learn(steps, photos[0])

    assert store.photos.change(photos[0].public_id, "local", {}, lens=target)

    assert (widths(store, lens_id), widths(store, target)) == ([BEFORE], [AFTER])
    sound()


def test_a_lens_that_was_kept_from_changing_is_mended(store: Store, steps: Steps) -> None:
    photo = steps.counted(width=BEFORE)
    lens_id = steps.lens_id(photo)
    choose(store, lens_id)
    models = next(one for one in INVARIANTS if one.name == "models")
    fresh = steps.fresh(photo)
    steps.inspect(fresh)
    steps.plan(fresh)
    steps.estimate(fresh, width=AFTER)
    with store.database.writing() as session:  # as a program that knows nothing of models would
        session.execute(text("UPDATE photo SET state = 'counted', counted_at = finished_at"))
        assert list(models.find(session)) == [lens_id]
        assert models.mend is not None
        models.mend(session, lens_id)

    assert widths(store, lens_id) == [AFTER]
    with store.database.reading() as session:
        assert list(models.find(session)) == []


def test_a_broken_vote_of_a_photo_that_relearns_is_mended(
    store: Store, steps: Steps, sound: Callable[[], None]
) -> None:
    photos = [steps.counted(width=BEFORE) for _ in range(2)]
    lens_id = steps.lens_id(photos[0])
    choose(store, lens_id)
    learn(steps, photos[0])
    votes = next(one for one in INVARIANTS if one.name == "votes")
    with store.database.writing() as session:
        session.execute(
            text("UPDATE psf_sample SET lens_id = NULL, version_added = NULL WHERE photo_id = :photo"),
            {"photo": photos[1].id},
        )
    with store.database.writing() as session:
        broken = list(votes.find(session))
        assert broken == [photos[1].public_id]
        assert votes.mend is not None
        votes.mend(session, broken[0])

    with store.database.reading() as session:
        assert list(votes.find(session)) == []


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
            self.steps.estimate(row, width=AFTER if row.way == "paper" else BEFORE)
            if self.chance.random() < 0.8:  # else it is still at it when the next thing happens
                self.store.photos.finish(row.public_id, row.epoch)

    def change(self, photo: str, lens: str, other: str) -> None:
        photos, lenses = self.store.photos, self.store.lens_changes
        deeds: list[Callable[[], object]] = [
            *[lambda: choose(self.store, lens, self.chance.choice(["default", "paper"]))] * 3,
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
def test_no_lens_has_samples_of_two_ways_whatever_is_done_in_whatever_order(
    store: Store, steps: Steps, sound: Callable[[], None], seed: int
) -> None:
    owner, changed = Owner(steps, seed), 0
    for _ in range(60):
        owner.act()

        sound()
        for lens in store.lenses.page("local", before=None, limit=10):
            found = set(widths(store, lens.public_id))
            assert found <= {AFTER if lens.answering_way == "paper" else BEFORE}
            kinds = [event.kind for event in store.lenses.history(lens)]
            changed = max(changed, kinds.count("model_changed"))
    assert changed


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
