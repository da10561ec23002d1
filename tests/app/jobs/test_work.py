"""The way of photos and corrections through the states, with children that do as they are told."""

from __future__ import annotations

import hashlib
import io
import json
import math
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import obstore
import pytest
from conftest import Steps, TasksHere
from obstore.store import LocalStore
from PIL import Image
from sqlalchemy import update

from app.blobs.storage import Storage
from app.http import views
from app.jobs import answers, tasks
from app.jobs.answers import JobFailedError, NotWantedError, checked
from app.jobs.context import JobContext
from app.jobs.queue import durable, end_job
from app.jobs.sample_files import write_samples
from app.jobs.work import correct, measure, read_ahead, remove_location, work_on
from app.runtime.settings import Settings
from app.sandbox.child import MAX_RESULT, Outcome, TaskLimits
from app.store import Store
from app.store.owners import ANY_OWNER
from app.store.tables import CorrectionRow, PhotoRow
from lab.kernels import gaussian
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings, ignore_step

Answer = Outcome | Callable[[dict[str, Any], Path], Outcome]
KERNEL = gaussian(15, np.eye(2))
ELSEWHERE = FieldPosition(1.0, 3.0)  # a sample of a patch lies where its patch does, whatever a child says
METADATA: dict[str, Any] = {
    "camera_maker": "Canon",
    "camera_model": "5D",
    "lens": {"maker": "Canon", "model": "EF24mm f/1.4L", "serial": "123", "serial_source": "exif"},
    "aperture": 2.8,
    "focal_mm": 24.0,
    "focus_m": -1.0,
    "orientation": 1,
    "pixel_pitch_um": 6.0,
}
INFO = {"kind": "dng", "width": 600, "height": 450, "metadata": METADATA}
NAMELESS = METADATA["lens"] | {"serial": None, "serial_source": "none"}


def patch(cell: int) -> dict[str, Any]:
    place = {"r": 0.1 + 0.2 * cell, "phi": 0.5}
    return {"row": 0, "col": 100 * cell, "size": 64, **place, "score": 0.5, "cell": cell}


def ok(value: object) -> Outcome:
    return Outcome("ok", value=value)


def refused(code: str, detail: str = "the value and the remedy") -> Outcome:
    return Outcome("error", code=code, detail=detail)


def lacking(**metadata: Any) -> Outcome:
    return ok(INFO | {"metadata": METADATA | metadata})


CRASHED = Outcome("crashed", code="crashed", detail="the process that did the work died: signal 11")
SLOW = Outcome("time_limit", code="time_limit", detail="slow")


def develop(arguments: dict[str, Any], folder: Path) -> Outcome:
    np.save(folder / "planes.npy", np.zeros((3, 4, 4), np.float32))
    (folder / answers.SHOWN).write_bytes(b"a small picture")
    return ok({})


def estimate(arguments: dict[str, Any], folder: Path) -> Outcome:
    numbers = [number for number in arguments["numbers"] for _ in CHANNELS]
    channels = [LensSettings(channel=channel) for channel in CHANNELS] * len(arguments["numbers"])
    about: Any = {"weight": 0.5, "estimator": "default/1", "error": 0.1}
    write_samples(folder, [PsfSample(KERNEL, ELSEWHERE, channel, **about) for channel in channels])
    return ok(numbers)


def measured(arguments: dict[str, Any], folder: Path) -> Outcome:
    estimator = f"measured-{arguments['kind']}/1"
    samples = [
        PsfSample(KERNEL, FieldPosition(0.2, 0.1), LensSettings(channel=c), estimator=estimator, error=0.04)
        for c in ("g", "r")
    ]
    write_samples(folder, samples)
    return ok([{"idx": 0, "row": 9, "col": 9, "side": 144}] * 2)


def write_result(arguments: dict[str, Any], folder: Path) -> Outcome:
    (folder / "result.jpg").write_bytes(b"a picture")
    (folder / answers.SIDES["before"]).write_bytes(b"tiles")
    return ok({"file": "result.jpg", "report": {"zones": {"center": {"expected_gain_db": 3.0}}}})


