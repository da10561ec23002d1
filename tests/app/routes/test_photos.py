"""Photos and their jobs over HTTP: seen, changed, cancelled, deleted, and made to measure a lens."""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient
from states import TIFF, Steps, refusal, stored

from app.http.dependencies import Call
from app.jobs import tasks
from app.jobs.answers import JobFailedError
from app.jobs.sample_files import write_samples
from app.jobs.work import _measured
from app.routes import jobs
from app.runtime.settings import Settings
from app.schemas import JobOut
from app.store import Store
from app.store.owners import ANY_OWNER
from lab.kernels import gaussian
from lensmodel.blind import sampling
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import PsfSample
from lensmodel.core.registry import Registry
from lensmodel.core.types import Channel, FieldPosition, Frame, NoiseModel, StepHook, ignore_step
from lensmodel.measured.measurer import Found, Measurer, Prepared
from lensmodel.photo import LinearPhoto
from lensmodel.photo.values import Encoding, PhotoInfo


def get(client: TestClient, path: str) -> dict[str, Any]:
    answer = client.get(f"/v1/{path}")
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def change(client: TestClient, photo: Any, **said: Any) -> Any:
    return client.patch(f"/v1/photos/{photo.public_id}", json=said)


def after_two_reads(patch: pytest.MonkeyPatch, change: Callable[[], object] = lambda: None) -> list[str]:
    """Let a change happen once a watching request has read its job twice; return what it reads."""
    find, reads = jobs.find_job, list[str]()

    def find_then_change(call: Call, job_id: str) -> JobOut:
        job = find(call, job_id)
        reads.append(job_id)
        if len(reads) == 2:
            change()
        return job

    patch.setattr(jobs, "find_job", find_then_change)
    return reads


def test_a_counted_photo_shows_its_lens_and_patches_and_no_serial(client: TestClient, steps: Steps) -> None:
    photo = steps.counted(serial="SECRET-77")

    shown = get(client, f"photos/{photo.public_id}")

    assert (shown["state"], shown["lens_id"]) == ("counted", steps.lens_id(photo))
    assert shown["patches"] == {"total": 2, "done": 2, "rejected": 1}
    assert shown["links"]["lens"] == f"/v1/lenses/{shown['lens_id']}"
    assert (shown["width"], shown["focal_length_mm"], shown["pixel_pitch_um"]) == (6000, 24.0, 6.0)
    assert "SECRET-77" not in str((shown, get(client, f"jobs/{photo.public_id}")))
    patches = get(client, f"photos/{photo.public_id}/patches")["items"]
    told = [(patch["state"], patch["reason"]) for patch in patches]
    assert told == [("done", None), ("done", None), ("rejected", "flat")]


def test_photos_are_listed_by_state(client: TestClient, steps: Steps) -> None:
    counted = steps.counted()
    steps.receive()

    assert [photo["id"] for photo in get(client, "photos?state=counted")["items"]] == [counted.public_id]


def test_excluding_a_photo_takes_it_out_of_the_lens_and_back(client: TestClient, steps: Steps) -> None:
    photo = steps.counted()
    lens = f"lenses/{steps.lens_id(photo)}"

    for excluded, state, samples, version in (
        (True, "excluded", 0, 2),
        (True, "excluded", 0, 2),  # again: no version of its own
        (False, "counted", 6, 3),
    ):
        answer = change(client, photo, excluded=excluded)
        known = get(client, lens)
        assert (answer.status_code, answer.json()["state"]) == (200, state)
        assert (known["samples"], known["version"]) == (samples, version)

    assert refusal(change(client, steps.receive(), excluded=True)) == (409, "conflict")


def test_a_photo_that_was_stored_can_still_teach_its_lens_unless_its_file_is_gone(
    client: TestClient, steps: Steps, store: Store
) -> None:
    photo, gone = stored(steps), stored(steps)
    assert store.photos.give_up_file(gone.public_id, ())

    begun = change(client, photo, calibrate=True, aperture=2.8)
    again = change(client, photo, calibrate=True)  # nothing begins twice

    assert (begun.status_code, begun.json()["state"], begun.json()["calibrate"]) == (200, "received", True)
    assert again.status_code == 200
    row = steps.fresh(photo)
    assert (row.epoch, row.given["aperture"]) == (photo.epoch + 1, 2.8)
    assert change(client, photo, calibrate=False).status_code == 422
    refused = change(client, gone, calibrate=True)
    assert refusal(refused) == (409, "conflict")
    assert "send the same file again" in refused.json()["detail"]
    assert get(client, f"photos/{gone.public_id}")["calibrate"] is False


