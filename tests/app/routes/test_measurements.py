"""Photos made to measure a lens, on their way through the service."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from app.jobs.context import JobFailedError
from app.jobs.measurement_work import _checked
from app.jobs.task_files import KERNELS
from app.store import Store
from lensmodel.core.psf import gaussian

Steps = Any  # the fixture `steps` of conftest.py; test modules do not import each other
PNG = b"\x89PNG\r\n\x1a\n" + b"\0" * 4096


def place(number: int, channel: str = "g", **changed: Any) -> dict[str, Any]:
    entry = {"idx": number, "row": 10, "col": 20, "side": 144, "r": 0.3, "phi": 0.1 * number}
    return entry | {"channel": channel, "error": 0.04, "estimator": "measured-target/1"} | changed


def answered(folder: Path, listed: list[dict[str, Any]]) -> list[dict[str, Any]]:
    np.save(folder / KERNELS, np.stack([gaussian(15, np.eye(2))] * len(listed)))
    return listed


def test_what_a_child_measured_becomes_patches_with_samples(tmp_path: Path) -> None:
    patches, samples = _checked(answered(tmp_path, [place(0), place(0, "r"), place(1)]), tmp_path)
    assert [patch.idx for patch in patches] == [0, 1]
    assert [(new.idx, new.sample.settings.channel, new.sample.error) for new in samples] == [
        (0, "g", 0.04),
        (0, "r", 0.04),
        (1, "g", 0.04),
    ]
    assert {new.sample.estimator for new in samples} == {"measured-target/1"}


@pytest.mark.parametrize(
    "changed",
    [{"channel": "x"}, {"error": 7.0}, {"error": float("nan")}, {"r": 2.0}, {"idx": -1}, {"row": "a"}],
)
def test_nonsense_of_a_child_is_refused(tmp_path: Path, changed: dict[str, Any]) -> None:
    with pytest.raises(JobFailedError, match="gave no kernels"):
        _checked(answered(tmp_path, [place(0, **changed)]), tmp_path)


def test_a_measurement_without_kernels_is_refused(tmp_path: Path) -> None:
    with pytest.raises(JobFailedError):
        _checked([place(0)], tmp_path)


def test_a_measurement_is_sent_to_its_lens(client: TestClient, steps: Steps, store: Store) -> None:
    counted = steps.counted()
    lens = client.get(f"/v1/photos/{counted.public_id}").json()["lens_id"]
    answer = client.post(
        f"/v1/lenses/{lens}/measurements",
        data={"kind": "target", "aperture": "2.8"},
        files={"file": ("page.png", PNG)},
    )
    assert answer.status_code == 202, answer.text
    assert answer.json()["kind"] == "target"
    row = store.photos.get(answer.json()["id"])
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
    counted = steps.counted()
    lens = client.get(f"/v1/photos/{counted.public_id}").json()["lens_id"]
    answer = client.post(f"/v1/lenses/{lens}/measurements", data=fields, files={"file": ("page.png", PNG)})
    assert answer.status_code == 422
    assert word in answer.text


def test_a_measurement_of_an_unknown_lens_or_reference_is_a_404(client: TestClient, steps: Steps) -> None:
    answer = client.post("/v1/lenses/nobody/measurements?kind=target", content=PNG)
    assert (answer.status_code, answer.json()["code"]) == (404, "unknown_lens")
    answer = client.post("/v1/photos?kind=pair&reference_id=nobody", content=PNG)
    assert (answer.status_code, answer.json()["code"]) == (404, "unknown_photo")
