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
from states import Steps, failed, finish, refusal, services_of, stored

from app.blobs.storage import Storage
from app.blobs.tiles import tile, whole, write_tiles
from app.jobs import tasks
from app.jobs.answers import LAYER_FILES, SHOWN, SIDES, THUMBNAIL
from app.jobs.sample_files import write_samples
from app.main import create_app
from app.pages.routes import unused_name
from app.pages.shown import cell_px, grouped
from app.runtime.settings import Settings
from app.store import LensName, Store
from app.store.owners import ANY_OWNER
from app.store.tables import PhotoRow
from lab.kernels import gaussian
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings, ignore_step
from lensmodel.photo.writing import write_bayer_dng

PNG8 = {"method": "fast", "strength": 1.0, "output": {"format": "png8"}, "roi": None}


def shape_of(client: TestClient, path: str) -> tuple[int, int]:
    """Return width and height of a picture."""
    answer = client.get(path)
    assert answer.status_code == 200, answer.text
    return Image.open(io.BytesIO(answer.content)).size


def part(client: TestClient, page: str, subject: str = "") -> Any:
    """Ask for the part of a page that changes."""
    return client.get("/ui/parts", params={"page": page, "id": subject})


def written(path: Path, picture: NDArray[np.uint8], **options: Any) -> Path:
    Image.fromarray(picture).save(path, **options)
    return path


def developed(path: Path, folder: Path) -> Path:
    """Develop a photo into a folder, which is returned."""
    folder.mkdir(exist_ok=True)
    tasks.develop({"path": str(path), "max_megapixels": 1.0}, folder, ignore_step)
    return folder


CORNERED = np.full((700, 1300, 3), 40, dtype=np.uint8)
"""A picture with a white corner."""
CORNERED[:20, :20] = 255


# --- pictures -----------------------------------------------------------------------------------------


def test_a_photo_has_a_thumbnail_before_it_is_developed_and_comes_upright(
    client: TestClient, steps: Steps, storage: Storage, tmp_path: Path
) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # held upright
    photo, path = steps.receive(), written(tmp_path / "p.jpg", CORNERED, exif=exif)
    address = f"/ui/photos/{photo.public_id}"
    thumbnail = f"{address}/thumbnail.jpg"

    def pictures() -> list[str]:
        page = client.get(f"/photos/{photo.public_id}").text.partition("<main")[2]
        texts = (part(client, "photo", photo.public_id).text, page)
        shown = [re.findall(r'<img src="([^"]*)"', text) for text in texts]
        assert shown[0] == shown[1]
        assert 'id="viewer"' not in page
        return shown[0]

    assert client.get(thumbnail).headers["content-type"] == "image/svg+xml"  # nothing to see yet
    assert pictures() == []
    storage.put(f"{photo.folder}{THUMBNAIL}", tasks.thumbnail(path, "jpeg", 6))
    steps.inspect(photo)
    assert pictures() == [thumbnail]
    storage.put(f"{photo.folder}{SHOWN}", developed(path, tmp_path / "developed") / SHOWN)
    assert pictures() == [f"{address}/tiles/before/whole.jpg"]
    assert shape_of(client, thumbnail) == (258, 480)
    assert shape_of(client, f"{address}/tiles/before/whole.jpg") == (700, 1300)


def test_photos_of_sixteen_bits_have_a_thumbnail(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "p.tiff", CORNERED.astype(np.uint16) * 257)
    write_bayer_dng(tmp_path / "p.dng", np.full((64, 96), 3000, np.uint16), black=512, white=15512)

    for kind in ("tiff", "dng"):
        with Image.open(io.BytesIO(tasks.thumbnail(tmp_path / f"p.{kind}", kind, 1))) as picture:
            assert picture.width > picture.height > 16


def test_the_smallest_and_longest_pictures_have_tiles(tmp_path: Path) -> None:
    storage = Storage(f"file://{tmp_path}")
    for height, width in ((1, 1), (2, 30000), (513, 512)):
        write_tiles(tmp_path / "x.tiles", np.zeros((height, width, 3), np.uint8))
        assert Image.open(io.BytesIO(whole(storage, "x.tiles"))).width <= 1600
        assert Image.open(io.BytesIO(tile(storage, "x.tiles", 0, 0, 0))).height == min(height, 512)
    long = written(tmp_path / "p.png", np.full((16, 30000, 3), 128, np.uint8))
    assert (developed(long, tmp_path) / SHOWN).is_file()


