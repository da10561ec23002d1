"""Pages and their pictures as they are served, without a browser."""

from __future__ import annotations

import io
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image
from starlette.testclient import TestClient

from app.jobs import tasks
from app.jobs.handover import BEFORE, PREVIEW, R_MAP
from app.settings import Settings
from app.storage import Storage
from app.store import Store
from app.store.corrections import Result
from app.store.photos import folder_of
from lensmodel.types import ignore_step

Steps = Any  # the fixture `steps` of conftest.py; test modules do not import each other


def opened(client: TestClient, path: str) -> Image.Image:
    answer = client.get(path)
    assert answer.status_code == 200, answer.text
    return Image.open(io.BytesIO(answer.content))


def test_a_preview_and_an_r_map_come_from_the_blobs_upright_in_any_size(
    client: TestClient, steps: Steps, settings: Settings, tmp_path: Path
) -> None:
    scene = np.random.default_rng(1).integers(0, 255, (90, 120, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was held upright
    Image.fromarray(scene).save(tmp_path / "p.jpg", exif=exif, quality=95)
    tasks.develop({"path": str(tmp_path / "p.jpg"), "max_megapixels": 1.0}, tmp_path, ignore_step)
    photo = steps.counted()
    for name in (PREVIEW, R_MAP):
        Storage(settings.storage).put_file(f"{folder_of(photo)}{name}", tmp_path / name)

    for name in (PREVIEW, R_MAP):
        assert opened(client, f"/ui/photos/{photo.public_id}/{name}").size == (90, 120)
        assert opened(client, f"/ui/photos/{photo.public_id}/{name}?size=40").size == (30, 40)


def test_no_photo_is_too_long_for_a_preview(tmp_path: Path) -> None:
    Image.new("RGB", (30000, 16), "gray").save(tmp_path / "p.png")

    tasks.develop({"path": str(tmp_path / "p.png"), "max_megapixels": 1.0}, tmp_path, ignore_step)

    assert {PREVIEW, R_MAP} <= {path.name for path in tmp_path.iterdir()}


@pytest.fixture
def corrected(client: TestClient, steps: Steps, store: Store, settings: Settings) -> dict[str, Any]:
    """A correction that has changed nothing: the file is the photo as it was."""
    answer = client.post("/v1/corrections", json={"photo_id": steps.counted().public_id})
    made: dict[str, Any] = answer.json()
    scene = np.zeros((60, 80, 3), dtype=np.uint16)
    scene[:20, :20] = 65535
    file, before = io.BytesIO(), io.BytesIO()
    tifffile.imwrite(file, scene)
    Image.fromarray((scene >> 8).astype(np.uint8)).save(before, "JPEG", quality=97)
    blobs, folder = Storage(settings.storage), f"corrections/{made['id']}/"
    blobs.put(f"{folder}result.tif", file.getvalue())
    blobs.put(f"{folder}{BEFORE}", before.getvalue())
    store.corrections.start(made["id"])
    result = Result(f"{folder}result.tif", "etag", "image/tiff", 1, "p.tif")
    assert store.corrections.finish(made["id"], result, {"zones": {}})
    return made


def test_tiles_before_and_after_show_one_place_and_are_decoded_once(
    client: TestClient, corrected: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    storage = client.app.state.services.storage  # type: ignore[attr-defined] # Starlette's own attribute
    read, get = list[str](), storage.get
    monkeypatch.setattr(storage, "get", lambda key: read.append(key) or get(key))
    query = "row=0&col=0&width=40&height=40"
    paths = [
        f"/ui/corrections/{corrected['id']}/crop.png?{query}",
        f"/ui/photos/{corrected['photo_id']}/crop.png?correction={corrected['id']}&{query}",
    ]

    with ThreadPoolExecutor(4) as pool:
        tiles = list(pool.map(lambda path: opened(client, path), paths * 4))

    assert len(read) == 2
    shown = [np.asarray(tile).astype(float) for tile in tiles]
    assert all(np.abs(tile - shown[0]).max() < 8 for tile in shown)
    assert shown[0][5, 5].tolist() == [255, 255, 255]


def test_a_dng_is_not_compared(client: TestClient, steps: Steps, store: Store) -> None:
    wish = {"photo_id": steps.counted().public_id, "output": {"format": "dng"}}
    made = client.post("/v1/corrections", json=wish).json()
    store.corrections.start(made["id"])
    store.corrections.finish(made["id"], Result("k", "e", "image/x-adobe-dng", 1, "p.dng"), {"zones": {}})

    page = client.get(f"/corrections/{made['id']}")
    tile = client.get(f"/ui/corrections/{made['id']}/crop.png?row=0&col=0")

    assert 'id="compare"' not in page.text
    assert (tile.status_code, tile.json()["code"]) == (422, "invalid_parameter")


def test_a_photo_that_lacks_only_its_aperture_is_asked_for_nothing_else(
    client: TestClient, steps: Steps, store: Store
) -> None:
    photo = steps.receive()
    steps.inspect(photo, aperture=None)
    store.photos.set_state(photo.public_id, ("inspecting",), "needs_lens")

    page = client.get(f"/photos/{photo.public_id}").text

    assert 'name="aperture"' in page
    assert 'name="label"' not in page
    assert "aperture was it?" in page


def test_a_lens_page_shows_the_newest_of_many_versions(
    client: TestClient, steps: Steps, store: Store
) -> None:
    photo = steps.counted()
    lens_id = steps.lens_id(photo)
    for _ in range(201):
        store.photos.change(photo.public_id, "local", {"aperture": 2.0})
    store.lenses.record_metrics(lens_id, 202, {"error": {}, "coverage": {"corner": 77}})

    page = client.get(f"/lenses/{lens_id}").text

    assert "<td>202</td>" in page
    assert "77 places" in page
