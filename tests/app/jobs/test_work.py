"""The way of photos and corrections through the states, with children that do as they are told."""

from __future__ import annotations

import hashlib
import io
import json
import math
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import obstore
import pytest
from obstore.store import LocalStore
from PIL import Image
from sqlalchemy import update

from app.blobs.storage import Storage
from app.http import views
from app.jobs import tasks
from app.jobs.answers import KERNELS, SAMPLES, SHOWN, SIDES, THUMBNAIL, JobFailedError, NotWantedError
from app.jobs.context import JobContext
from app.jobs.queue import Handler, durable, end_job
from app.jobs.sample_files import write_samples
from app.jobs.work import correct, measure, read_ahead, remove_location, work_on
from app.runtime.settings import Settings
from app.sandbox.child import MAX_RESULT, Outcome, ProgressHook, TaskLimits
from app.sandbox.runner import Budget
from app.store import Store
from app.store.owners import ANY_OWNER
from app.store.tables import PhotoRow
from lab.kernels import gaussian
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings, ignore_step

Answer = Callable[[dict[str, Any], Path], Outcome]
KERNEL = gaussian(15, np.eye(2))
ELSEWHERE = FieldPosition(1.0, 3.0)  # a sample of a patch lies where its patch does, whatever a child says
LENS = {"maker": "Canon", "model": "EF24mm f/1.4L", "serial": "123", "serial_source": "exif"}
INFO = {
    "kind": "dng",
    "width": 600,
    "height": 450,
    "metadata": {
        "camera_maker": "Canon",
        "camera_model": "5D",
        "lens": LENS,
        "aperture": 2.8,
        "focal_mm": 24.0,
        "focus_m": -1.0,
        "orientation": 1,
        "pixel_pitch_um": 6.0,
    },
}


def patch(cell: int) -> dict[str, Any]:
    place = {"r": 0.1 + 0.2 * cell, "phi": 0.5}
    return {"row": 0, "col": 100 * cell, "size": 64, **place, "score": 0.5, "cell": cell}


def ok(value: object) -> Answer:
    return lambda *_: Outcome("ok", value=value)


def refused(code: str, detail: str = "no") -> Answer:
    return lambda *_: Outcome("error", code=code, detail=detail)


def ended(outcome: Outcome) -> Answer:
    return lambda *_: outcome


CRASHED = Outcome("crashed", code="crashed", detail="the process that did the work died: signal 11")
MEMORY = Outcome("memory_limit", code="memory_limit", detail="too little")


def develop(arguments: dict[str, Any], folder: Path) -> Outcome:
    np.save(folder / "planes.npy", np.zeros((3, 4, 4), np.float32))
    return Outcome("ok", value={})


def estimate(arguments: dict[str, Any], folder: Path) -> Outcome:
    numbers = [number for number in arguments["numbers"] for _ in CHANNELS]
    samples = [
        PsfSample(KERNEL, ELSEWHERE, LensSettings(channel=channel), 0.5, estimator="default/1", error=0.1)
        for _ in arguments["numbers"]
        for channel in CHANNELS
    ]
    write_samples(folder, samples)
    return Outcome("ok", value=numbers)


class Scripted:
    """A sandbox without children: each task answers from a list, the last answer for ever."""

    def __init__(self, scratch: Path) -> None:
        self.scratch = scratch
        self.budget = Budget(2, 2048)
        self.account = None
        self.limits: list[TaskLimits] = []
        self.ran: list[str] = []
        self.seen: dict[str, dict[str, Any]] = {}
        self.files: set[str] = set()
        self._choosing = threading.Lock()
        self.answers: dict[str, list[Answer]] = {
            "locate": [ok({"location": "none"})],
            "inspect": [ok(INFO)],
            "develop": [develop],
            "select": [ok({"patches": [patch(0), patch(1)], "rejected": [], "lateral": None})],
            "estimate": [estimate],
        }

    @contextmanager
    def folder(self) -> Iterator[Path]:
        self.scratch.mkdir(parents=True, exist_ok=True)
        yield Path(tempfile.mkdtemp(dir=self.scratch))  # cells ask for theirs at once

    def run(
        self,
        task: str,
        arguments: Mapping[str, Any],
        *,
        folder: Path,
        limits: TaskLimits,
        reads: Sequence[Path],
        wanted: Callable[[], bool],
        on_progress: ProgressHook = ignore_step,
    ) -> Outcome:
        self.ran.append(task)
        self.limits.append(limits)
        self.seen[task] = dict(arguments)
        self.files = {path.name for path in folder.iterdir()}
        if not wanted():
            return Outcome("cancelled")
        answers = self.answers[task]
        with self._choosing:
            answer = answers.pop(0) if len(answers) > 1 else answers[0]
        return answer(dict(arguments), folder)