class Scripted(TasksHere):
    """A sandbox without children: each task answers from a list, the last answer for ever."""

    def __init__(self, scratch: Path) -> None:
        super().__init__(scratch)
        self.limits, self.ran, self.files = list[TaskLimits](), list[str](), set[str]()
        self.seen, self._choosing = dict[str, dict[str, Any]](), threading.Lock()
        self.answers: dict[str, list[Answer]] = {
            "locate": [ok({"location": "none"})],
            "inspect": [ok(INFO)],
            "develop": [develop],
            "select": [ok({"patches": [patch(0), patch(1)], "rejected": [], "lateral": None})],
            "estimate": [estimate],
            "measure-lens": [measured],
            "measure": [ok({"error": None, "coverage": None})],
            "correct": [write_result],
        }

    def run(self, task: str, arguments: Any, *, folder: Path, **around: Any) -> Outcome:
        self.ran.append(task)
        self.limits.append(around["limits"])
        self.seen[task] = dict(arguments)
        self.files = {path.name for path in folder.iterdir()}
        if not around["wanted"]():
            return Outcome("cancelled")
        with self._choosing:
            left = self.answers[task]
            answer = left.pop(0) if len(left) > 1 else left[0]
        return answer(dict(arguments), folder) if callable(answer) else answer


class Bench:
    """The jobs of a worker, one at a time."""

    def __init__(self, context: JobContext, sandbox: Scripted, steps: Steps) -> None:
        self.context, self.sandbox, self.steps = context, sandbox, steps
        self.store, self.storage = context.store, context.storage

    def let(self, task: str, *replies: Answer) -> None:
        """Let a task answer so, the last answer for ever."""
        self.sandbox.answers[task] = list(replies)

    def received(self, **options: Any) -> PhotoRow:
        photo = self.steps.receive(**options)
        self.storage.put(photo.blob_key, b"the file")
        return photo

    def counted(self) -> PhotoRow:
        photo = self.steps.counted()
        self.storage.put(photo.blob_key, b"the file")
        return photo

    def work(self, photo: PhotoRow | None = None, epoch: int = 1) -> PhotoRow:
        """Work on a photo, or on a new one; return it afterwards."""
        photo = photo or self.received()
        durable("photo", partial(work_on, self.context), partial(end_job, self.store))(photo.public_id, epoch)
        return self.steps.fresh(photo)

    def patches(self, photo: PhotoRow) -> set[tuple[str, str | None]]:
        return {(row.state, row.reason) for row in self.store.photos.patches(photo.public_id, 1)}

    def ask(self, photo: PhotoRow, **params: Any) -> str:
        """Ask for a correction; return its id."""
        output = {"format": "jpeg", "color_space": "srgb", "quality": 90}
        wish = {"method": "standard", "strength": 1.0, "output": output, "roi": None, **params}
        return self.steps.correct(photo, **wish).public_id

    def correct(self, key: str) -> CorrectionRow:
        durable("correction", partial(correct, self.context), partial(end_job, self.store))(key, 1)
        return self.store.jobs.get(key, ANY_OWNER)

    def attempt(self, task: str = "develop", wanted: Callable[[], bool] = lambda: True) -> Any:
        with self.context.task(task, None, wanted) as (answer, _):
            return answer


