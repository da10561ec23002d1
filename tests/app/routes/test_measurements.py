"""Photos made to measure a lens, on their way through the service."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from starlette.testclient import TestClient
from states import Steps, refusal

from app.jobs import tasks
from app.jobs.answers import SAMPLES, JobFailedError
from app.jobs.sample_files import write_samples
from app.jobs.work import _measured
from app.store import Store
from app.store.owners import ANY_OWNER
from lab.kernels import gaussian
from lensmodel.blind import sampling
from lensmodel.core.geometry import Frame
from lensmodel.core.psf import PsfSample
from lensmodel.core.registry import Registry
from lensmodel.core.types import FieldPosition, NoiseModel, ignore_step
from lensmodel.measured import MeasuredPsf
from lensmodel.photo import LinearPhoto
from lensmodel.photo.values import Encoding, PhotoInfo

PNG = b"\x89PNG\r\n\x1a\n" + b"\0" * 4096


PLACE = {"idx": 0, "row": 10, "col": 20, "side": 144, "r": 0.3, "phi": 0.1, "error": 0.04}


class AtTwoPlaces:
    """Measures the middle well in two colours, and a corner so badly that it cannot say how badly."""

    name: ClassVar[str] = "quick"
    version: ClassVar[int] = 3
    photos: ClassVar[int] = 1

    def measure(self, photos: Sequence[LinearPhoto], *, size: int, **_: Any) -> list[MeasuredPsf]:
        kernel, middle, corner = gaussian(size, np.eye(2)), FieldPosition(0.1, 0.2), FieldPosition(0.9, -2.0)
        return [
            MeasuredPsf(kernel, middle, "g", 0.04, (30.0, 40.0), 21),
            MeasuredPsf(kernel, corner, "g", math.inf, (50.5, 4.5), 8),
            MeasuredPsf(kernel, middle, "r", 0.05, (30.0, 40.0), 21),
        ]


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
        [0, 20, 30, 21, 0.96],
        [1, 47, 1, 8, 0],
    ]
    assert [(number, sample.settings.channel, sample.error) for number, sample in samples] == [
        (0, "g", 0.04),
        (1, "g", 1.0),
        (0, "r", 0.05),
    ]
    assert {(sample.estimator, sample.weight) for _, sample in samples} == {("measured-quick/3", 1.0)}


@pytest.mark.parametrize(
    "changed",
    [
        *({"settings": {"channel": "x"}}, {"r": 2.0}, {"weight": 2.0}, {"row": "a"}),
        *({"error": error} for error in (None, 7.0, math.nan)),
        *({"idx": number} for number in (-1, math.inf)),
    ],
)
def test_nonsense_of_a_child_is_refused(tmp_path: Path, changed: dict[str, Any]) -> None:
    said = PLACE | {"settings": {"channel": "g"}} | changed
    with pytest.raises(JobFailedError):  # it gave no kernels
        _measured([said], tmp_path)
    write_samples(tmp_path, [PsfSample(gaussian(15, np.eye(2)), FieldPosition(0.0, 0.0), estimator="any/1")])
    (entry,) = json.loads((tmp_path / SAMPLES).read_text())
    (tmp_path / SAMPLES).write_text(json.dumps([entry | said]))

    with pytest.raises(JobFailedError, match="gave no kernels"):
        _measured([said], tmp_path)


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
    ):
        assert refusal(client.post(f"/v1/{path}", content=PNG)) == (404, code)
