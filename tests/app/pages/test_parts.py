"""Pages and their pictures as they are served, without a browser."""

from __future__ import annotations

import html
import io
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image
from sqlalchemy import event
from starlette.testclient import TestClient

from app.blobs.storage import Storage
from app.blobs.tiles import tile, whole, write_tiles
from app.jobs import tasks
from app.jobs.answers import LAYER_FILES, SHOWN, SIDES, THUMBNAIL
from app.jobs.sample_files import write_samples
from app.jobs.work import body_key
from app.main import create_app
from app.pages.routes import templates, unused_name
from app.pages.shown import cell_px, grouped
from app.runtime.settings import Settings
from app.store import LensName, Store
from app.store.owners import ANY_OWNER
from app.store.tables import PhotoRow
from lab.kernels import gaussian
from lensmodel.core.geometry import Frame
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings, ignore_step
from lensmodel.correction.lattice import cells
from lensmodel.photo import upright
from lensmodel.photo.dng import write_bayer_dng

Steps = Any  # the fixture `steps` of conftest.py; test modules do not import each other


def opened(client: TestClient, path: str) -> Image.Image:
    answer = client.get(path)
    assert answer.status_code == 200, answer.text
    return Image.open(io.BytesIO(answer.content))


def test_a_developed_photo_comes_from_the_blobs_upright(
    client: TestClient, steps: Steps, settings: Settings, tmp_path: Path
) -> None:
    scene = np.random.default_rng(1).integers(0, 255, (90, 120, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was held upright
    Image.fromarray(scene).save(tmp_path / "p.jpg", exif=exif, quality=95)
    tasks.develop({"path": str(tmp_path / "p.jpg"), "max_megapixels": 1.0}, tmp_path, ignore_step)
    photo = steps.counted()
    Storage(settings.storage).put(f"{photo.folder}{SHOWN}", tmp_path / SHOWN)

    assert opened(client, f"/ui/photos/{photo.public_id}/tiles/before/whole.jpg").size == (90, 120)


def test_no_photo_is_too_long_for_a_preview(tmp_path: Path) -> None:
    Image.new("RGB", (30000, 16), "gray").save(tmp_path / "p.png")

    tasks.develop({"path": str(tmp_path / "p.png"), "max_megapixels": 1.0}, tmp_path, ignore_step)

    assert (tmp_path / SHOWN).is_file()


def a_picture() -> NDArray[np.uint8]:
    """A picture of 1300 x 700 with a white corner."""
    scene = np.full((700, 1300, 3), 40, dtype=np.uint8)
    scene[:20, :20] = 255
    return scene


def finished(
    client: TestClient, steps: Steps, store: Store, settings: Settings, *, nothing: bool
) -> dict[str, Any]:
    wish = {"photo_id": steps.counted().public_id, "output": {"format": "dng"}}
    made: dict[str, Any] = client.post("/v1/corrections", json=wish).json()
    blobs, folder = Storage(settings.storage), f"corrections/{made['id']}/1-1/"
    blobs.put(f"{folder}result.dng", b"a file that the pages never open")
    for name in SIDES.values():
        write_tiles(settings.data_dir / name, a_picture())
        blobs.put(f"{folder}{name}", settings.data_dir / name)
    run = store.jobs.start(made["id"], 1)
    assert run is not None
    audit = {
        "zones": {"center": {"tiles": 4, "tiles_held": 1, "held_back": 0.1, "checks": {"re-blur": 0.1}}},
        "tiles": [{"row": 0, "col": 200, "held_back": 0.4}],
        "tile_side": 100,
    }
    result: Any = {
        "key": f"{folder}result.dng",
        "etag": "etag",
        "media_type": "image/x-adobe-dng",
        "bytes": 1,
        "name": "p.dng",
    }
    report = {"zones": {}, "nothing_to_correct": nothing, "audit": audit}
    assert store.jobs.finish(run, report, **result)
    return made


@pytest.fixture
def corrected(client: TestClient, steps: Steps, store: Store, settings: Settings) -> dict[str, Any]:
    """A correction to a DNG."""
    return finished(client, steps, store, settings, nothing=False)


@pytest.fixture
def unchanged(client: TestClient, steps: Steps, store: Store, settings: Settings) -> dict[str, Any]:
    """A correction that was not worth it."""
    return finished(client, steps, store, settings, nothing=True)


def no_decoder(*_: Any) -> Any:
    raise AssertionError("a picture is decoded beside the keys of all owners")


def test_tiles_before_and_after_show_one_place_and_are_not_decoded(
    client: TestClient, corrected: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    base = f"/ui/corrections/{corrected['id']}/tiles"
    paths = [f"{base}/{side}/0/0_0.jpg" for side in ("before", "after")]
    others = ("0/2_1", "1/1_0", "2/0_0", "whole", "places/0", "places/8")
    paths += [f"{base}/after/{name}.jpg" for name in others]

    with monkeypatch.context() as patch:
        patch.setattr(Image, "open", no_decoder)
        patch.setattr(Image, "fromarray", no_decoder)
        answers = [client.get(path) for path in paths]

    assert [answer.status_code for answer in answers] == [200] * len(paths)
    shown = [np.asarray(Image.open(io.BytesIO(answer.content))).astype(float) for answer in answers]
    assert np.array_equal(shown[0], shown[1])
    assert shown[0][5, 5].min() > 245
    assert [picture.shape[:2] for picture in shown[2:]] == [
        (700 - 512, 1300 - 1024),
        (350, 650 - 512),
        (175, 325),
        (700, 1300),
        (170, 255),
        (170, 255),
    ]
    assert (shown[6][5, 5].min() > 245, shown[7][5, 5].max() < 60) == (True, True)
    missing = ("0/9_9", "3/0_0", "places/9")
    assert [client.get(f"{base}/after/{name}.jpg").status_code for name in missing] == [404] * 3


@pytest.mark.parametrize("change", ["empty", "cut", "count", "offsets", "size"])
def test_tiles_that_a_child_wrote_wrongly_are_refused(
    client: TestClient, corrected: dict[str, Any], settings: Settings, change: str
) -> None:
    blobs, key = Storage(settings.storage), f"corrections/{corrected['id']}/1-1/{SIDES['after']}"
    data = bytearray(blobs.get(key))
    if change == "empty":
        data = bytearray()
    elif change == "cut":
        del data[3000:]
    elif change == "count":
        data[12:16] = (2**32 - 1).to_bytes(4, "little")
    elif change == "offsets":
        data[24:32] = (2**63).to_bytes(8, "little")
    else:
        data[4:12] = (2**32 - 1).to_bytes(4, "little") * 2
    blobs.put(key, bytes(data))

    answers = [
        client.get(f"/ui/corrections/{corrected['id']}/tiles/after/{name}.jpg") for name in ("whole", "0/0_0")
    ]

    assert {answer.status_code for answer in answers} == {409}


def test_the_smallest_and_longest_pictures_have_tiles(tmp_path: Path) -> None:
    for height, width in ((1, 1), (2, 30000), (513, 512)):
        write_tiles(tmp_path / "x.tiles", np.zeros((height, width, 3), np.uint8))
        storage = Storage(f"file://{tmp_path}")
        assert Image.open(io.BytesIO(whole(storage, "x.tiles"))).width <= 1600
        assert Image.open(io.BytesIO(tile(storage, "x.tiles", 0, 0, 0))).height == min(height, 512)


def test_a_corrected_dng_is_looked_at_and_its_audit_told(
    client: TestClient, corrected: dict[str, Any]
) -> None:
    page = client.get(f"/corrections/{corrected['id']}").text

    assert 'id="viewer"' in page
    assert "10 % of the correction was held back over the whole photo." in page
    assert "detail that does not match the photo: 10.0 %" in page
    assert '<rect x="200" y="0" width="100" height="100" fill-opacity="0.44"/>' in page
    assert "open it in your RAW developer" in page


def held_tiles(audit: dict[str, Any], height: int, width: int, orientation: int) -> list[list[int]]:
    """Return left, top, right and bottom of what is drawn of each tile, in the upright photo."""
    macros: Any = templates.get_template("_gain.html").module
    drawn = str(macros.held_map(audit, height, width, orientation))
    numbers = re.search(r"matrix\((.*?)\)", drawn)
    assert numbers is not None
    a, b, c, d, e, f = map(int, numbers[1].split())
    tiles = []
    for rect in re.findall(r'<rect x="(\d+)" y="(\d+)" width="(\d+)" height="(\d+)"', drawn):
        x, y, across, down = map(int, rect)
        ends = [(a * u + c * v + e, b * u + d * v + f) for u, v in ((x, y), (x + across, y + down))]
        tiles.append([*map(min, zip(*ends, strict=True)), *map(max, zip(*ends, strict=True))])
    return tiles


def test_what_was_held_back_is_drawn_where_it_is_on_a_photo_held_upright() -> None:
    audit = {"tiles": [{"row": 0, "col": 200, "held_back": 0.4}], "tile_side": 100}

    assert held_tiles(audit, 600, 800, 6) == [[500, 200, 600, 300]]  # at the right, 200 pixels down


@pytest.mark.parametrize("orientation", range(1, 9))
def test_what_was_held_back_is_turned_as_the_photo_is(orientation: int) -> None:
    marked = np.zeros((331, 503), np.int8)
    marked[:96, 96:192] = 1  # near the tile, whose ends lie on a lattice without gaps
    rows, cols = np.nonzero(upright(marked, orientation))
    audit = {"tiles": [{"row": 0, "col": 101, "held_back": 0.4}], "tile_side": 96}

    (found,) = held_tiles(audit, 331, 503, orientation)

    wanted = [cols.min(), rows.min(), cols.max() + 1, rows.max() + 1]
    assert np.abs(np.subtract(found, wanted)).max() <= 18


@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_map_of_what_was_held_back_covers_a_photo_once(orientation: int) -> None:
    tiles = [{"row": c.top, "col": c.left, "held_back": 0.4} for c in cells(Frame(331, 503), 96)]
    height, width = (503, 331) if orientation > 4 else (331, 503)
    drawn = np.zeros((height, width), np.int8)

    for left, top, right, bottom in held_tiles({"tiles": tiles, "tile_side": 96}, 331, 503, orientation):
        drawn[top:bottom, left:right] += 1

    assert drawn.min() == drawn.max() == 1


def test_the_page_of_a_photo_shows_its_correction(client: TestClient, corrected: dict[str, Any]) -> None:
    page = client.get(f"/photos/{corrected['photo_id']}").text

    assert f'data-after="/ui/corrections/{corrected["id"]}/tiles/after"' in page
    assert f'href="/v1/corrections/{corrected["id"]}/result" download' in page
    assert "Download the corrected photo" in page


@pytest.mark.parametrize("kind", ["photos", "corrections"])
def test_where_nothing_is_to_be_gained_a_page_says_so_and_compares_nothing(
    client: TestClient, unchanged: dict[str, Any], kind: str
) -> None:
    page = client.get(f"/{kind}/{unchanged['photo_id' if kind == 'photos' else 'id']}").text

    assert "Nothing to correct here.</b> Removing the blur would not make it visibly better" in page
    assert "Download the photo" in page
    assert "data-after" not in page
    assert "held back" not in page


def test_a_jpeg_without_gain_says_so_in_one_sentence_with_the_reason(
    client: TestClient, steps: Steps, store: Store
) -> None:
    photo = steps.counted()
    assert store.photos.set_state(photo.public_id, ("counted",), "counted", kind="jpeg")

    page = client.get(f"/photos/{photo.public_id}").text

    said = re.search(r'data-nothing="([^"]*)"', page)
    assert said is not None
    assert said[1].startswith("Nothing to correct here. The camera has sharpened and compressed this JPEG")
    assert said[1].count(". ") == 1
    assert '<option value="jpeg" selected>' in page


@pytest.mark.parametrize(("ending", "left"), [(".jpg", True), (".png", False)])
def test_a_jpeg_that_would_gain_nothing_is_left_soon(tmp_path: Path, ending: str, left: bool) -> None:
    scene = np.random.default_rng(2).integers(0, 255, (30, 40, 3), dtype=np.uint8).repeat(24, 0).repeat(24, 1)
    Image.fromarray(scene).save(tmp_path / f"p{ending}", quality=92)
    developed, folder = tmp_path / "developed", tmp_path / "work"
    for made in (developed, folder):
        made.mkdir()
    tasks.develop({"path": str(tmp_path / f"p{ending}"), "max_megapixels": 1.0}, developed, ignore_step)
    places = [(0.1 + 0.15 * k, 1.1 * k - 3.0) for k in range(6)]
    kernel = gaussian(15, 0.3**2 * np.eye(2))  # a lens without fault
    samples = [
        PsfSample(kernel, FieldPosition(*place), LensSettings(channel=channel), estimator="default/1")
        for place in places
        for channel in CHANNELS
    ]
    write_samples(folder, samples)
    wish = {
        "developed": str(developed),
        "photo": "p",
        "lateral": None,
        "settings": {"aperture": None, "focal_mm": None, "focus_m": None},
        "params": {
            "method": "fast",
            "strength": 1.0,
            "output": {"format": "png8", "color_space": "srgb", "quality": 90},
        },
        "bounds": {},
        "workers": 1,
        "description": "",
    }
    steps: list[int] = []

    done = tasks.correct(wish, folder, lambda step, _: steps.append(step))

    assert done["report"]["nothing_to_correct"] == left
    assert bool(steps) != left  # no cell after those that tell


def test_corrections_are_followed_and_fetched_together(client: TestClient, unchanged: dict[str, Any]) -> None:
    wish = {"photo_id": unchanged["photo_id"], "output": {"format": "png8"}}
    waiting = client.post("/v1/corrections", json=wish).json()["id"]
    ids = f"{unchanged['id']},{waiting}"

    page, part = client.get(f"/batch?ids={ids}").text, client.get(f"/ui/parts?page=batch&id={ids}").text
    archive = client.get(f"/batch.zip?ids={ids},{unchanged['id']}")

    assert "2 corrections" in page
    assert "1 of 2 done" in part
    assert "Nothing to correct: left as it was" in part
    with zipfile.ZipFile(io.BytesIO(archive.content)) as files:
        assert {name: files.read(name) for name in files.namelist()} == {"p.dng": b"a"}
    assert client.get(f"/batch.zip?ids={waiting}").status_code == 409
    assert client.get("/batch?ids=gone").status_code == 404


def test_files_of_one_name_have_two_in_an_archive() -> None:
    used: set[str] = set()

    assert [unused_name(name, used) for name in ("a.tif", "A.tif", "b.tif", "a.tif")] == [
        "a.tif",
        "A (2).tif",
        "b.tif",
        "a (3).tif",
    ]


def test_a_photo_has_a_thumbnail_before_it_is_developed(
    client: TestClient, steps: Steps, settings: Settings, tmp_path: Path
) -> None:
    photo = steps.receive()
    address = f"/ui/photos/{photo.public_id}/thumbnail.jpg"
    assert client.get(address).headers["content-type"] == "image/svg+xml"  # nothing to see yet
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(a_picture()).save(tmp_path / "p.jpg", exif=exif)
    picture = tasks.thumbnail(tmp_path / "p.jpg", "jpeg", 6)
    Storage(settings.storage).put(f"{photo.folder}{THUMBNAIL}", picture)

    assert opened(client, address).size == (258, 480)


def test_a_photo_is_seen_while_it_is_worked_on(
    client: TestClient, steps: Steps, settings: Settings, tmp_path: Path
) -> None:
    photo = steps.receive()
    address = f"/ui/photos/{photo.public_id}"

    def pictures() -> list[str]:
        answer = client.get("/ui/parts", params={"page": "photo", "id": photo.public_id})
        page = client.get(f"/photos/{photo.public_id}").text.partition("<main")[2]
        shown = [re.findall(r'<img src="([^"]*)"', part) for part in (answer.text, page)]
        assert shown[0] == shown[1]
        assert 'id="viewer"' not in page
        return shown[0]

    received = pictures()
    steps.inspect(photo)
    inspected = pictures()
    (tmp_path / "tiles").write_bytes(b"any")
    Storage(settings.storage).put(f"{photo.folder}{SHOWN}", tmp_path / "tiles")
    developed = pictures()

    assert received == []
    assert inspected == [f"{address}/thumbnail.jpg"]
    assert developed == [f"{address}/tiles/before/whole.jpg"]


@pytest.mark.parametrize(
    ("code", "again", "copy", "correct"),
    [
        ("outage", True, False, False),
        ("time_limit", True, False, False),
        ("truncated_image", False, True, False),
        ("raw_decode_failed", False, True, False),
        ("unsupported_format", False, True, False),
        ("no_usable_patches", False, False, True),
    ],
)
def test_a_photo_that_failed_offers_what_can_help(
    client: TestClient, steps: Steps, store: Store, code: str, again: bool, copy: bool, correct: bool
) -> None:
    steps.counted()  # its lens is known
    photo = steps.receive()
    steps.inspect(photo)
    store.photos.fail(photo.public_id, photo.epoch, code, "it was so")

    page = client.get(f"/photos/{photo.public_id}").text

    offered = ("Try it again", "Send a new copy", "Correct this photo")
    assert [text in page for text in offered] == [again, copy, correct]
    listed = client.get("/").text
    assert (f'name="photo" value="{photo.public_id}"' in listed) == correct


@pytest.mark.parametrize(
    ("code", "detail"),
    [
        ("unsupported_format", 'the TIFF\'s colours are "YCbCr"; convert it to RGB'),  # in the sentence
        ("raw_decode_failed", "LibRaw: data error"),  # only among the details: the sentence is ours
    ],
)
def test_why_a_photo_failed_is_said_once(
    client: TestClient, steps: Steps, store: Store, code: str, detail: str
) -> None:
    photo = steps.receive()
    store.photos.fail(photo.public_id, photo.epoch, code, detail)

    page = client.get(f"/photos/{photo.public_id}").text

    assert html.unescape(page).count(detail) == 1


@pytest.mark.parametrize("kind", ["tiff", "png", "dng"])
def test_every_kind_of_photo_has_a_thumbnail(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"p.{kind}"
    if kind == "tiff":
        tifffile.imwrite(path, a_picture().astype(np.uint16) * 257)
    elif kind == "png":
        Image.fromarray(a_picture()).save(path)
    else:
        write_bayer_dng(path, np.full((64, 96), 3000, np.uint16), black=512, white=15512)

    with Image.open(io.BytesIO(tasks.thumbnail(path, kind, 1))) as picture:
        assert picture.width > picture.height > 16


def test_every_raw_ending_can_be_picked(client: TestClient) -> None:
    picker = re.search(r'<input id="files"[^>]* accept="([^"]*)"', client.get("/").text)

    assert picker is not None
    endings = {".cr3", ".iiq", ".3fr", ".x3f", ".rw2", ".nef", ".dng", ".tif", ".png", ".jpg"}
    assert endings <= set(picker[1].split(","))


def test_waiting_photos_are_grouped_by_body_and_focal_length(steps: Steps, store: Store) -> None:
    for body, focal in (("A", 35.0), ("A", 35.0), ("B", 35.0), ("A", 50.0)):
        photo = steps.receive()
        store.photos.set_state(photo.public_id, ("received",), "inspecting")
        store.photos.record_inspection(
            photo.public_id,
            width=60,
            height=40,
            identity=LensName(None, None, None, "none"),
            aperture=None,
            focal_mm=focal,
            focus_m=None,
            pixel_pitch_um=None,
            camera_maker="Kamera",
            camera_model="Kamera One",
            body_key=body_key("Kamera", "Kamera One", body),
        )
        store.photos.set_state(photo.public_id, ("inspecting",), "needs_lens")

    groups = grouped(store.photos.page("local", before=None, limit=9, state="needs_lens"))

    assert sorted((g.camera, g.focal_mm, len(g.photos)) for g in groups) == [
        ("Kamera One", 35.0, 1),
        ("Kamera One", 35.0, 2),
        ("Kamera One", 50.0, 1),
    ]
    assert {g.body for g in groups} == {1, 2}
    assert all(g.needs_aperture for g in groups)
    assert all(g.name == f"Kamera One, body {g.body}, {g.focal_mm:g} mm" for g in groups)


@pytest.mark.parametrize(
    ("maker", "model", "lens", "name"),
    [
        ("NIKON CORPORATION", "NIKON D1", None, "Nikon D1, 20 mm"),
        ("FUJIFILM", "X-T3", None, "Fujifilm X-T3, 20 mm"),
        ("Canon", "Canon EOS D30", "16-35 mm", "Canon 16-35 mm"),
        ("Canon", "Canon EOS 6D", "EF24-105mm f/4L IS USM", "EF24-105mm f/4L IS USM"),
        (None, None, None, "20 mm"),
    ],
)
def test_a_lens_is_proposed_a_name(maker: str | None, model: str | None, lens: str | None, name: str) -> None:
    row = PhotoRow(camera_maker=maker, camera_model=model, lens_model=lens, focal_mm=20.0, aperture=2.8)

    assert grouped([row])[0].name == name
    assert not grouped([row])[0].own_lens


@pytest.mark.parametrize(
    ("maker", "model", "more", "name"),
    [
        ("EASTMAN KODAK COMPANY", "KODAK Z612", {"pixel_pitch_um": 2.04}, "Kodak Z612"),
        ("DJI", "FC300S", {"aperture": 2.8, "width": None}, "DJI FC300S"),
        ("FUJIFILM", "X100V", {}, "Fujifilm X100V"),
        ("Apple", "iPhone 7", {"lens_model": "iPhone 7 back camera"}, "iPhone 7 back camera"),
    ],
    ids=["by its pixels", "by its focal length", "by its series", "by the name of its lens"],
)
def test_the_own_lens_of_a_camera_is_proposed_for_all_its_photos(
    maker: str, model: str, more: dict[str, Any], name: str
) -> None:
    seen = {"width": 2832, "height": 2128, "camera_maker": maker, "camera_model": model, **more}
    rows = [PhotoRow(focal_mm=focal, **seen) for focal in (5.85, 7.2)]

    (group,) = grouped(rows)

    assert (group.own_lens, group.name) == (True, name)


def test_a_camera_with_a_lens_of_its_own_is_not_asked_about(
    client: TestClient, steps: Steps, store: Store
) -> None:
    photo = steps.receive()
    store.photos.set_state(photo.public_id, ("received",), "inspecting")
    unnamed = LensName(None, None, None, "none")
    about = {"aperture": 2.8, "focal_mm": 3.61, "focus_m": None, "pixel_pitch_um": 1.7}
    store.photos.record_inspection(
        photo.public_id, unnamed, width=4000, height=2250, camera_maker="DJI", camera_model="FC300S", **about
    )
    store.photos.set_state(photo.public_id, ("inspecting",), "needs_lens")

    for path in ("/", f"/photos/{photo.public_id}"):
        page = client.get(path).text
        assert "Which lens was it?" not in page
        assert re.search(
            r'<details>\s*<summary>It was another lens</summary>.*value="DJI FC300S".*</details>',
            page,
            re.DOTALL,
        )


def test_what_was_learned_leads_to_correcting_until_it_was(
    client: TestClient, steps: Steps, settings: Settings, store: Store
) -> None:
    photo = steps.receive()
    first = client.get("/ui/parts?page=home").text
    steps.inspect(photo)
    steps.plan(photo)
    steps.estimate(photo, (0,))
    working = client.get("/ui/parts?page=home").text
    steps.estimate(photo)
    store.photos.finish(photo.public_id, 1)
    ready = client.get("/ui/parts?page=home").text
    client.post("/v1/corrections", json={"photo_id": photo.public_id})
    corrected = client.get("/ui/parts?page=home").text

    assert "Next: correct" not in first  # it may yet ask for its lens
    assert f"Next: correct {photo.filename}" in working
    assert "as soon as this is done" in working
    assert "Measuring blur: 1 of 2 places" in working.partition('id="next"')[2].partition("</section>")[0]
    assert f'<a class="button" href="/photos/{photo.public_id}">Correct this photo</a>' in ready
    assert "Next: correct" not in corrected


def test_a_lens_that_was_named_before_any_photo_is_listed_and_no_ghost(
    client: TestClient, steps: Steps, store: Store
) -> None:
    client.post("/v1/lenses", json={"label": "Lens on the bench"})
    ghost = steps.receive()
    steps.inspect(ghost, serial="2")
    store.photos.fail(ghost.public_id, ghost.epoch, "raw_decode_failed", "damaged")

    page = client.get("/").text

    assert page.count('class="card"') == 1
    assert "Lens on the bench" in page


def test_no_lens_is_chosen_beforehand_for_a_photo_that_names_none(
    client: TestClient, steps: Steps, store: Store
) -> None:
    steps.counted(serial="1")
    ghost = steps.receive()
    steps.inspect(ghost, serial="2")
    store.photos.fail(ghost.public_id, ghost.epoch, "raw_decode_failed", "damaged")
    photo = steps.receive(calibrate=False)
    steps.inspect(photo, serial=None)
    store.photos.set_state(photo.public_id, ("inspecting",), "stored")

    page = client.get(f"/photos/{photo.public_id}").text

    chosen = re.search(r'<select name="lens_id" required>(.*?)</select>', page)
    assert chosen is not None
    assert re.findall(r'<option value="([^"]*)"', chosen[1])[0] == ""
    assert chosen[1].count("<option") == 2  # without the lens whose only photo failed


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
        store.photos.change([photo.public_id], "local", {"aperture": 2.0})
    store.lenses.record_metrics(lens_id, 202, {"error": {}, "coverage": {"corner": 77}})

    page = client.get(f"/lenses/{lens_id}/tests").text

    assert "<td>202</td>" in page
    assert "<td>0, 0, 77</td>" in page


def test_the_cells_of_a_map_are_as_small_as_the_blur_allows() -> None:
    sharp, soft, softest = (gaussian(31, np.eye(2) * sigma**2) for sigma in (0.8, 2.5, 6.0))

    assert [cell_px(kernels) for kernels in ([sharp], [sharp, soft], [softest], [])] == [9, 15, 25, 25]


def test_a_lens_of_jpegs_is_said_to_look_sharper(client: TestClient, steps: Steps) -> None:
    words = "camera&#39;s sharpening makes a lens look sharper"
    pages = []
    for name in ("one.dng", "two.jpg"):
        photo = steps.counted(filename=name)
        pages.append(client.get(f"/lenses/{steps.lens_id(photo)}").text)

    assert [words in page for page in pages] == [False, True]
    assert "Learned from JPEG files (1 of 2 photos)" in pages[1]


def test_the_versions_of_a_lens_have_their_errors(client: TestClient, steps: Steps, store: Store) -> None:
    lens = steps.lens_id(steps.counted())
    assert "<td>not yet known</td>" in client.get(f"/lenses/{lens}/tests").text

    store.lenses.record_metrics(lens, 1, {"error": {"center": 0.4, "corner": None}})

    assert "<td>40 %, not known, not known</td>" in client.get(f"/lenses/{lens}/tests").text


def test_the_layer_of_a_preview_is_sent_in_pieces(
    client: TestClient, steps: Steps, store: Store, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = steps.correct(steps.counted(), method="fast", output={"format": "png8"}, roi=None)
    layer = f"/ui/corrections/{row.public_id}/layer/after"
    run = store.jobs.start(row.public_id, row.epoch)
    assert run is not None
    made = {"key": "corrections/x/result", "etag": "e", "media_type": "image/png", "bytes": 8, "name": "o"}
    assert store.jobs.finish(run, {}, **made)
    missing = client.get(layer)
    plan = store.jobs.get(row.public_id, ANY_OWNER)
    assert plan is not None
    large = bytes(9 << 20)
    Storage(settings.storage).put(f"{plan.run_folder}{LAYER_FILES['after']}", large)
    monkeypatch.delattr(Storage, "get")  # what would hold it whole

    answer = client.get(layer)

    assert (missing.status_code, missing.json()["code"]) == (409, "not_ready")
    assert (answer.headers["content-type"], answer.content) == ("image/png", large)


def test_a_photographer_reads_no_figures_in_a_verdict() -> None:
    assert templates.filters["plain"]("It is sharp (MTF50 .41), and its corner softer (T .2, S .3).") == (
        "It is sharp, and its corner softer."
    )
    assert templates.filters["plain"]("A photo at f/2 would help most: it is wrong by 67%.") == (
        "A photo at f/2 would help most."
    )
    kept = "Nothing is known there: let it fill the frame."
    assert templates.filters["plain"](kept) == kept


def test_the_page_of_a_lens_shows_the_aperture_that_is_asked_for_and_no_empty_sections(
    client: TestClient, steps: Steps
) -> None:
    lens = steps.lens_id(steps.counted(aperture=1.4))
    steps.counted(aperture=5.6)

    page = client.get(f"/lenses/{lens}?aperture=5.6").text

    assert f"/v1/lenses/{lens}/field.png?grid=9x6&amp;size=25&amp;aspect=1.5&amp;aperture=5.6" in page
    assert re.search(r'href="\?aperture=5.6" aria-current="true"', page)
    assert "Is it a good copy?" not in page  # there is no report yet
    assert "Which photo next?" not in page
    assert client.get(f"/lenses/{lens}?aperture=wide").status_code == 422


def test_an_open_page_is_told_what_changed_and_when_its_session_is_over(
    settings: Settings, store: Store, steps: Steps
) -> None:
    photo, key = steps.receive(), store.accounts.create_key("local", ["write"])
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        stranger = {"HX-Request": "true", "HX-Current-URL": "http://h/?a=b"}
        mine = {"Authorization": f"Bearer {key}", **stranger}
        asked = {"params": {"page": "photo", "id": photo.public_id}, "headers": mine}
        first = client.get("/ui/parts", **asked)
        known = {**mine, "If-None-Match": first.headers["ETag"]}
        same = client.get("/ui/parts", params=asked["params"], headers=known)
        steps.inspect(photo)
        changed = client.get("/ui/parts", **asked)
        store.photos.delete(photo.public_id, "local")
        gone = client.get("/ui/parts", **asked)
        store.accounts.revoke_key(key.split("_")[1])
        ended = client.get("/ui/parts", params={"page": "home"}, headers=stranger)

    assert [a.status_code for a in (first, same, changed, gone, ended)] == [200, 304, 200, 404, 401]
    assert first.text != changed.text
    assert gone.headers["HX-Redirect"] == "/"
    assert ended.headers["HX-Redirect"] == "/sign-in?next=http%3A//h/%3Fa%3Db"


def test_the_page_of_a_lens_follows_its_first_photos(client: TestClient, steps: Steps) -> None:
    photo = steps.receive()
    steps.inspect(photo)
    steps.plan(photo)
    steps.estimate(photo, (0,))
    lens = steps.lens_id(photo)
    asked = {"page": "lens", "id": lens}
    page, working = client.get(f"/lenses/{lens}").text, client.get("/ui/parts", params=asked)
    steps.estimate(photo)
    steps.store.photos.finish(photo.public_id, 1)
    counted = client.get("/ui/parts", params=asked)

    assert "Its blur is being measured in 1 photo." in working.text
    assert '<progress max="2" value="1"' in working.text
    assert "Its blur is being measured in 1 photo." in page
    assert "Nothing is known of this lens yet." not in page
    assert "A photo is being added." in counted.text


def test_a_page_whose_work_has_ended_is_made_anew(client: TestClient, steps: Steps) -> None:
    photo = steps.receive()
    asked = {"page": "photo", "id": photo.public_id}
    working = client.get("/ui/parts", params=asked)
    steps.inspect(photo)
    steps.plan(photo)
    steps.estimate(photo)
    steps.store.photos.finish(photo.public_id, 1)
    done = client.get("/ui/parts", params=asked)

    assert ("HX-Refresh" in working.headers, done.headers.get("HX-Refresh")) == (False, "true")
    assert ("hx-get" in working.text, "hx-get" in done.text) == (True, False)
    assert "hx-get" not in client.get(f"/photos/{photo.public_id}").text  # there is nothing to wait for
    assert "hx-get" in client.get("/").text


def test_a_page_is_made_anew_whatever_its_photos_are_called(
    client: TestClient, steps: Steps, store: Store
) -> None:
    photo = steps.counted(filename='a hx-get="b".dng')
    row = steps.correct(photo, method="fast", strength=1.0, output={"format": "png8"}, roi=None)
    asked = {"page": "batch", "id": row.public_id}
    working = client.get("/ui/parts", params=asked)
    store.jobs.fail(row.public_id, row.epoch, "outage", "it was so")
    done = client.get("/ui/parts", params=asked)

    assert ("HX-Refresh" in working.headers, done.headers.get("HX-Refresh")) == (False, "true")


@pytest.mark.parametrize(
    "path",
    [
        "/",
        "/ui/parts?page=home",
        "/lenses/{lens}",
        "/lenses/{lens}/tests",
        "/v1/jobs",
        "/v1/lenses",
        "/v1/photos",
    ],
)
def test_no_page_asks_the_tables_once_for_each_thing_on_it(
    client: TestClient, store: Store, steps: Steps, path: str
) -> None:
    def statements() -> int:
        seen: list[str] = []

        def note(*arguments: Any) -> None:
            if arguments[2].startswith("SELECT") and "api_key" not in arguments[2]:  # read again each second
                seen.append(arguments[2])

        engine = client.app.state.services.store.database.reader  # type: ignore[attr-defined] # Starlette's own
        event.listen(engine, "before_cursor_execute", note)
        assert client.get(path.replace("{lens}", lens)).status_code == 200
        event.remove(engine, "before_cursor_execute", note)
        return len(seen)

    def furnish(number: int) -> None:
        for each in range(number, number + 4):
            steps.counted()
            learning = steps.receive()  # its lens has no samples yet
            steps.inspect(learning, serial=f"learning {each}")

    lens = steps.lens_id(steps.counted())
    furnish(0)
    statements()
    before = statements()
    furnish(10)

    assert statements() == before