@pytest.mark.parametrize("way", ["lens_id", "lens_serial", "new_lens"])
def test_a_photo_waits_for_its_lens_and_starts_again(client: TestClient, steps: Steps, way: str) -> None:
    known, photo = steps.lens_id(steps.counted(serial="123")), steps.waiting()
    job, shown = (get(client, f"{kind}/{photo.public_id}") for kind in ("jobs", "photos"))
    name = {"lens_id": known, "lens_serial": "123", "new_lens": {"label": "the scratched one"}}[way]

    answer = change(client, photo, **{way: name})

    assert job["state"] == "waiting"
    assert job["error"]["code"] == shown["error"]["code"] == "metadata_missing"
    again = steps.fresh(photo)
    assert (answer.json()["state"], again.epoch) == ("received", 2)
    steps.inspect(again, serial=None)
    assert (steps.lens_id(photo) == known) == (way != "new_lens")


def test_a_change_happens_wholly_or_not_at_all(client: TestClient, steps: Steps, store: Store) -> None:
    photo = steps.receive()
    store.photos.fail(photo.public_id, 1, "no_usable_patches", "all is sky")

    answer = change(client, photo, aperture=2.0, new_lens={"label": "mine"}, excluded=True)

    assert refusal(answer) == (409, "conflict")
    assert get(client, "lenses")["items"] == []
    assert (steps.fresh(photo).state, steps.fresh(photo).epoch) == ("failed", 1)


def test_a_counted_photo_moves_to_another_lens_and_aperture(client: TestClient, steps: Steps) -> None:
    mine, other = steps.counted(serial="1"), steps.counted(serial="2")
    left = f"lenses/{steps.lens_id(mine)}"

    moved = change(client, mine, lens_id=steps.lens_id(other)).json()
    lens = get(client, f"lenses/{steps.lens_id(other)}")
    opened = change(client, mine, aperture=2.0).json()
    renewed = get(client, f"lenses/{steps.lens_id(other)}")

    assert (moved["lens_id"], lens["photos"], opened["aperture"]) == (lens["id"], 2, 2.0)
    assert (lens["samples"], get(client, left)["samples"]) == (12, 0)
    assert (renewed["version"], renewed["apertures"]) == (lens["version"] + 1, [1.4, 2.0])


def test_deleting_a_photo_deletes_file_samples_and_job(client: TestClient, settings: Settings) -> None:
    photo = client.post("/v1/photos", content=TIFF).json()["id"]

    deleted = [client.delete(f"/v1/photos/{photo}").status_code for _ in range(2)]

    assert deleted == [204, 404]
    assert [client.get(f"/v1/{kind}/{photo}").status_code for kind in ("photos", "jobs")] == [404, 404]
    assert list((settings.data_dir / "blobs" / "photos").iterdir()) == []
    assert client.post("/v1/photos", content=TIFF).status_code == 202


def test_a_job_tells_how_far_it_is(client: TestClient, steps: Steps) -> None:
    photo = steps.planned()
    steps.estimate(photo, (0,))

    job = get(client, f"jobs/{photo.public_id}")

    told = [job[name] for name in ("id", "kind", "state", "stage")]
    assert told == [photo.public_id, "photo", "running", "estimating"]
    assert job["progress"] == {"done": 1, "total": 2, "unit": "patches"}
    assert job["eta_seconds"] >= 0
    assert job["links"]["photo"] == f"/v1/photos/{photo.public_id}"