def unmeasured(store: Store) -> list[tuple[str | int, ...]]:
    return [job.arguments for job in store.jobs.to_do() if job.kind == "measure"]


@pytest.fixture
def sandbox(tmp_path: Path) -> Scripted:
    return Scripted(tmp_path / "scratch")


@pytest.fixture
def context(
    settings: Settings, store: Store, sandbox: Scripted, monkeypatch: pytest.MonkeyPatch
) -> JobContext:
    monkeypatch.setattr("app.jobs.context.BACKOFF_S", 0.001)
    monkeypatch.setattr("app.jobs.work.WAIT_S", 0.001)
    return JobContext(settings, store, Storage(settings.storage), sandbox)  # type: ignore[arg-type]  # scripted


@pytest.fixture
def work(context: JobContext) -> Handler:
    return durable("photo", partial(work_on, context), partial(end_job, context.store))


@pytest.fixture
def photo(context: JobContext, steps: Any) -> PhotoRow:
    return received(context, steps)


def received(context: JobContext, steps: Any, **options: Any) -> PhotoRow:
    photo: PhotoRow = steps.receive(**options)
    context.storage.put(photo.blob_key, b"the file")
    return photo


def changed(photo: PhotoRow, **metadata: Any) -> Answer:
    return ok(INFO | {"metadata": INFO["metadata"] | metadata})  # type: ignore[operator]  # both are dicts


def test_a_photo_goes_all_the_way(work: Handler, context: JobContext, photo: PhotoRow, steps: Any) -> None:
    work(photo.public_id, 1)

    done = steps.fresh(photo)
    lens = done.lens
    assert (done.state, done.patches_done, done.width, done.aperture) == ("counted", 2, 600, 2.8)
    assert lens is not None
    assert (lens.version, lens.sample_count, lens.serial) == (1, 6, "123")


@pytest.mark.parametrize(
    ("answer", "calibrate", "state"),
    [
        (ok(INFO), True, "received"),
        (ok(INFO), False, "stored"),
        (ok({**INFO, "metadata": {**INFO["metadata"], "aperture": None}}), True, "needs_lens"),
        (refused("not_an_image"), True, "failed"),
    ],
)
def test_a_photo_is_read_before_its_turn(
    work: Handler,
    context: JobContext,
    sandbox: Scripted,
    steps: Any,
    answer: Answer,
    calibrate: bool,
    state: str,
) -> None:
    sandbox.answers["inspect"] = [answer]
    photo = received(context, steps, calibrate=calibrate)

    read_ahead(context, photo)

    read = steps.fresh(photo)
    assert (read.state, read.width is None, read.attempt) == (state, state == "failed", 0)
    assert sandbox.ran == ["locate", "inspect"]
    work(photo.public_id, 1)
    assert steps.fresh(photo).state == ("counted" if state == "received" else state)
    assert sandbox.ran.count("inspect") == 1


def test_a_photo_whose_turn_comes_while_it_is_read_is_not_held_up(
    context: JobContext, sandbox: Scripted, steps: Any
) -> None:
    photo = received(context, steps, calibrate=False)

    def turn(arguments: dict[str, Any], folder: Path) -> Outcome:
        assert context.store.photos.start(photo.public_id, 1)
        return ok(INFO)(arguments, folder)

    sandbox.answers["inspect"] = [turn]
    read_ahead(context, photo)

    assert steps.fresh(photo).state == "inspecting"


def test_a_reading_before_its_turn_ends_no_work_that_has_begun(
    work: Handler, context: JobContext, sandbox: Scripted, steps: Any
) -> None:
    photo = received(context, steps)

    def turn(arguments: dict[str, Any], folder: Path) -> Outcome:
        assert context.store.photos.start(photo.public_id, 1)  # by another worker
        return Outcome("error", code="time_limit", detail="stopped")

    sandbox.answers["inspect"] = [turn, ok(INFO)]
    read_ahead(context, photo)

    assert steps.fresh(photo).state == "inspecting"
    work(photo.public_id, 1)
    assert steps.fresh(photo).state == "counted"


