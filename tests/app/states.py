"""Photos, lenses and corrections in the states that tests of routes and pages begin with."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from starlette.testclient import TestClient

from app.http.dependencies import Services
from app.store.lenses import report_key
from app.store.owners import ANY_OWNER
from app.store.tables import PhotoRow
from lensmodel.core.files import to_json
from lensmodel.model import LensModel
from lensmodel.report.lens_report import lens_report

Steps = Any  # the fixture `steps` of conftest.py
TIFF = b"II*\x00" + bytes(9000)
FILE = bytes(range(256)) * 40
"""What a correction ended with."""


def services_of(client: TestClient) -> Services:
    """Return the parts of the application that a client speaks with."""
    return client.app.state.services  # type: ignore[attr-defined] # Starlette's own attribute


def refusal(answer: Any) -> tuple[int, str]:
    """Return status and code of a problem."""
    return answer.status_code, answer.json()["code"]


def stored(steps: Steps, **seen: Any) -> PhotoRow:
    """Return a photo that is to teach no lens."""
    photo = steps.receive(calibrate=False)
    steps.inspect(photo, **seen)
    steps.store.photos.set_state(photo.public_id, ("inspecting",), "stored")
    return photo


def failed(steps: Steps, code: str = "raw_decode_failed", detail: str = "damaged", **seen: Any) -> PhotoRow:
    """Return a photo that failed after it was inspected."""
    photo = steps.receive()
    steps.inspect(photo, **seen)
    steps.store.photos.fail(photo.public_id, photo.epoch, code, detail)
    return photo


def finish(
    client: TestClient,
    correction_id: str,
    content: bytes = FILE,
    *,
    report: dict[str, Any] | None = None,
    **made: Any,
) -> None:
    """End a correction with a file."""
    services, key = services_of(client), f"corrections/{correction_id}/result"
    services.storage.put(key, content)
    run = services.store.jobs.start(correction_id, 1)
    assert run is not None
    file = {"key": key, "etag": hashlib.sha256(content).hexdigest(), "bytes": len(content)}
    named = {"media_type": "image/png", "name": "o.png"}
    assert services.store.jobs.finish(run, report or {}, **{**file, **named, **made})


def store_report(client: TestClient, lens_id: str) -> None:
    """Write the report of the newest version of a lens, as a worker does."""
    services = services_of(client)
    _, samples = services.store.lenses.samples_of(lens_id)
    report = lens_report(LensModel.fit(samples), "A lens", rows=5, size=15)
    lens = services.store.lenses.get(lens_id, ANY_OWNER)
    assert lens is not None
    key = report_key(lens_id, lens.version, lens.rebuild_epoch)
    services.storage.put(key, json.dumps(to_json(report)).encode())