@pytest.fixture
def bench(settings: Settings, steps: Steps, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.setattr("app.jobs.context.BACKOFF_S", 0.001)
    monkeypatch.setattr("app.jobs.work.WAIT_S", 0.001)
    sandbox: Any = Scripted(tmp_path / "scratch")
    return Bench(JobContext(settings, steps.store, Storage(settings.storage), sandbox), sandbox, steps)


# --- photos -----------------------------------------------------------------------------------


def test_a_photo_goes_all_the_way(bench: Bench) -> None:
    done = bench.work(bench.received(selector="good-regions"))

    assert (done.state, done.patches_done, done.width, done.aperture) == ("counted", 2, 600, 2.8)
    assert bench.sandbox.seen["select"]["selector"] == "good-regions"
    assert (done.lens.version, done.lens.sample_count, done.lens.serial) == (1, 6, "123")
    assert bench.storage.get(f"photos/{done.public_id}/{answers.SHOWN}") == b"a small picture"
    _, samples = bench.steps.learned(done)
    assert {(round(s.position.r, 9), s.position.phi) for s in samples} == {(0.1, 0.5), (0.3, 0.5)}
    assert {s.settings.focus_m for s in samples} == {math.inf}  # as the file says by a negative number
    assert views.photo_out(done).focus_distance_m is None
    ran = list(bench.sandbox.ran)

    assert bench.work(done).lens.version == 1  # again: nothing changes
    assert bench.sandbox.ran == ran


@pytest.mark.parametrize(
    ("answer", "calibrate", "state"),
    [
        (ok(INFO), True, "received"),
        (ok(INFO), False, "stored"),
        (lacking(aperture=None), True, "needs_lens"),
        (lacking(lens=NAMELESS), True, "needs_lens"),
        (refused("not_an_image"), True, "failed"),
    ],
)
def test_a_photo_is_read_before_its_turn(bench: Bench, answer: Answer, calibrate: bool, state: str) -> None:
    bench.let("inspect", answer)
    photo = bench.received(calibrate=calibrate)

    read_ahead(bench.context, photo)

    read = bench.steps.fresh(photo)
    assert (read.state, read.width is None, read.attempt) == (state, state == "failed", 0)
    assert bench.sandbox.ran == ["locate", "inspect"]
    assert bench.work(photo).state == ("counted" if state == "received" else state)
    assert bench.sandbox.ran.count("inspect") == 1


@pytest.mark.parametrize(
    ("answer", "calibrate", "state"), [(ok(INFO), False, "stored"), (SLOW, True, "counted")]
)
def test_a_reading_before_its_turn_holds_up_no_work_that_has_begun_and_ends_none(
    bench: Bench, answer: Outcome, calibrate: bool, state: str
) -> None:
    photo = bench.received(calibrate=calibrate)

    def turn(arguments: dict[str, Any], folder: Path) -> Outcome:
        assert bench.store.photos.start(photo.public_id, 1)  # by another worker
        return answer

    bench.let("inspect", turn, ok(INFO))
    read_ahead(bench.context, photo)

    assert bench.steps.fresh(photo).state == "inspecting"
    assert bench.work(photo).state == state


def test_only_unread_photos_that_wait_are_read_ahead(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    photo, photos = bench.received(), bench.store.photos
    assert photos.unread() is None  # its turn may come at once
    monkeypatch.setattr("app.store.photos.SOON", timedelta(0))
    found = photos.unread()
    assert found.public_id == photo.public_id

    read_ahead(bench.context, found)

    assert photos.unread() is None


@pytest.mark.parametrize(("more", "kept"), [(0, True), (1, False)])
def test_no_picture_is_kept_that_is_too_large_to_read(bench: Bench, more: int, kept: bool) -> None:
    def inspect(arguments: dict[str, Any], folder: Path) -> Outcome:
        with (folder / answers.THUMBNAIL).open("wb") as file:
            file.truncate(MAX_RESULT + more)
        return ok(INFO)

    bench.let("inspect", inspect)
    photo = bench.work()

    assert (bench.storage.folder / f"{photo.folder}{answers.THUMBNAIL}").is_file() is kept


NONSENSE: list[Answer] = [
    lambda arguments, folder: ok([77 for _ in estimate(arguments, folder).value]),  # nobody's patch
    lambda arguments, folder: ok(estimate(arguments, folder).value[:-1]),  # fewer than were written
    *(ok(None), ok([{"idx": 0}])),
]


@pytest.mark.parametrize("child", NONSENSE)
def test_a_cell_whose_child_answers_nonsense_fails(bench: Bench, child: Answer) -> None:
    bench.let("estimate", child)

    assert bench.patches(bench.work()) == {("rejected", "internal_error")}


def stumble(arguments: dict[str, Any], folder: Path) -> Outcome:
    raise ZeroDivisionError("of the worker, not of the child")


@pytest.mark.parametrize(
    ("first", "reason"), [(stumble, "internal_error"), (refused("no_samples"), "not-enough-evidence")]
)
def test_a_cell_that_fails_is_rejected_and_the_rest_counts(bench: Bench, first: Answer, reason: str) -> None:
    bench.let("estimate", first, estimate)
    photo = bench.work()

    assert bench.patches(photo) == {("done", None), ("rejected", reason)}
    assert (photo.state, photo.patches_done, photo.patches_rejected) == ("counted", 1, 1)


def test_a_photo_of_the_target_counts_with_what_was_measured_and_no_blind_estimate(bench: Bench) -> None:
    photo = bench.work(bench.received(kind="target"))

    assert (photo.state, "estimate" in bench.sandbox.ran) == ("counted", False)
    _, samples = bench.steps.learned(photo)
    assert [(s.estimator, s.error) for s in samples] == [("measured-target/1", 0.04)] * 2


def test_the_open_photo_of_a_pair_is_measured_beside_the_closed_one(bench: Bench) -> None:
    closed = bench.work(bench.received(calibrate=False))
    opened = bench.work(bench.received(kind="pair", reference_id=closed.public_id))

    assert opened.state == "counted"
    names = [Path(folder).name for folder in bench.sandbox.seen["measure-lens"]["developed"]]
    assert names == [opened.public_id, closed.public_id]


def test_a_lost_file_and_a_lost_or_foreign_photo_of_a_pair_are_told(bench: Bench) -> None:
    theirs, lost = Steps(bench.store, "somebody else").receive().public_id, bench.received()
    bench.storage.delete(lost.folder)

    for photo in (lost, *(bench.received(kind="pair", reference_id=key) for key in ("gone", theirs))):
        failed = bench.work(photo)
        assert (failed.state, failed.error_code) == ("failed", "unknown_photo")


def test_a_file_is_not_lost_whose_disk_went_away_for_a_moment(bench: Bench) -> None:
    photo, folder = bench.received(), bench.storage.folder
    aside = folder.with_name("aside")

    with pytest.raises(OSError, match="was away"), bench.context.original(photo) as path:  # noqa: PT012
        folder.rename(aside)
        try:
            path.read_bytes()
        finally:
            aside.rename(folder)

    assert bench.work(photo).state == "counted"


def test_a_write_to_a_vanishing_disk_is_not_stored(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, put = bench.storage.folder, obstore.put
    aside = folder.with_name("aside")

    def put_elsewhere(store: LocalStore, key: str, data: bytes) -> None:
        folder.rename(aside)
        put(store, key, data)

    monkeypatch.setattr(obstore, "put", put_elsewhere)
    with pytest.raises(OSError, match="is away"):
        bench.storage.put("photos/p/original", b"a photo")
    assert not (aside / "photos/p").exists()


@pytest.mark.parametrize("dies_in", ["inspect", "develop", "select", "estimate"])
def test_a_photo_whose_worker_died_is_finished_without_repetition(bench: Bench, dies_in: str) -> None:
    class DiedError(BaseException):
        """Stands for the death of the process."""

    def die(arguments: dict[str, Any], folder: Path) -> Outcome:
        raise DiedError

    photo = bench.received()
    bench.sandbox.answers[dies_in].insert(0, die)
    with pytest.raises(DiedError):
        bench.work(photo)
    done = bench.work(photo)

    assert (done.state, done.attempt) == ("counted", 2)
    assert (done.lens.version, done.lens.sample_count) == (1, 6)
    before = ["inspect", "develop", "select"]
    assert [bench.sandbox.ran.count(task) for task in before] == [1 + (task == dies_in) for task in before]


@pytest.mark.parametrize(
    ("task", "answer", "code", "says", "runs"),
    [
        ("inspect", refused("decompression_bomb"), "decompression_bomb", "the value and the remedy", 1),
        ("select", refused("invalid_parameter", "64 px at least"), "no_usable_patches", "600x450", 1),
        ("estimate", refused("no_samples"), "no_usable_patches", "0 of 2 patches", 2),  # one in each cell
        ("estimate", SLOW, "time_limit", "2 of 2 patches", 2),
    ],
)
def test_a_refusal_ends_the_photo_with_what_to_do_and_without_another_try(
    bench: Bench, task: str, answer: Answer, code: str, says: str, runs: int
) -> None:
    bench.let(task, answer)

    failed = bench.work()

    assert (failed.state, failed.error_code) == ("failed", code)
    assert says in failed.error_detail
    assert bench.sandbox.ran.count(task) == runs


def test_too_few_patches_are_no_evidence(bench: Bench) -> None:
    bench.context.settings = bench.context.settings.model_copy(update={"patches": 18})

    failed = bench.work()

    assert (failed.state, failed.error_code) == ("failed", "no_usable_patches")


@pytest.mark.parametrize("task", ["inspect", "develop", "select", "estimate"])
def test_cancelling_in_a_task_ends_the_photo_and_nothing_counts(bench: Bench, task: str) -> None:
    photo = bench.received()

    def cancel(arguments: dict[str, Any], folder: Path) -> Outcome:
        assert bench.store.photos.cancel(photo.public_id, ANY_OWNER)
        return Outcome("cancelled")

    bench.sandbox.answers[task].insert(0, cancel)

    ended = bench.work(photo)

    assert ended.state == "cancelled"
    assert ended.lens is None or (ended.lens.version, ended.lens.sample_count) == (0, 0)


# --- tries ------------------------------------------------------------------------------------


FULL = Outcome("memory_limit", code="memory_limit", detail="little")


@pytest.mark.parametrize(
    ("outcome", "code", "says", "memory_mb"),
    [
        (CRASHED, "crashed_repeatedly", "signal 11; tried 3 times", [768] * 3),
        (Outcome("crashed", code="internal_error", detail="a KeyError"), "internal_error", "KeyError", [768]),
        (FULL, "memory_limit", "little", [768, 1536]),
    ],
)
def test_a_task_is_tried_as_often_as_that_may_help(
    bench: Bench, outcome: Outcome, code: str, says: str, memory_mb: list[int]
) -> None:
    bench.let("develop", CRASHED, CRASHED, ok(7))
    assert bench.attempt() == 7
    bench.sandbox.limits.clear()
    bench.let("develop", outcome)

    with pytest.raises(JobFailedError, match=says) as caught:
        bench.attempt()

    assert caught.value.code == code
    assert [limits.memory_mb for limits in bench.sandbox.limits] == memory_mb


def test_nobody_waits_between_crashes_for_what_nobody_wants(bench: Bench) -> None:
    asked = iter([True, False, False])
    bench.let("develop", CRASHED)

    with pytest.raises(NotWantedError):
        bench.attempt(wanted=lambda: next(asked))


def test_what_needs_compiled_loops_waits_while_they_are_compiled_for_all(bench: Bench) -> None:
    bench.context.warmed.clear()

    with ThreadPoolExecutor() as pool:
        computed = pool.submit(bench.attempt, "measure")
        bench.attempt("develop")  # that only decodes
        assert (computed.done(), bench.sandbox.ran) == (False, ["develop"])
        bench.context.warmed.set()
        assert "error" in computed.result(60)


# --- corrections and measurements -------------------------------------------------------------


def test_a_correction_ends_with_a_file(bench: Bench) -> None:
    row = bench.correct(bench.ask(bench.counted()))

    assert (row.state, row.result_media_type, row.result_bytes) == ("succeeded", "image/jpeg", 9)
    assert row.result_shown_bytes == len(bench.storage.get(f"{row.run_folder}{answers.SIDES['before']}")) == 5
    assert row.report == {"zones": {"center": {"expected_gain_db": 3.0}}}
    assert bench.storage.get(row.result_key) == b"a picture"
    assert bench.sandbox.files >= {answers.KERNELS, answers.SAMPLES}


def test_bounds_reach_the_correction(bench: Bench) -> None:
    bounds = {"halo": 0.2, "denoise": 0.5}
    bench.correct(bench.ask(bench.counted(), **bounds))

    assert bench.sandbox.seen["correct"]["bounds"] == bounds


def test_a_correction_with_a_version_without_samples_fails(bench: Bench) -> None:
    photo = bench.counted()
    key = bench.ask(photo)
    bench.store.photos.change([photo.public_id], "local", {}, excluded=True)

    row = bench.correct(key)

    assert (row.state, row.error_code) == ("failed", "no_samples")


def test_a_correction_cancelled_while_stored_leaves_no_file(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    key, put = bench.ask(bench.counted()), bench.storage.put

    def cancelled_meanwhile(blob: str, path: Path) -> None:
        put(blob, path)
        if blob.startswith("corrections/"):
            bench.store.jobs.cancel(key, ANY_OWNER)

    monkeypatch.setattr(bench.storage, "put", cancelled_meanwhile)
    bench.correct(key)

    assert not list(bench.storage.listed(f"corrections/{key}/"))


def test_a_child_cannot_hand_in_a_file_from_elsewhere(bench: Bench) -> None:
    def write(arguments: dict[str, Any], folder: Path) -> Outcome:
        (folder.parent / "elsewhere.jpg").write_bytes(b"another picture")
        return ok({"file": "../elsewhere.jpg", "report": {"zones": {}}})

    bench.let("correct", write)

    row = bench.correct(bench.ask(bench.counted()))

    assert (row.state, row.error_code) == ("failed", "internal_error")


def unmeasured(store: Store) -> list[tuple[str | int, ...]]:
    return [job.arguments for job in store.jobs.to_do() if job.kind == "measure"]


@pytest.mark.parametrize(
    "answer", [ok({"error": {"mid": 0.2}, "coverage": {"mid": 4}}), refused("no_samples")]
)
def test_a_version_is_measured_once_even_where_it_cannot_be(bench: Bench, answer: Outcome) -> None:
    bench.let("measure", answer)
    lens_id = bench.steps.lens_id(bench.counted())
    before = unmeasured(bench.store)

    durable("measure", partial(measure, bench.context), partial(end_job, bench.store))(lens_id, 1)

    assert before == [(lens_id, 1)]
    assert unmeasured(bench.store) == []


def test_a_worker_that_was_paused_changes_nothing_of_what_another_finished(bench: Bench) -> None:
    key = bench.ask(bench.counted())

    def paused(arguments: dict[str, Any], folder: Path) -> Outcome:
        bench.correct(key)  # of the worker that took over
        (folder / "result.jpg").write_bytes(b"another picture")
        return ok({"file": "result.jpg", "report": {"zones": {}}})

    bench.let("correct", paused, write_result)
    row = bench.correct(key)

    assert (row.state, row.attempt) == ("succeeded", 2)
    assert row.report == {"zones": {"center": {"expected_gain_db": 3.0}}}
    assert bench.storage.get(row.result_key) == b"a picture"


def test_a_run_of_before_a_retry_reports_nothing(bench: Bench) -> None:
    key = bench.ask(bench.counted())

    def retried(arguments: dict[str, Any], folder: Path) -> Outcome:
        bench.store.jobs.cancel(key, ANY_OWNER)
        assert bench.store.jobs.retry(key, ANY_OWNER)
        return write_result(arguments, folder)

    bench.let("correct", retried)
    row = bench.correct(key)

    assert (row.state, row.epoch, row.result_key) == ("queued", 2, None)


# --- what files say and children answer -------------------------------------------------------


def test_where_a_photo_was_taken_is_gone_from_its_file_before_anything_else(bench: Bench) -> None:
    picture = Image.fromarray(np.arange(64 * 48, dtype=np.uint8).reshape(48, 64))
    exif, out = Image.Exif(), io.BytesIO()
    exif.get_ifd(0x8825).update({1: "N", 2: (47.0, 13.0, 14.159), 3: "E", 4: (11.0, 22.0, 33.0)})
    picture.save(out, "jpeg", exif=exif)
    photo, sent = bench.steps.receive(), out.getvalue()
    with bench.store.database.writing() as session:
        session.execute(update(PhotoRow).values(byte_size=len(sent)))
    bench.storage.put(photo.blob_key, sent)
    bench.let("locate", lambda arguments, folder: ok(tasks.locate(arguments, folder, ignore_step)))

    remove_location(bench.context, bench.steps.fresh(photo))

    cleaned = bench.steps.fresh(photo)
    kept = bench.storage.get(cleaned.blob_key)
    read = Image.open(io.BytesIO(kept))
    assert (cleaned.location, len(kept)) == ("removed", len(sent))
    assert not read.getexif().get_ifd(0x8825)
    assert np.array_equal(np.asarray(read), np.asarray(Image.open(out)))
    assert cleaned.file_sha256 == hashlib.sha256(kept).hexdigest()
    due = datetime.now(UTC) + timedelta(hours=1)
    assert photo.blob_key in bench.store.jobs.garbage(at=due)
    remove_location(bench.context, cleaned)
    assert bench.sandbox.ran == ["locate"]  # once


def torn(arguments: dict[str, Any], folder: Path) -> Outcome:
    (folder / answers.CLEANED).write_bytes(b"of another length")
    return ok({"location": "removed"})


@pytest.mark.parametrize("answer", [refused("time_limit"), ok({"location": 7}), torn])
def test_a_file_that_cannot_be_searched_is_processed_nevertheless(bench: Bench, answer: Answer) -> None:
    bench.let("locate", answer)

    photo = bench.work()

    assert (photo.state, photo.location) == ("counted", "unknown")
    assert photo.blob_key == f"photos/{photo.public_id}/original"


def spoilt(answer: Any, path: str, value: object) -> Any:
    """Return an answer with another value at a place such as `metadata.lens.maker`."""
    whole = json.loads(json.dumps(answer))
    *inner, last = path.split(".")
    part = whole
    for name in inner:
        part = part[int(name) if name.isdecimal() else name]
    part[last] = value
    return whole


SELECTION: dict[str, Any] = {"patches": [patch(0)], "rejected": [], "lateral": None}
WINDOW = {"row": 0, "col": 0, "size": 64, "r": 0.1, "phi": 0.1, "reason": "flat"}
CORRECTION = {"file": "a.jpg", "report": {"zones": {"mid": {}}, "audit": {"held_back": 0.1, "checks": {}}}}


@pytest.mark.parametrize(
    ("kind", "answer"),
    [
        (answers.INSPECTED, []),
        (answers.INSPECTED, spoilt(INFO, "width", 2**40)),
        (answers.INSPECTED, spoilt(INFO, "metadata.aperture", 1e300)),
        (answers.SELECTED, spoilt(SELECTION, "patches", [patch(0)] * 2001)),
        (answers.SELECTED, spoilt(SELECTION, "rejected", [WINDOW] * 100_001)),
        (answers.SELECTED, spoilt(SELECTION, "patches.0.row", 2**70)),
        (answers.SELECTED, spoilt(SELECTION, "lateral", {"red": [1.0]})),
        (answers.CORRECTED, spoilt(CORRECTION, "report.zones", {"elsewhere": {}})),
        (answers.CORRECTED, spoilt(CORRECTION, "report.zones.mid", {"cells": -1})),
        (answers.CORRECTED, spoilt(CORRECTION, "report.audit.held_back", 2.0)),
    ],
)
def test_what_no_task_gives_is_no_answer(kind: Any, answer: Any) -> None:
    with pytest.raises(JobFailedError) as caught:
        checked(kind, answer)

    assert caught.value.code == "internal_error"
    assert len(caught.value.detail) < 300


@pytest.mark.parametrize("task", ["inspect", "select"])
def test_a_task_that_gives_no_answer_ends_its_photo(bench: Bench, task: str) -> None:
    bench.let(task, ok({"patches": "many"}))

    ended = bench.work()

    assert (ended.state, ended.error_code) == ("failed", "internal_error")


def test_a_name_that_is_too_long_is_cut_and_its_photo_goes_on(bench: Bench) -> None:
    bench.let("inspect", lacking(camera_model="x" * 5000))

    photo = bench.work()

    assert (photo.state, len(photo.camera_model)) == ("counted", 200)


def test_time_is_limited_by_what_a_task_computes(bench: Bench) -> None:
    photo, settings = bench.received(), bench.context.settings
    developing, correcting = (bench.context.limits(task, photo) for task in ("develop", "correct"))

    assert developing.processor_s == settings.task_seconds / 20
    assert developing.wall_s == settings.task_seconds  # a busy machine takes nothing from it
    assert correcting.processor_s == settings.task_seconds * settings.worker_slots