def test_only_photos_that_wait_and_were_not_read_are_read_before_their_turn(
    context: JobContext, steps: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos = context.store.photos
    photo = received(context, steps)
    assert photos.unread() is None  # its turn may come at once
    monkeypatch.setattr("app.store.photos.SOON", timedelta(0))
    found = photos.unread()
    assert found is not None
    assert found.public_id == photo.public_id

    read_ahead(context, found)

    assert photos.unread() is None


@pytest.mark.parametrize(("given", "taken"), [({}, "r-map"), ({"selector": "good-regions"}, "good-regions")])
def test_patches_are_chosen_by_whom_the_photo_names_else_by_the_services_own(
    work: Handler, context: JobContext, sandbox: Scripted, steps: Any, given: dict[str, str], taken: str
) -> None:
    work(received(context, steps, **given).public_id, 1)

    assert sandbox.seen["select"]["selector"] == taken


def test_a_busy_machine_that_makes_a_step_last_takes_nothing_from_its_time(
    context: JobContext, photo: PhotoRow
) -> None:
    limits = context.limits("develop", photo)

    assert limits.processor_s == context.settings.task_seconds / 20
    assert limits.wall_s == context.settings.task_seconds


def test_correcting_may_compute_in_every_slot(context: JobContext, photo: PhotoRow) -> None:
    seconds, slots = context.settings.task_seconds, context.settings.worker_slots

    assert context.limits("correct", photo).processor_s == seconds * slots


@pytest.mark.parametrize(("more", "kept"), [(0, True), (1, False)])
def test_no_picture_is_kept_that_is_larger_than_may_be_read_at_once(
    work: Handler, context: JobContext, sandbox: Scripted, photo: PhotoRow, more: int, kept: bool
) -> None:
    def inspect(arguments: dict[str, Any], folder: Path) -> Outcome:
        with (folder / THUMBNAIL).open("wb") as file:
            file.truncate(MAX_RESULT + more)
        return Outcome("ok", value=INFO)

    sandbox.answers["inspect"] = [inspect]
    work(photo.public_id, 1)

    stored = context.storage.folder
    assert stored is not None
    assert (stored / f"{photo.folder}{THUMBNAIL}").is_file() is kept


def measured(arguments: dict[str, Any], folder: Path) -> Outcome:
    estimator = f"measured-{arguments['kind']}/1"
    samples = [
        PsfSample(KERNEL, FieldPosition(0.2, 0.1), LensSettings(channel=c), estimator=estimator, error=0.04)
        for c in ("g", "r")
    ]
    write_samples(folder, samples)
    return Outcome("ok", value=[{"idx": 0, "row": 9, "col": 9, "side": 144}] * 2)


def test_samples_lie_where_their_patches_do(
    work: Handler, context: JobContext, photo: PhotoRow, steps: Any
) -> None:
    work(photo.public_id, 1)

    _, samples = context.store.lenses.samples_of(steps.lens_id(photo))
    assert {(round(entry.position.r, 9), entry.position.phi) for entry in samples} == {
        (0.1, 0.5),
        (0.3, 0.5),
    }


def nobody_elses_patch(arguments: dict[str, Any], folder: Path) -> Outcome:
    listed = estimate(arguments, folder).value
    return Outcome("ok", value=[77 for _ in listed])


def fewer_than_announced(arguments: dict[str, Any], folder: Path) -> Outcome:
    listed = estimate(arguments, folder).value
    return Outcome("ok", value=listed[:-1])


@pytest.mark.parametrize("child", [nobody_elses_patch, fewer_than_announced, ok(None), ok([{"idx": 0}])])
def test_a_cell_whose_child_answers_nonsense_fails(
    work: Handler, context: JobContext, sandbox: Scripted, photo: PhotoRow, steps: Any, child: Answer
) -> None:
    sandbox.answers["estimate"] = [child]
    work(photo.public_id, 1)

    patches = context.store.photos.patches(photo.public_id, 1)
    assert {(row.state, row.reason) for row in patches} == {("rejected", "internal_error")}


def test_a_cell_in_which_something_unforeseen_happens_is_rejected_and_the_rest_counts(
    work: Handler, context: JobContext, sandbox: Scripted, photo: PhotoRow, steps: Any
) -> None:
    def stumble(arguments: dict[str, Any], folder: Path) -> Outcome:
        raise ZeroDivisionError("of the worker, not of the child")

    sandbox.answers["estimate"] = [stumble, estimate]
    work(photo.public_id, 1)

    rows = context.store.photos.patches(photo.public_id, 1)
    assert {(row.state, row.reason) for row in rows} == {("done", None), ("rejected", "internal_error")}
    counted = steps.fresh(photo)
    assert (counted.state, counted.patches_done, counted.patches_rejected) == ("counted", 1, 1)


def test_a_photo_of_the_target_counts_with_what_was_measured_and_no_blind_estimate(
    work: Handler, context: JobContext, sandbox: Scripted, steps: Any
) -> None:
    sandbox.answers["measure-lens"] = [measured]
    photo = received(context, steps, kind="target")
    work(photo.public_id, 1)

    assert (steps.fresh(photo).state, "estimate" in sandbox.ran) == ("counted", False)
    _, samples = context.store.lenses.samples_of(steps.lens_id(photo))
    assert [(s.estimator, s.error) for s in samples] == [("measured-target/1", 0.04)] * 2


def test_a_file_is_not_lost_whose_disk_went_away_for_a_moment(
    work: Handler, context: JobContext, photo: PhotoRow, steps: Any
) -> None:
    folder = context.storage.folder
    assert folder is not None
    aside = folder.with_name("aside")

    with pytest.raises(OSError, match="was away"), context.original(photo) as path:  # noqa: PT012
        folder.rename(aside)
        try:
            path.read_bytes()
        finally:
            aside.rename(folder)

    work(photo.public_id, 1)
    assert steps.fresh(photo).state == "counted"


def test_a_write_while_the_disk_goes_away_does_not_pass_for_stored(
    context: JobContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, put = context.storage.folder, obstore.put
    assert folder is not None
    aside = folder.with_name("aside")

    def put_elsewhere(store: LocalStore, key: str, data: bytes) -> None:
        folder.rename(aside)
        put(store, key, data)

    monkeypatch.setattr(obstore, "put", put_elsewhere)
    with pytest.raises(OSError, match="is away"):
        context.storage.put("photos/p/original", b"a photo")
    assert not (aside / "photos/p").exists()


def test_the_open_photo_of_a_pair_is_measured_beside_the_closed_one(
    work: Handler, context: JobContext, sandbox: Scripted, steps: Any
) -> None:
    sandbox.answers["measure-lens"] = [measured]
    closed = received(context, steps, calibrate=False)
    work(closed.public_id, 1)
    opened = received(context, steps, kind="pair", reference_id=closed.public_id)
    work(opened.public_id, 1)

    assert steps.fresh(opened).state == "counted"
    names = [Path(folder).name for folder in sandbox.seen["measure-lens"]["developed"]]
    assert names == [opened.public_id, closed.public_id]


def test_a_pair_whose_closed_photo_is_gone_says_so(work: Handler, context: JobContext, steps: Any) -> None:
    photo = received(context, steps, kind="pair", reference_id="gone")
    work(photo.public_id, 1)

    row = steps.fresh(photo)
    assert (row.state, row.error_code) == ("failed", "unknown_photo")


def test_a_photo_focused_at_infinity_says_so_to_the_model(
    work: Handler, context: JobContext, photo: PhotoRow, steps: Any
) -> None:
    work(photo.public_id, 1)

    _, samples = context.store.lenses.samples_of(steps.lens_id(photo))
    assert {stored.settings.focus_m for stored in samples} == {math.inf}
    assert views.photo_out(steps.fresh(photo)).focus_distance_m is None


def test_a_developed_photo_leaves_its_pictures_with_the_blobs(
    work: Handler, context: JobContext, photo: PhotoRow, sandbox: Scripted
) -> None:
    def with_a_picture(arguments: dict[str, Any], folder: Path) -> Outcome:
        (folder / SHOWN).write_bytes(b"a small picture")
        return develop(arguments, folder)

    sandbox.answers["develop"] = [with_a_picture]
    work(photo.public_id, 1)

    assert context.storage.get(f"photos/{photo.public_id}/{SHOWN}") == b"a small picture"


def test_running_a_finished_photo_again_changes_nothing(
    work: Handler, context: JobContext, photo: PhotoRow, sandbox: Scripted, steps: Any
) -> None:
    work(photo.public_id, 1)
    ran = list(sandbox.ran)

    work(photo.public_id, 1)

    lens = steps.fresh(photo).lens
    assert lens is not None
    assert lens.version == 1
    assert sandbox.ran == ran


@pytest.mark.parametrize("dies_in", ["inspect", "develop", "select", "estimate"])
def test_a_photo_whose_worker_died_is_finished_without_repeating_what_is_done(
    work: Handler, photo: PhotoRow, sandbox: Scripted, steps: Any, dies_in: str
) -> None:
    class DiedError(BaseException):
        """Stands for the death of the process."""

    def die(arguments: dict[str, Any], folder: Path) -> Outcome:
        raise DiedError

    sandbox.answers[dies_in].insert(0, die)
    with pytest.raises(DiedError):
        work(photo.public_id, 1)
    work(photo.public_id, 1)

    done = steps.fresh(photo)
    lens = done.lens
    assert (done.state, done.attempt) == ("counted", 2)
    assert lens is not None
    assert (lens.version, lens.sample_count) == (1, 6)
    before = ["inspect", "develop", "select"]
    assert [sandbox.ran.count(task) for task in before] == [2 if task == dies_in else 1 for task in before]


@pytest.mark.parametrize(
    ("lacks", "says"),
    [
        ({"lens": LENS | {"serial": None, "serial_source": "none"}}, "choose a lens"),
        ({"aperture": None}, "aperture"),
    ],
)
def test_a_photo_without_serial_or_aperture_waits_for_its_owner(
    work: Handler, photo: PhotoRow, sandbox: Scripted, steps: Any, lacks: dict[str, Any], says: str
) -> None:
    sandbox.answers["inspect"] = [changed(photo, **lacks)]

    work(photo.public_id, 1)

    waiting = steps.fresh(photo)
    assert (waiting.state, waiting.error_code) == ("needs_lens", "metadata_missing")
    assert says in waiting.error_detail
    assert sandbox.ran == ["locate", "inspect"]


def test_a_photo_to_be_stored_only_is_not_developed(
    work: Handler, context: JobContext, sandbox: Scripted, steps: Any
) -> None:
    photo = received(context, steps, calibrate=False)

    work(photo.public_id, 1)

    assert steps.fresh(photo).state == "stored"
    assert sandbox.ran == ["locate", "inspect"]


@pytest.mark.parametrize(
    "refusal",
    [("inspect", "decompression_bomb"), ("develop", "raw_decode_failed"), ("select", "no_usable_patches")],
)
def test_a_refusal_of_the_library_ends_the_photo_without_another_try(
    work: Handler, photo: PhotoRow, sandbox: Scripted, steps: Any, refusal: tuple[str, str]
) -> None:
    task, code = refusal
    sandbox.answers[task] = [refused(code, "the value and the remedy")]

    work(photo.public_id, 1)

    failed = steps.fresh(photo)
    assert (failed.state, failed.error_code, failed.error_detail) == (
        "failed",
        code,
        "the value and the remedy",
    )
    assert sandbox.ran.count(task) == 1


def test_a_photo_too_small_for_patches_is_told_so(
    work: Handler, photo: PhotoRow, sandbox: Scripted, steps: Any
) -> None:
    sandbox.answers["select"] = [refused("invalid_parameter", "patches need at least 64 px")]

    work(photo.public_id, 1)

    failed = steps.fresh(photo)
    assert failed.error_code == "no_usable_patches"
    assert "600x450" in failed.error_detail


def test_cells_without_evidence_are_rejected_and_the_others_count(
    work: Handler, context: JobContext, photo: PhotoRow, sandbox: Scripted, steps: Any
) -> None:
    def second_only(arguments: dict[str, Any], folder: Path) -> Outcome:  # cells run in any order
        return (estimate if arguments["numbers"] == [1] else refused("no_samples"))(arguments, folder)

    sandbox.answers["estimate"] = [second_only]

    work(photo.public_id, 1)

    rows = context.store.photos.patches(photo.public_id)
    assert steps.fresh(photo).state == "counted"
    assert [(row.state, row.reason) for row in rows] == [("rejected", "not-enough-evidence"), ("done", None)]


@pytest.mark.parametrize(
    ("answer", "code", "says"),
    [
        (refused("no_samples"), "no_usable_patches", "0 of 2 patches"),
        (ended(Outcome("time_limit", code="time_limit", detail="slow")), "time_limit", "2 of 2 patches"),
    ],
)
def test_a_photo_of_which_no_cell_helps_fails_with_what_to_do(
    work: Handler, photo: PhotoRow, sandbox: Scripted, steps: Any, answer: Answer, code: str, says: str
) -> None:
    sandbox.answers["estimate"] = [answer]

    work(photo.public_id, 1)

    failed = steps.fresh(photo)
    assert (failed.state, failed.error_code) == ("failed", code)
    assert says in failed.error_detail


@pytest.mark.parametrize("task", ["inspect", "develop", "select", "estimate"])
def test_cancelling_in_the_middle_of_a_task_ends_the_photo_and_nothing_counts(
    work: Handler, photo: PhotoRow, sandbox: Scripted, steps: Any, task: str
) -> None:
    def cancel(arguments: dict[str, Any], folder: Path) -> Outcome:
        assert steps.store.photos.cancel(photo.public_id, ANY_OWNER)
        return Outcome("cancelled")

    sandbox.answers[task].insert(0, cancel)

    work(photo.public_id, 1)

    assert steps.fresh(photo).state == "cancelled"
    lens = steps.fresh(photo).lens
    assert lens is None or (lens.version, lens.sample_count) == (0, 0)


def test_work_of_an_old_epoch_changes_nothing(
    work: Handler, context: JobContext, photo: PhotoRow, sandbox: Scripted, steps: Any
) -> None:
    def restart(arguments: dict[str, Any], folder: Path) -> Outcome:
        context.store.photos.change([photo.public_id], "local", {"aperture": 4.0})
        return ok({"patches": [patch(0)], "rejected": [], "lateral": None})(arguments, folder)

    sandbox.answers["select"].insert(0, restart)
    work(photo.public_id, 1)
    after_old = steps.fresh(photo)
    work(photo.public_id, 2)

    done = steps.fresh(photo)
    assert (after_old.state, after_old.epoch) == ("received", 2)
    assert (done.state, done.aperture, done.patches_total) == ("counted", 4.0, 2)


def test_a_lost_file_is_told_of(work: Handler, context: JobContext, photo: PhotoRow, steps: Any) -> None:
    context.storage.delete(f"photos/{photo.public_id}/")

    work(photo.public_id, 1)

    assert (steps.fresh(photo).state, steps.fresh(photo).error_code) == ("failed", "unknown_photo")


def attempt(context: JobContext, wanted: Callable[[], bool] = lambda: True) -> Any:
    with context.task("develop", None, wanted) as (answer, _):
        return answer


def test_a_crash_is_tried_again(context: JobContext, sandbox: Scripted) -> None:
    sandbox.answers["develop"] = [ended(CRASHED), ended(CRASHED), ok(7)]

    assert attempt(context) == 7


def test_the_third_crash_is_the_last(context: JobContext, sandbox: Scripted) -> None:
    sandbox.answers["develop"] = [ended(CRASHED)]

    with pytest.raises(JobFailedError, match="signal 11; tried 3 times") as caught:
        attempt(context)

    assert caught.value.code == "crashed_repeatedly"
    assert sandbox.ran == ["develop"] * 3


def test_an_unforeseen_exception_is_not_tried_again(context: JobContext, sandbox: Scripted) -> None:
    sandbox.answers["develop"] = [ended(Outcome("crashed", code="internal_error", detail="a KeyError"))]

    with pytest.raises(JobFailedError, match="a KeyError"):
        attempt(context)

    assert sandbox.ran == ["develop"]


def test_what_needs_compiled_loops_waits_while_they_are_compiled_for_all(
    context: JobContext, sandbox: Scripted
) -> None:
    sandbox.answers["measure"] = [ok({"error": None, "coverage": None})]
    context.warmed.clear()

    def measured() -> bool:
        with context.task("measure", None, lambda: True) as (answer, _):
            return "error" in answer

    with ThreadPoolExecutor() as pool:
        computed = pool.submit(measured)
        attempt(context)  # that only decodes
        assert (computed.done(), sandbox.ran) == (False, ["develop"])
        context.warmed.set()
        assert computed.result(60)


def test_too_little_memory_is_doubled_once_within_the_budget(context: JobContext, sandbox: Scripted) -> None:
    sandbox.answers["develop"] = [ended(MEMORY)]

    with pytest.raises(JobFailedError, match="too little"):
        attempt(context)

    assert [limits.memory_mb for limits in sandbox.limits] == [768, 1536]


def test_nobody_waits_between_crashes_for_what_nobody_wants(context: JobContext, sandbox: Scripted) -> None:
    asked = iter([True, False, False])
    sandbox.answers["develop"] = [ended(CRASHED)]

    with pytest.raises(NotWantedError):
        attempt(context, lambda: next(asked))


@pytest.fixture
def counted(context: JobContext, steps: Any) -> PhotoRow:
    photo: PhotoRow = steps.counted()
    context.storage.put(photo.blob_key, b"the file")
    return photo


def ask(context: JobContext, photo: PhotoRow, steps: Any, version: int = 1, **params: Any) -> str:
    lens = context.store.lenses.get(steps.lens_id(photo), ANY_OWNER)
    assert lens is not None
    output = {"format": "jpeg", "color_space": "srgb", "quality": 90}
    wish = {"method": "standard", "strength": 1.0, "output": output, "roi": None, **params}
    return context.store.jobs.correct(photo, lens, version, wish)[0].public_id


def correction(context: JobContext, key: str) -> None:
    durable("correction", partial(correct, context), partial(end_job, context.store))(key, 1)


def measure_once(context: JobContext, lens_id: str) -> None:
    durable("measure", partial(measure, context), partial(end_job, context.store))(lens_id, 1)


def write_result(arguments: dict[str, Any], folder: Path) -> Outcome:
    (folder / "result.jpg").write_bytes(b"a picture")
    (folder / SIDES["before"]).write_bytes(b"tiles")
    return Outcome(
        "ok", value={"file": "result.jpg", "report": {"zones": {"center": {"expected_gain_db": 3.0}}}}
    )


def test_a_correction_ends_with_a_file(
    context: JobContext, sandbox: Scripted, counted: PhotoRow, steps: Any
) -> None:
    sandbox.answers["correct"] = [write_result]
    key = ask(context, counted, steps)

    correction(context, key)

    row = context.store.jobs.get(key, ANY_OWNER)
    assert row is not None
    assert (row.state, row.result_media_type, row.result_bytes) == ("succeeded", "image/jpeg", 9)
    assert row.result_shown_bytes == len(context.storage.get(f"{row.run_folder}{SIDES['before']}")) == 5
    assert row.report == {"zones": {"center": {"expected_gain_db": 3.0}}}
    assert context.storage.get(row.result_key or "") == b"a picture"
    assert sandbox.files >= {KERNELS, SAMPLES}


def test_a_photographers_bounds_reach_the_correction_and_its_tag(
    context: JobContext, sandbox: Scripted, counted: PhotoRow, steps: Any
) -> None:
    given: list[dict[str, Any]] = []

    def keep(arguments: dict[str, Any], folder: Path) -> Outcome:
        given.append(arguments)
        return write_result(arguments, folder)

    sandbox.answers["correct"] = [keep, keep]
    for bounds in ({}, {"halo": 0.2, "denoise": 0.5}):
        correction(context, ask(context, counted, steps, **bounds))

    assert [one["bounds"] for one in given] == [{}, {"halo": 0.2, "denoise": 0.5}]
    assert given[0]["description"].endswith("strength 1")
    assert given[1]["description"].endswith("strength 1, halo 0.2, denoised 0.5")


def test_a_correction_with_a_version_without_samples_fails(
    context: JobContext, sandbox: Scripted, counted: PhotoRow, steps: Any
) -> None:
    key = ask(context, counted, steps)
    context.store.photos.change([counted.public_id], "local", {}, excluded=True)

    correction(context, key)

    row = context.store.jobs.get(key, ANY_OWNER)
    assert row is not None
    assert (row.state, row.error_code) == ("failed", "no_samples")


def test_a_correction_cancelled_while_its_file_was_stored_leaves_no_file(
    context: JobContext, sandbox: Scripted, counted: PhotoRow, steps: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    key, put = ask(context, counted, steps), context.storage.put

    def cancelled_meanwhile(blob: str, path: Path) -> None:
        put(blob, path)
        context.store.jobs.cancel(key, ANY_OWNER)

    monkeypatch.setattr(context.storage, "put", cancelled_meanwhile)
    sandbox.answers["correct"] = [write_result]
    correction(context, key)

    assert not list(context.storage.listed(f"corrections/{key}/"))


def test_a_child_cannot_hand_in_a_file_from_elsewhere(
    context: JobContext, sandbox: Scripted, counted: PhotoRow, steps: Any
) -> None:
    value = {"file": "../../../app.db", "report": {"zones": {}}}
    sandbox.answers["correct"] = [ok(value)]
    key = ask(context, counted, steps)

    correction(context, key)

    row = context.store.jobs.get(key, ANY_OWNER)
    assert row is not None
    assert (row.state, row.error_code) == ("failed", "internal_error")


def test_a_version_is_measured_once_and_its_history_says_so(
    context: JobContext, sandbox: Scripted, counted: PhotoRow, steps: Any
) -> None:
    sandbox.answers["measure"] = [ok({"error": {"mid": 0.2}, "coverage": {"mid": 4}})]
    lens_id = steps.lens_id(counted)
    before = unmeasured(context.store)

    measure_once(context, lens_id)

    assert before == [(lens_id, 1)]
    assert unmeasured(context.store) == []


def test_a_version_that_cannot_be_measured_is_not_tried_for_ever(
    context: JobContext, sandbox: Scripted, counted: PhotoRow, steps: Any
) -> None:
    sandbox.answers["measure"] = [refused("no_samples")]

    measure_once(context, steps.lens_id(counted))

    assert unmeasured(context.store) == []


def test_a_worker_that_was_paused_changes_nothing_of_what_another_finished(
    context: JobContext, sandbox: Scripted, counted: PhotoRow, steps: Any
) -> None:
    key = ask(context, counted, steps)

    def paused(arguments: dict[str, Any], folder: Path) -> Outcome:
        correction(context, key)  # of the worker that took over
        (folder / "result.jpg").write_bytes(b"another picture")
        return Outcome("ok", value={"file": "result.jpg", "report": {"zones": {}}})

    sandbox.answers["correct"] = [paused, write_result]
    correction(context, key)

    row = context.store.jobs.get(key, ANY_OWNER)
    assert row is not None
    assert (row.state, row.attempt, row.report) == (
        "succeeded",
        2,
        {"zones": {"center": {"expected_gain_db": 3.0}}},
    )
    assert context.storage.get(row.result_key or "") == b"a picture"


def test_a_run_of_before_a_retry_reports_nothing(
    context: JobContext, sandbox: Scripted, counted: PhotoRow, steps: Any
) -> None:
    key = ask(context, counted, steps)

    def retried(arguments: dict[str, Any], folder: Path) -> Outcome:
        context.store.jobs.cancel(key, ANY_OWNER)
        assert context.store.jobs.retry(key, ANY_OWNER)
        return write_result(arguments, folder)

    sandbox.answers["correct"] = [retried]
    correction(context, key)

    row = context.store.jobs.get(key, ANY_OWNER)
    assert row is not None
    assert (row.state, row.epoch, row.result_key) == ("queued", 2, None)


def test_where_a_photo_was_taken_is_gone_from_its_file_before_anything_else(
    context: JobContext, sandbox: Scripted, steps: Any
) -> None:
    picture = Image.fromarray(np.arange(64 * 48, dtype=np.uint8).reshape(48, 64))
    exif, out = Image.Exif(), io.BytesIO()
    exif.get_ifd(0x8825).update({1: "N", 2: (47.0, 13.0, 14.159), 3: "E", 4: (11.0, 22.0, 33.0)})
    picture.save(out, "jpeg", exif=exif)
    photo, sent = steps.receive(), out.getvalue()
    with context.store.database.writing() as session:
        session.execute(update(PhotoRow).values(byte_size=len(sent)))
    context.storage.put(photo.blob_key, sent)
    sandbox.answers["locate"] = [
        lambda arguments, folder: Outcome("ok", value=tasks.locate(arguments, folder, ignore_step))
    ]

    remove_location(context, steps.fresh(photo))

    cleaned = steps.fresh(photo)
    kept = context.storage.get(cleaned.blob_key)
    read = Image.open(io.BytesIO(kept))
    assert (cleaned.location, len(kept)) == ("removed", len(sent))
    assert not read.getexif().get_ifd(0x8825)
    assert np.array_equal(np.asarray(read), np.asarray(Image.open(out)))
    assert cleaned.file_sha256 == hashlib.sha256(kept).hexdigest()
    due = datetime.now(UTC) + timedelta(hours=1)
    assert photo.blob_key in context.store.jobs.garbage(at=due)
    remove_location(context, cleaned)
    assert sandbox.ran == ["locate"]  # once


def test_a_file_that_cannot_be_searched_is_processed_nevertheless(
    context: JobContext, sandbox: Scripted, steps: Any
) -> None:
    photo = steps.receive()
    context.storage.put(photo.blob_key, b"the file")
    sandbox.answers["locate"] = [refused("time_limit")]

    remove_location(context, photo)

    searched = steps.fresh(photo)
    assert (searched.location, searched.blob_key) == ("unknown", photo.blob_key)


def spoilt(answer: Any, path: str, value: object) -> Any:
    """Return an answer with another value at a place such as `metadata.lens.maker`."""
    whole = json.loads(json.dumps(answer))
    *inner, last = path.split(".")
    part = whole
    for name in inner:
        part = part[int(name) if name.isdecimal() else name]
    part[last] = value
    return whole


SELECTION = {"patches": [patch(0)], "rejected": [], "lateral": None}
WINDOW = {"row": 0, "col": 0, "size": 64, "r": 0.1, "phi": 0.1, "reason": "flat"}


@pytest.mark.parametrize(
    ("task", "answer"),
    [
        ("inspect", []),
        ("inspect", spoilt(INFO, "width", 2**40)),
        ("inspect", spoilt(INFO, "width", "600")),
        ("inspect", spoilt(INFO, "metadata.aperture", 1e300)),
        ("inspect", spoilt(INFO, "metadata.lens.serial_source", "x" * 60)),
        ("select", spoilt(SELECTION, "patches", [patch(0)] * 2001)),
        ("select", spoilt(SELECTION, "rejected", [WINDOW] * 100_001)),
        ("select", spoilt(SELECTION, "rejected", [WINDOW | {"reason": "x" * 61}])),
        ("select", spoilt(SELECTION, "patches.0.row", 2**70)),
        ("select", spoilt(SELECTION, "lateral", {"red": [1.0]})),
    ],
)
def test_an_answer_that_no_task_gives_ends_the_photo(
    work: Handler, sandbox: Scripted, photo: PhotoRow, steps: Any, task: str, answer: Any
) -> None:
    sandbox.answers[task] = [ok(answer)]

    work(photo.public_id, photo.epoch)

    ended = steps.fresh(photo)
    assert (ended.state, ended.error_code) == ("failed", "internal_error")
    assert len(ended.error_detail) < 300


@pytest.mark.parametrize(
    "report",
    [
        {"zones": {"elsewhere": {}}},
        {"zones": {"mid": {"reasons": ["x"] * 100}}},
        {"zones": {}, "audit": {"zones": {}, "tiles": [{"row": 1}]}},
        {"zones": {}, "audit": {"zones": {"mid": {"tiles": "many"}}}},
    ],
)
def test_a_report_that_no_correction_makes_ends_it(
    context: JobContext, sandbox: Scripted, counted: PhotoRow, steps: Any, report: dict[str, Any]
) -> None:
    def write(arguments: dict[str, Any], folder: Path) -> Outcome:
        return Outcome("ok", value=write_result(arguments, folder).value | {"report": report})

    sandbox.answers["correct"] = [write]
    key = ask(context, counted, steps)

    correction(context, key)

    row = context.store.jobs.get(key, ANY_OWNER)
    assert row is not None
    assert (row.state, row.error_code) == ("failed", "internal_error")


def test_a_name_that_is_too_long_is_cut_and_its_photo_goes_on(
    work: Handler, sandbox: Scripted, photo: PhotoRow, steps: Any
) -> None:
    sandbox.answers["inspect"] = [ok(spoilt(INFO, "metadata.camera_model", "x" * 5000))]

    work(photo.public_id, photo.epoch)

    assert (steps.fresh(photo).state, len(steps.fresh(photo).camera_model)) == ("counted", 200)