# --- corrections --------------------------------------------------------------------------------------


@pytest.fixture
def corrected(
    request: pytest.FixtureRequest, client: TestClient, steps: Steps, storage: Storage, tmp_path: Path
) -> dict[str, Any]:
    """A correction to a DNG; with the parameter True one that was not worth it."""
    wish = {"photo_id": steps.counted().public_id, "output": {"format": "dng"}}
    made: dict[str, Any] = client.post("/v1/corrections", json=wish).json()
    for name in SIDES.values():
        write_tiles(tmp_path / name, CORNERED)
        storage.put(f"corrections/{made['id']}/1-1/{name}", tmp_path / name)
    audit = {"held_back": 0.1, "checks": {"re-blur": 0.1}}
    report = {"zones": {}, "nothing_to_correct": getattr(request, "param", False), "audit": audit}
    finish(client, made["id"], b"a", report=report, media_type="image/x-adobe-dng", name="p.dng")
    return made


unchanged = pytest.mark.parametrize("corrected", [True], indirect=True, ids=["unchanged"])


def test_tiles_before_and_after_show_one_place_and_are_not_decoded(
    client: TestClient, corrected: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    base = f"/ui/corrections/{corrected['id']}/tiles"
    paths = [f"{base}/{side}/0/0_0.jpg" for side in ("before", "after")]
    others = ("0/2_1", "1/1_0", "2/0_0", "whole", "places/0", "places/8")
    paths += [f"{base}/after/{name}.jpg" for name in others]

    with monkeypatch.context() as patch:
        patch.delattr(Image, "open")  # beside the keys of all owners
        patch.delattr(Image, "fromarray")
        answers = [client.get(path) for path in paths]

    assert [answer.status_code for answer in answers] == [200] * len(paths)
    shown = [np.asarray(Image.open(io.BytesIO(answer.content))).astype(float) for answer in answers]
    assert np.array_equal(shown[0], shown[1])
    assert shown[0][5, 5].min() > 245
    sizes = [(700 - 512, 1300 - 1024), (350, 650 - 512), (175, 325), (700, 1300), (170, 255), (170, 255)]
    assert [picture.shape[:2] for picture in shown[2:]] == sizes
    assert (shown[6][5, 5].min() > 245, shown[7][5, 5].max() < 60) == (True, True)
    missing = ("0/9_9", "3/0_0", "places/9")
    assert [client.get(f"{base}/after/{name}.jpg").status_code for name in missing] == [404] * 3


def test_damaged_tiles_are_refused(client: TestClient, corrected: dict[str, Any], storage: Storage) -> None:
    key = f"corrections/{corrected['id']}/1-1/{SIDES['after']}"
    right = storage.get(key)
    for change, wrong in {
        "empty": b"",
        "cut": right[:3000],
        "size": right[:4] + (2**32 - 1).to_bytes(4, "little") * 2 + right[12:],
        "count": right[:12] + (2**32 - 1).to_bytes(4, "little") + right[16:],
        "offsets": right[:24] + (2**63).to_bytes(8, "little") + right[32:],
    }.items():
        storage.put(key, wrong)
        for name in ("whole", "0/0_0"):
            answer = client.get(f"/ui/corrections/{corrected['id']}/tiles/after/{name}.jpg")
            assert answer.status_code == 409, (change, name)


@unchanged
@pytest.mark.parametrize(("kind", "subject"), [("photos", "photo_id"), ("corrections", "id")])
def test_where_nothing_is_to_be_gained_a_page_says_so_and_compares_nothing(
    client: TestClient, corrected: dict[str, Any], kind: str, subject: str
) -> None:
    page = client.get(f"/{kind}/{corrected[subject]}").text

    assert "Nothing to correct here.</b>" in page
    assert "data-after" not in page
    assert "held back" not in page


@pytest.mark.parametrize(("ending", "left"), [(".jpg", True), (".png", False)])
def test_a_jpeg_that_would_gain_nothing_is_left_soon(tmp_path: Path, ending: str, left: bool) -> None:
    scene = np.random.default_rng(2).integers(0, 255, (30, 40, 3), dtype=np.uint8).repeat(24, 0).repeat(24, 1)
    photo = written(tmp_path / f"p{ending}", scene, quality=92)
    kernel = gaussian(15, 0.3**2 * np.eye(2))  # a lens without fault
    places = [FieldPosition(0.1 + 0.15 * k, 1.1 * k - 3.0) for k in range(6)]
    write_samples(
        tmp_path, [PsfSample(kernel, at, LensSettings(channel=c)) for at in places for c in CHANNELS]
    )
    output = {"format": "png8", "color_space": "srgb", "quality": 90}
    wish = {"photo": "p", "lateral": None, "bounds": {}, "description": "", "workers": 1}
    wish |= {"settings": dict.fromkeys(("aperture", "focal_mm", "focus_m"))}
    wish |= {"params": {"method": "fast", "strength": 1.0, "output": output}}
    wish |= {"developed": str(developed(photo, tmp_path / "developed"))}
    seen: list[int] = []

    done = tasks.correct(wish, tmp_path, lambda step, _: seen.append(step))

    assert done["report"]["nothing_to_correct"] == left
    assert bool(seen) != left  # no cell after those that tell


@unchanged
def test_corrections_are_followed_and_fetched_together(client: TestClient, corrected: dict[str, Any]) -> None:
    wish = {"photo_id": corrected["photo_id"], "output": {"format": "png8"}}
    waiting = client.post("/v1/corrections", json=wish).json()["id"]
    ids = f"{corrected['id']},{waiting}"

    archive = client.get(f"/batch.zip?ids={ids},{corrected['id']}")

    assert "2 corrections" in client.get(f"/batch?ids={ids}").text
    assert "1 of 2 done" in part(client, "batch", ids).text
    used: set[str] = set()
    sent, named = ("a.tif", "A.tif", "b.tif", "a.tif"), ["a.tif", "A (2).tif", "b.tif", "a (3).tif"]
    assert [unused_name(name, used) for name in sent] == named
    with zipfile.ZipFile(io.BytesIO(archive.content)) as files:
        assert {name: files.read(name) for name in files.namelist()} == {"p.dng": b"a"}
    assert client.get(f"/batch.zip?ids={waiting}").status_code == 409
    assert client.get("/batch?ids=gone").status_code == 404


def test_the_layer_of_a_preview_is_sent_in_pieces(
    client: TestClient, steps: Steps, store: Store, storage: Storage, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = steps.correct(steps.counted(), **PNG8)
    finish(client, row.public_id)
    layer = f"/ui/corrections/{row.public_id}/layer/after"
    missing = client.get(layer)
    plan = store.jobs.get(row.public_id, ANY_OWNER)
    assert plan is not None
    large = bytes(9 << 20)
    storage.put(f"{plan.run_folder}{LAYER_FILES['after']}", large)
    monkeypatch.delattr(Storage, "get")  # what would hold it whole

    answer = client.get(layer)

    assert refusal(missing) == (409, "not_ready")
    assert (answer.headers["content-type"], answer.content) == ("image/png", large)


# --- photos -------------------------------------------------------------------------------------------


def test_a_photo_that_failed_offers_what_can_help_and_says_once_why(client: TestClient, steps: Steps) -> None:
    steps.counted()  # its lens is known
    again, copy, correct = "Try it again", "Send a new copy", "Correct this photo"
    ycbcr = 'the TIFF\'s colours are "YCbCr"; convert it to RGB'
    for code, detail, offered in (
        ("outage", "", again),
        ("truncated_image", "", copy),
        ("raw_decode_failed", "LibRaw: data error", copy),  # only among the details: the sentence is ours
        ("unsupported_format", ycbcr, copy),  # in the sentence
        ("no_usable_patches", "", correct),
    ):
        photo = failed(steps, code, detail or "it was so")
        page, listed = client.get(f"/photos/{photo.public_id}").text, client.get("/").text

        assert [text for text in (again, copy, correct) if text in page] == [offered], code
        assert (f'name="photo" value="{photo.public_id}"' in listed) == (offered == correct), code
        assert not detail or html.unescape(page).count(detail) == 1, code


def test_waiting_photos_are_grouped_by_body_and_focal_length() -> None:
    bodies = [("A", 35.0), ("A", 35.0), ("B", 35.0), ("A", 50.0)]
    rows = [PhotoRow(camera_model="Kamera One", body_key=body, focal_mm=focal) for body, focal in bodies]

    groups = grouped(rows)

    assert [(g.body, g.focal_mm, len(g.photos)) for g in groups] == [(1, 35.0, 2), (1, 50.0, 1), (2, 35.0, 1)]
    assert all(g.needs_aperture for g in groups)
    assert [g.name for g in groups] == [f"Kamera One, body {g.body}, {g.focal_mm:g} mm" for g in groups]


@pytest.mark.parametrize(
    ("maker", "model", "said", "own_lens", "name"),
    [
        ("NIKON CORPORATION", "NIKON D1", {}, False, "Nikon D1, 20 mm"),
        ("Canon", "Canon EOS D30", {"lens_model": "16-35 mm"}, False, "Canon 16-35 mm"),
        ("Canon", "Canon EOS 6D", {"lens_model": "EF24-105mm f/4L"}, False, "EF24-105mm f/4L"),
        (None, None, {}, False, "20 mm"),
        # by its pixels, its series, the name of its lens: one for all focal lengths
        ("EASTMAN KODAK COMPANY", "KODAK Z612", {"pixel_pitch_um": 2.04}, True, "Kodak Z612"),
        ("FUJIFILM", "X100V", {}, True, "Fujifilm X100V"),
        ("Apple", "iPhone 7", {"lens_model": "iPhone 7 back camera"}, True, "iPhone 7 back camera"),
    ],
)
def test_a_lens_is_proposed_a_name(
    maker: str | None, model: str | None, said: dict[str, Any], own_lens: bool, name: str
) -> None:
    seen = {"width": 2832, "height": 2128, "focal_mm": 20.0, "camera_maker": maker, "camera_model": model}
    seen |= said
    more = seen | ({"focal_mm": 5.85} if own_lens else {})

    (group,) = grouped([PhotoRow(**seen), PhotoRow(**more)])

    assert (group.own_lens, group.name) == (own_lens, name)


def test_a_camera_with_a_lens_of_its_own_is_not_asked_about(client: TestClient, steps: Steps) -> None:
    photo = steps.receive()
    seen = {"width": 4000, "height": 2250, "focal_mm": 3.61, "focus_m": None, "pixel_pitch_um": 1.7}
    seen |= {"aperture": 2.8, "camera_maker": "DJI", "camera_model": "FC300S"}
    steps.store.photos.record_inspection(photo.public_id, LensName(None, None, None, "none"), **seen)
    steps.store.photos.set_state(photo.public_id, ("received",), "needs_lens")

    another = r'<details>\s*<summary>It was another lens</summary>.*value="DJI FC300S".*</details>'
    for path in ("/", f"/photos/{photo.public_id}"):
        page = client.get(path).text
        assert "Which lens was it?" not in page
        assert re.search(another, page, re.DOTALL)


def test_what_was_learned_leads_to_correcting_until_it_was(client: TestClient, steps: Steps) -> None:
    photo = steps.receive()
    assert "Next: correct" not in part(client, "home").text  # it may yet ask for its lens
    steps.inspect(photo)
    steps.plan(photo)
    steps.estimate(photo, (0,))
    working = part(client, "home").text.partition('id="next"')[2].partition("</section>")[0]
    steps.estimate(photo)
    steps.store.photos.finish(photo.public_id, 1)
    ready = part(client, "home").text
    client.post("/v1/corrections", json={"photo_id": photo.public_id})

    assert f"Next: correct {photo.filename}" in working
    assert "Measuring blur: 1 of 2 places" in working
    assert f'<a class="button" href="/photos/{photo.public_id}">Correct this photo</a>' in ready
    assert "Next: correct" not in part(client, "home").text


def test_no_lens_is_chosen_beforehand_for_a_photo_that_names_none(client: TestClient, steps: Steps) -> None:
    steps.counted(serial="1")
    failed(steps, serial="2")

    page = client.get(f"/photos/{stored(steps, serial=None).public_id}").text

    (chosen,) = re.findall(r'<select name="lens_id" required>(.*?)</select>', page)
    assert re.findall(r'<option value="([^"]*)"', chosen)[0] == ""
    assert chosen.count("<option") == 2  # without the lens whose only photo failed


# --- lenses -------------------------------------------------------------------------------------------


def test_named_lenses_are_listed_and_not_those_whose_photos_failed(client: TestClient, steps: Steps) -> None:
    named, tried = (client.post("/v1/lenses", json={"label": label}).json() for label in ("Bench", "Tried"))
    photo = steps.receive(lens_id=tried["id"])
    steps.inspect(photo, serial=None)
    steps.store.photos.fail(photo.public_id, photo.epoch, "raw_decode_failed", "damaged")

    page = client.get("/").text

    assert client.get(f"/v1/lenses/{tried['id']}").status_code == 200
    assert [f'href="/lenses/{lens["id"]}"' in page for lens in (named, tried)] == [True, False]


def test_the_cells_of_a_map_are_as_small_as_the_blur_allows() -> None:
    sharp, soft, softest = (gaussian(31, np.eye(2) * sigma**2) for sigma in (0.8, 2.5, 6.0))

    assert [cell_px(kernels) for kernels in ([sharp], [sharp, soft], [softest], [])] == [9, 15, 25, 25]


def test_an_address_without_anything_is_a_page_for_people_and_json_for_programs(client: TestClient) -> None:
    for address in ("/photos/gone", "/lenses/gone", "/corrections/gone", "/nowhere"):
        page = client.get(address, headers={"Accept": "text/html"})
        assert (page.status_code, "<h1>Not here</h1>" in page.text) == (404, True), address
    assert client.get("/photos/gone").json()["code"] == "unknown_photo"
    assert client.get("/v1/photos/gone", headers={"Accept": "text/html"}).json()["status"] == 404


# --- open pages ---------------------------------------------------------------------------------------


def test_an_open_page_is_told_changes_and_its_end(settings: Settings, store: Store, steps: Steps) -> None:
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


def test_a_page_whose_work_has_ended_is_made_anew(client: TestClient, steps: Steps, store: Store) -> None:
    photo, other = steps.planned(), steps.counted(filename='a hx-get="b".dng')
    row = steps.correct(other, **PNG8)
    open_pages = (("photo", photo.public_id), ("batch", row.public_id))
    working = [part(client, *page) for page in open_pages]
    steps.estimate(photo)
    store.photos.finish(photo.public_id, 1)
    store.jobs.fail(row.public_id, row.epoch, "outage", "it was so")
    done = [part(client, *page) for page in open_pages]

    assert [answer.headers.get("HX-Refresh") for answer in (*working, *done)] == [None, None, "true", "true"]
    assert ("hx-get" in working[0].text, "hx-get" in done[0].text) == (True, False)
    assert "hx-get" not in client.get(f"/photos/{photo.public_id}").text  # there is nothing to wait for
    assert "hx-get" in client.get("/").text


def test_no_page_asks_the_tables_once_for_each_thing_on_it(client: TestClient, steps: Steps) -> None:
    lens = steps.lens_id(steps.counted())
    paths = ("/", "/ui/parts?page=home", f"/lenses/{lens}", f"/lenses/{lens}/tests")
    paths += ("/v1/jobs", "/v1/lenses", "/v1/photos")
    engine, seen = services_of(client).store.database.reader, list[str]()

    def note(*arguments: Any) -> None:
        if arguments[2].startswith("SELECT") and "api_key" not in arguments[2]:  # read again each second
            seen.append(arguments[2])

    def statements(path: str) -> int:
        seen.clear()
        assert client.get(path).status_code == 200
        return len(seen)

    def furnish(number: int) -> None:
        for each in range(number, number + 4):
            steps.counted()
            steps.inspect(steps.receive(), serial=f"learning {each}")  # its lens has no samples yet

    event.listen(engine, "before_cursor_execute", note)
    furnish(0)
    _, before = ({path: statements(path) for path in paths} for _ in range(2))
    furnish(10)

    assert {path: statements(path) for path in paths} == before
    event.remove(engine, "before_cursor_execute", note)