def test_a_waiting_request_answers_at_the_change(
    client: TestClient, steps: Steps, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo = steps.receive()
    after_two_reads(monkeypatch, lambda: store.photos.set_state(photo.public_id, ("received",), "inspecting"))
    began = time.monotonic()

    job = get(client, f"jobs/{photo.public_id}?wait=10")

    assert job["stage"] == "inspecting"
    assert time.monotonic() - began < 8.0  # it did not wait to the end


def test_a_finished_job_answers_at_once(
    client: TestClient, steps: Steps, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo, reads = steps.counted(), after_two_reads(monkeypatch)
    monkeypatch.setattr(jobs, "LOOK_S", 60.0)

    assert get(client, f"jobs/{photo.public_id}?wait=20")["state"] == "succeeded"
    assert reads == [photo.public_id]


def test_events_send_each_state_once_until_the_end_which_who_comes_again_is_told_alone(
    client: TestClient, steps: Steps, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = f"/v1/jobs/{(photo := steps.receive()).public_id}"
    after_two_reads(monkeypatch, lambda: store.photos.cancel(photo.public_id, ANY_OWNER))

    told = [client.get(f"{path}/events").text for _ in range(2)]

    events = [
        [json.loads(data)["state"] for data in re.findall(r"^data: (.*)$", text, re.MULTILINE)]
        for text in told
    ]
    assert events == [["queued", "cancelled"], ["cancelled"]]
    assert refusal(client.post(f"{path}/cancel")) == (409, "conflict")
    other = client.post(f"/v1/jobs/{steps.receive().public_id}/cancel")
    assert (other.status_code, other.json()["state"]) == (202, "cancelled")


# --- photos made to measure a lens ------------------------------------------------------------------


PNG = b"\x89PNG\r\n\x1a\n" + b"\0" * 4096


PLACE = {"idx": 0, "row": 10, "col": 20, "side": 144, "r": 0.3, "phi": 0.1, "error": 0.04}


class AtTwoPlaces(Measurer):
    """Measures the middle in green and red, and a corner in green."""

    name, floor, shows = "quick", 0.0, ""

    def _prepare(self, photos: Sequence[LinearPhoto], size: int, on_step: StepHook) -> Prepared:
        def psf_in(place: tuple[float, float], channel: Channel) -> Found:
            if channel == "b" or (channel == "r" and place[0] > 40.0):
                raise NotEnoughEvidenceError("seen in no other colour")
            return Found(gaussian(size, np.eye(2)), 0.04 if channel == "g" else 0.05, place)

        return [(30.0, 40.0), (50.0, 12.0)], psf_in


def test_what_the_task_measures_arrives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    planes, noise, info = np.zeros((3, 60, 80), np.float32), NoiseModel.white(0.01), PhotoInfo("dng", 80, 60)
    shot = LinearPhoto(planes, Frame(60, 80), (noise,) * 3, (1.0, 1.0, 1.0), info, Encoding())
    sampling.save_developed(shot, tmp_path / "developed")
    monkeypatch.setattr(tasks.lens_measure, "methods", Registry("way of measuring", {"quick": AtTwoPlaces}))
    settings = {"aperture": 2.8, "focal_mm": None, "focus_m": -1.0}
    arguments = {"developed": [str(tmp_path / "developed")], "photo": "p1", "settings": settings}

    listed = tasks.measure_lens(arguments | {"kind": "quick", "size": 15}, tmp_path, ignore_step)
    patches, samples = _measured(json.loads(json.dumps(listed)), tmp_path)

    assert [[p[name] for name in ("cell", "row", "col", "size", "score")] for p in patches] == [
        [0, 23, 33, 15, 0.95],
        [1, 43, 5, 15, 0.96],
    ]
    assert [(number, sample.settings.channel, sample.error) for number, sample in samples] == [
        (0, "r", 0.05),
        (0, "g", 0.04),
        (1, "g", 0.04),
    ]
    assert {(sample.estimator, sample.weight) for _, sample in samples} == {("measured-quick/1", 1.0)}


def test_nonsense_of_a_child_is_refused(tmp_path: Path) -> None:
    def measured(error: float | None = 0.04, **place: Any) -> None:
        at = FieldPosition(0.0, 0.0)
        write_samples(tmp_path, [PsfSample(gaussian(15, np.eye(2)), at, estimator="any/1", error=error)])
        _measured([PLACE | place], tmp_path)

    with pytest.raises(JobFailedError, match="gave no kernels"):
        _measured([PLACE], tmp_path)
    measured()
    for nonsense in ({"row": "a"}, {"idx": -1}, {"idx": math.inf}, {"error": None}):
        with pytest.raises(JobFailedError, match="gave no kernels"):
            measured(**nonsense)


def send(client: TestClient, steps: Steps, **fields: str) -> tuple[Any, str]:
    """Send a measurement to a known lens; return the answer and the lens."""
    lens = steps.lens_id(steps.counted())
    page = {"file": ("page.png", PNG)}
    return client.post(f"/v1/lenses/{lens}/measurements", data=fields, files=page), lens


def test_a_measurement_is_sent_to_its_lens(client: TestClient, steps: Steps, store: Store) -> None:
    answer, lens = send(client, steps, kind="target", aperture="2.8")

    assert (answer.status_code, answer.json()["kind"]) == (202, "target"), answer.text
    row = store.photos.get(answer.json()["id"], ANY_OWNER)
    assert row is not None
    assert row.given["lens_id"] == lens


@pytest.mark.parametrize(
    ("fields", "word"),
    [
        ({}, "kind is missing"),
        ({"kind": "pair"}, "reference_id"),
        ({"kind": "target", "reference_id": "abc"}, "reference_id"),
        ({"kind": "target", "calibrate": "false"}, "exclude"),
        ({"kind": "target", "selector": "good-regions"}, "leave one out"),
        ({"kind": "tarot"}, "kind"),
    ],
)
def test_a_measurement_that_makes_no_sense_is_refused(
    client: TestClient, steps: Steps, fields: dict[str, str], word: str
) -> None:
    answer, _ = send(client, steps, **fields)

    assert answer.status_code == 422
    assert word in answer.text


def test_a_measurement_of_an_unknown_lens_or_reference_is_a_404(client: TestClient) -> None:
    for path, code in (
        ("lenses/nobody/measurements?kind=target", "unknown_lens"),
        ("photos?kind=pair&reference_id=nobody", "unknown_photo"),
        ("photos?lens_id=nothing", "unknown_lens"),
    ):
        assert refusal(client.post(f"/v1/{path}", content=PNG)) == (404, code)
