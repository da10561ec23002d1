"""The pages in a real browser: what a photographer does, with pointer, touch and keyboard."""

from __future__ import annotations

import base64
import os
import re
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe  # type: ignore[import-untyped]  # has no types
from deadline import stretched
from PIL import Image
from playwright.sync_api import Browser, ConsoleMessage, Page, Request, Route, expect, sync_playwright
from running import BRIEF, OWN_ACCOUNT, SMALL, Service, running, write_photo

from lensmodel.photo import upright

pytestmark = pytest.mark.tools  # a browser

PATIENCE_MS = 120_000.0
FLAGS = ["--headless=new", "--no-sandbox", "--no-first-run"]
FLAGS += [
    f"--disable-{part}" for part in ("gpu", "quic", "sync", "background-networking", "component-update")
]
FLAGS += ["--process-per-site"]  # all pages are of one service: see `first_page`
FLAGS += ["--disable-features=SpareRendererForSitePerProcess"]  # none is begun for the next
WIDTHS = (360, 390, 768, 1280, 2560)
RULES = {"resultTypes": ["violations"]}  # all that axe has
DROP = """([name, data]) => {
  const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
  const carried = new DataTransfer();
  carried.items.add(new File([bytes], name));
  for (const kind of ["dragenter", "dragover", "drop"]) {
    const event = new DragEvent(kind, { bubbles: true, cancelable: true, dataTransfer: carried });
    document.querySelector("main").dispatchEvent(event);
  }
}"""
LOOK = """(lens) => {
  const live = document.querySelector("#live");
  live.setAttribute("hx-get", `/ui/parts?page=lens&id=${lens}`);
  live.setAttribute("hx-trigger", "every 2s");
  htmx.process(live);
}"""
"""Let the page of a lens look whether its work has ended, as while there is some."""
STOP = """() => {
  const at = document.activeElement;
  const style = getComputedStyle(at.type === "file" ? at.labels[0] : at);
  window.stops ??= new Map();
  if (!stops.has(at)) stops.set(at, stops.size);
  const width = style.outlineStyle === "none" ? 0 : parseFloat(style.outlineWidth);
  return [`${stops.get(at)} ${at.outerHTML.slice(0, 80)}`, width];
}"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    chromium = shutil.which("chromium")
    if chromium is None:
        reason = "there is no `chromium` on this machine to open the pages with"
        if os.environ.get("LENSMODEL_REQUIRE_BROWSER"):
            pytest.fail(reason)
        pytest.skip(reason)
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def service(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    # with the other lenses of these tests, each picture would wait for what all of them have in common
    with running(tmp_path_factory.mktemp("pages") / "data", BRIEF, **OWN_ACCOUNT) as made:
        yield made


class Visitor:
    """A page that notes each complaint of the browser and each request to another host."""

    def __init__(self, page: Page, home: str) -> None:
        self.page, self.host = page, urlsplit(home).netloc
        self.complaints: list[str] = []
        self.strangers: list[str] = []
        page.on("console", self._listen)
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("request", self._watch)

    def _listen(self, message: ConsoleMessage) -> None:
        if message.type in {"error", "warning"}:
            self.complaints.append(f"{message.text} ({message.location.get('url')})")

    def _watch(self, request: Request) -> None:
        parts = urlsplit(request.url)
        if parts.scheme not in {"data", "blob"} and parts.netloc != self.host:
            self.strangers.append(request.url)


@pytest.fixture(scope="module")
def first_page(browser: Browser, service: Service) -> Iterator[Page]:
    """Give a page that stays open, in the session of one visitor: it opens the others.

    So they share its process and what that has compiled of the scripts; a process each takes longer.
    """
    opened = browser.new_context(
        base_url=service.info()["url"], viewport={"width": 1280, "height": 900}, has_touch=True
    )
    page = opened.new_page()
    page.goto("/healthz")
    yield page
    opened.close()


@pytest.fixture
def visitor(first_page: Page, service: Service) -> Iterator[Visitor]:
    patience = stretched(PATIENCE_MS)  # anew for each test: the machine may have become busy
    expect.set_options(timeout=patience)
    first_page.context.set_default_timeout(patience)
    with first_page.expect_popup() as opened:
        first_page.evaluate("() => { open('about:blank') }")
    made = Visitor(opened.value, service.info()["url"])
    yield made
    first_page.context.set_offline(False)
    made.page.close()
    assert made.strangers == []
    assert made.complaints == []


@pytest.fixture
def page(visitor: Visitor) -> Page:
    return visitor.page


@pytest.fixture(scope="module")
def learned(service: Service, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A photo of a lens that has learned from two, at two apertures."""
    folder = tmp_path_factory.mktemp("photos")
    sent = [
        service.upload(write_photo(folder / f"wall-{k}.dng", 20 + k, serial="P-77", aperture=aperture))
        for k, aperture in enumerate((2.8, 5.6))
    ]
    for photo in sent:
        assert service.job(photo["id"])["state"] == "succeeded"
    return service.get(f"/v1/photos/{sent[0]['id']}")


@pytest.fixture(scope="module")
def correction(service: Service, learned: dict[str, Any]) -> dict[str, Any]:
    wish = {"photo_id": learned["id"], "method": "fast", "output": {"format": "png16"}}
    made = service.http.post("/v1/corrections", json=wish).json()
    assert service.job(made["id"])["state"] == "succeeded"
    return made


@pytest.fixture
def pages(learned: dict[str, Any]) -> dict[str, str]:
    """Addresses of pages that need no correction: with one, that of the photo shows it."""
    lens = f"/lenses/{learned['lens_id']}"
    return {"home": "/", "lens": lens, "tests": f"{lens}/tests", "photo": f"/photos/{learned['id']}"}


def small(path: Path, seed: int, serial: str, **options: Any) -> Path:
    """Write a photo of which all is done in half the time."""
    return write_photo(path, seed, serial=serial, shape=SMALL, **options)


def waiting(service: Service, path: Path) -> dict[str, Any]:
    """Send a photo that waits for its owner."""
    sent = service.upload(path)
    service.job(sent["id"], until=lambda job: job["state"] == "waiting")
    return sent


def press(page: Page, *names: str) -> None:
    for name in names:
        page.get_by_role("button", name=name, exact=True).click()


def open_complete(page: Page, address: str) -> None:
    """Open the page of a lens, and wait until its last version is measured: then it changes no more."""
    page.goto(address)
    expect(page.locator("#live:not([hx-get])")).to_be_attached()


def drop(page: Page, name: str, data: bytes) -> None:
    page.evaluate(DROP, [name, base64.b64encode(data).decode()])


def faults(page: Page) -> list[str]:
    if page.evaluate("typeof axe") == "undefined":  # half a megabyte, once for a page
        page.evaluate(Axe().axe_script)
    # what holds would be megabytes, and nobody reads it
    found = page.evaluate("(rules) => axe.run(document, rules).then((all) => all.violations)", RULES)
    return [f"{fault['id']}: {node['html'][:160]}" for fault in found for node in fault["nodes"]]


def overhang(page: Page) -> int:
    return page.evaluate("document.documentElement.scrollWidth - innerWidth")


def test_photos_chosen_and_dropped_are_followed_on_the_page(page: Page, tmp_path: Path) -> None:
    chosen, dropped = small(tmp_path / "chosen.dng", 1, "C-1"), small(tmp_path / "dropped.dng", 2, "C-1")
    page.goto("/")
    page.evaluate("window.first = true")

    page.set_input_files("#files", chosen)
    drop(page, dropped.name, dropped.read_bytes())
    for name in ("chosen.dng", "dropped.dng"):
        row = page.locator(".row", has_text=name)
        expect(row.locator(".state")).to_contain_text("Used: blur measured")
        expect(row.locator("img")).not_to_have_js_property("naturalWidth", 0)
    expect(page.locator("#lenses .card")).to_have_count(1)
    page.set_input_files("#files", chosen)
    known = page.locator("#uploads li", has_text="Already used: the same photo was sent before.")
    expect(known).to_be_visible()
    assert page.evaluate("window.first")  # gone if the page had been loaded again
    known.get_by_role("link", name="Open it").click()
    page.wait_for_url("**/photos/*")


def test_a_file_that_is_no_photo_is_refused_in_a_plain_sentence(visitor: Visitor, page: Page) -> None:
    page.goto("/")

    drop(page, "holiday.nef", b"not a photo" * 50)
    refusal = page.locator("#uploads li")
    expect(refusal.locator(".error")).to_contain_text("Not a photo file.")
    expect(page.locator("#announce")).to_have_text("0 of 1 photos sent, 1 not accepted.")
    refusal.get_by_role("button", name="Dismiss").click()
    expect(refusal).to_have_count(0)

    drop(page, "IMG_1.HEIC", b"\0\0\0\x18ftypheic" + bytes(500))
    expect(refusal.locator(".error")).to_contain_text("exported as JPEG")

    assert all("415" in complaint for complaint in visitor.complaints)
    visitor.complaints.clear()


def test_a_button_waits_until_the_scripts_of_the_page_are_there(page: Page, learned: dict[str, Any]) -> None:
    page.route("**/static/app.js*", lambda route: route.fulfill(body="", content_type="text/javascript"))
    page.goto(f"/photos/{learned['id']}")

    expect(page.get_by_role("button", name="Correct this photo")).to_be_disabled()
    expect(page.get_by_role("button", name="Delete photo")).to_be_disabled()


def test_photos_that_wait_are_named_together_by_their_pictures(
    page: Page, service: Service, learned: dict[str, Any], tmp_path: Path
) -> None:
    sent = [waiting(service, small(tmp_path / "nameless-0.dng", 31, ""))]
    Image.fromarray(np.full((200, 300, 3), 90, np.uint8)).save(tmp_path / "screenshot.png")
    screen = waiting(service, tmp_path / "screenshot.png")
    page.goto("/")
    groups = page.locator(".group")
    group = page.locator(".group", has=page.locator("legend", has_text="Test T-1"))
    unknown = page.locator(".group", has=page.locator("legend", has_text="Unknown camera"))
    expect(groups).to_have_count(2)
    # the group grows before the eyes
    sent.append(service.upload(small(tmp_path / "nameless-1.dng", 32, "")))
    expect(group.locator("legend")).to_contain_text("Test T-1, Test 35mm f/1.8: 2 photos")
    expect(group.locator("img").first).not_to_have_js_property("naturalWidth", 0)
    expect(group.get_by_label("Its name")).to_have_value("Test 35mm f/1.8")
    assert faults(page) == []

    expect(unknown.get_by_role("checkbox")).not_to_be_checked()
    unknown.get_by_role("button", name="Leave out").click()
    expect(groups).to_have_count(1)
    expect(group.get_by_role("button", name="Leave out")).to_be_focused()
    assert service.get(f"/v1/photos/{screen['id']}")["state"] == "cancelled"

    wishes: list[str] = []
    page.on("request", lambda request: wishes.append(request.url) if request.method == "PATCH" else None)
    group.get_by_label("Its name").fill("Grandfather's 35 mm")
    press(page, "Use the ticked photos")

    expect(groups).to_have_count(0)
    # no correction is offered until the service has looked at a photo again: the list has the focus before
    expect(page.locator("#next-title:focus, #photos-title:focus")).to_have_count(1)
    assert [url.rpartition("/v1/")[2] for url in wishes] == ["photos"]
    assert [service.job(photo["id"])["state"] for photo in sent] == ["succeeded"] * 2
    expect(page.locator("#lenses .card", has_text="Grandfather's 35 mm")).to_contain_text("2 photos")
    assert len({service.get(f"/v1/photos/{photo['id']}")["lens_id"] for photo in sent}) == 1


def test_a_lens_shows_its_blur_anywhere_and_its_versions(page: Page, pages: dict[str, str]) -> None:
    open_complete(page, pages["tests"])
    field, words, drawn = page.locator("#field"), page.locator("#psf-words"), page.locator("#psf")
    expect(words).to_contain_text("of the way to the corner")
    expect(page.locator("#field img")).not_to_have_js_property("naturalWidth", 0)
    picture = "(canvas) => canvas.toDataURL()"
    begun = drawn.evaluate(picture)

    field.click()
    expect(words).to_contain_text("In the centre")
    assert drawn.evaluate(picture) != begun
    field.press("ArrowRight")
    expect(words).to_contain_text("10 % of the way to the corner")
    apertures = page.locator("#field-controls [name=aperture]")
    with page.expect_response(re.compile(r"psf\.json.*aperture=5\.6")):
        apertures.select_option("5.6")
    assert apertures.locator("option").all_inner_texts() == ["f/2.8", "f/5.6"]
    with page.expect_response(re.compile(r"field\.png.*channel=b")) as answered:
        page.get_by_label("Colour").select_option("b")

    assert answered.value.ok
    expect(page.locator("#psf-numbers")).to_contain_text("Width of a point")
    expect(page.locator("#psf-npy")).to_have_attribute("href", re.compile("channel=b"))
    page.get_by_text("All versions").click()
    versions = page.get_by_role("region", name="Calibration history")
    expect(versions.locator("tbody tr").first).to_be_visible()


def shown(page: Page) -> bytes:
    """What the view shows now, once its tiles are there and nothing moves."""
    stage = page.locator("#viewer .stage")
    expect(stage).to_have_attribute("aria-busy", "false")
    earlier, now = b"", stage.screenshot()
    while now != earlier:
        earlier, now = now, stage.screenshot()
    return now


def test_a_part_of_a_photo_held_upright_is_asked_for_in_the_coordinates_of_its_sensor(page: Page) -> None:
    page.goto("/docs")
    sensor, part = np.arange(30 * 50).reshape(30, 50), {"x": 7, "y": 11, "width": 9, "height": 5}
    script = "async (asked) => (await import('/static/preview.js')).inSensor(...asked)"
    for orientation in range(1, 9):
        turned = upright(sensor, orientation)
        asked = [part, {"width": turned.shape[1], "height": turned.shape[0]}, orientation]
        found = page.evaluate(script, asked)
        x, y, width, height = (found[name] for name in part)
        pixels = sensor[y : y + height, x : x + width]
        assert sorted(pixels.ravel()) == sorted(turned[11:16, 7:16].ravel()), orientation


def test_a_preview_is_stopped_where_nobody_waits_and_sliders_show_their_effect_on_it(
    page: Page, service: Service, pages: dict[str, str]
) -> None:
    logged, deleted = len(service.log.read_text()), list[str]()
    page.on("request", lambda asked: deleted.append(asked.url) if asked.method == "DELETE" else None)
    page.goto(pages["photo"])
    viewer, words = page.locator("#viewer"), page.locator("#preview-words")
    with page.expect_response(lambda answer: answer.url.endswith("/v1/corrections")) as begun:
        press(page, "upper left")
    first = begun.value.json()["id"]
    press(page, "lower right")

    expect(words).to_be_in_viewport()  # a place that is chosen does not scroll it away
    expect(viewer).to_have_attribute("data-previewed", "fast")  # the quick one first
    expect(viewer).to_have_attribute("data-shown", "split")
    expect(viewer).to_have_attribute("data-previewed", "standard")
    assert "compiling" not in service.log.read_text()[logged:]  # the worker has done that at its start
    assert any(address.endswith(first) for address in deleted)
    expect(words).to_contain_text("This is what you get")
    press(page, "After")
    page.get_by_text("More", exact=True).click()
    full = shown(page)

    page.get_by_label("Strength").fill("0")
    none = shown(page)
    assert none != full
    page.get_by_label("Strength").fill("1")
    assert shown(page) == full
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.get_by_label("Strength").fill("0.5")
    assert shown(page) not in {none, full}
    assert asked == []  # mixed here, from what is there
    with page.expect_request(lambda request: request.url.endswith("/v1/corrections")) as more:
        page.get_by_label("Noise reduction").fill("1")
    assert more.value.post_data_json["layers"] is True  # only now: they take as long again
    half = shown(page)
    with page.expect_response(lambda answer: "/layer/clean" in answer.url):
        pass
    expect(words).to_contain_text("This is what you get")
    asked.clear()
    page.get_by_label("Faint texture kept").fill("0.5")
    assert shown(page) != half
    assert asked == []
    assert page.locator(".rows a[href^='/corrections/']").count() == 0


def test_a_photo_is_corrected_and_compared(page: Page, pages: dict[str, str], tmp_path: Path) -> None:
    page.goto(pages["photo"])
    hold = page.get_by_role("button", name="Hold to see before")
    expect(hold).to_be_hidden()  # there is nothing else yet
    page.get_by_text("More", exact=True).click()
    page.get_by_label("Method").select_option("fast")  # the page is the same after the slow one
    page.get_by_label("File").select_option("jpeg")
    press(page, "Correct this photo")
    page.wait_for_url("**/corrections/*")
    expect(page.locator("#live")).to_contain_text("Done")

    def shows(side: str) -> None:
        expect(viewer).to_have_attribute("data-shown", side)

    viewer, zoom = page.locator("#viewer"), page.locator(".zoom-words")
    shows("split")
    press(page, "lower right")
    expect(page.get_by_role("button", name="lower right")).to_have_attribute("aria-pressed", "true")
    expect(zoom).to_have_text("100 %")
    seen = {}
    for name in ("Before", "After", "Side by side", "Split"):
        press(page, name)
        seen[name] = shown(page)
    assert len(set(seen.values())) == 4
    press(page, "After")
    page.keyboard.down("b")
    shows("before")
    assert shown(page) == seen["Before"]
    page.keyboard.up("b")
    shows("after")
    hold.hover()
    page.mouse.down()
    shows("before")
    page.mouse.up()
    shows("after")

    press(page, "Split")
    handle = page.locator(".handle")
    expect(handle).to_be_visible()  # what is hidden takes no focus
    handle.focus()
    page.keyboard.press("ArrowRight")
    expect(handle).to_have_attribute("aria-valuenow", "52")
    box, place = page.locator(".stage").bounding_box(), shown(page)
    assert box is not None
    page.mouse.move(box["x"] + 60, box["y"] + 60)
    page.mouse.wheel(0, -240)
    expect(zoom).not_to_have_text("100 %")
    page.mouse.down()
    page.mouse.move(box["x"] + 160, box["y"] + 100, steps=4)
    page.mouse.up()
    assert shown(page) != place
    expect(page).to_have_url(re.compile("#at="))
    press(page, "Whole window")
    assert viewer.bounding_box() == {"x": 0, "y": 0, "width": 1280, "height": 900}
    page.keyboard.press("Escape")
    press(page, "Whole photo")

    expect(page.locator(".mosaic button")).to_have_count(9)
    expect(page.locator("section[aria-labelledby=gain] .zones")).to_contain_text("Corners")
    expect(page.locator("section[aria-labelledby=audit]")).to_contain_text("held back")
    saved = download(page, "Download the", tmp_path)
    assert saved.name == "wall-0-corrected.jpg"
    assert saved.read_bytes()[:2] == b"\xff\xd8"
    for said in (b"lens blur corrected by lensmodel: Test Optics Test 35mm", b"xpacket"):
        assert said in saved.read_bytes()


def download(page: Page, link: str, folder: Path) -> Path:
    """Save what a link gives, under the name it proposes."""
    with page.expect_download() as got:
        page.get_by_role("link", name=link).click()
    path = folder / got.value.suggested_filename
    got.value.save_as(path)
    return path


def test_photos_are_corrected_and_downloaded_together(
    page: Page, pages: dict[str, str], tmp_path: Path
) -> None:
    page.goto(pages["lens"])
    page.get_by_role("checkbox", name="Choose wall-0.dng").check()
    expect(page.get_by_role("button", name="Correct 1 photo")).to_be_visible()
    press(page, "Choose all", "Correct 2 photos")
    page.wait_for_url("**/batch?ids=*")
    expect(page.locator("#live .lead")).to_have_text("All done")
    assert faults(page) == []

    with zipfile.ZipFile(download(page, "Download 2 photos", tmp_path)) as archive:
        assert archive.testzip() is None
        assert sorted(archive.namelist()) == ["wall-0-corrected.tif", "wall-1-corrected.tif"]
    page.goto(pages["photo"])  # it shows its correction
    expect(page.locator("#viewer")).to_have_attribute("data-shown", "split")
    expect(page.get_by_role("link", name="Download the corrected photo")).to_be_visible()


def test_fingers_zoom_and_move_the_view(page: Page, correction: dict[str, Any]) -> None:
    page.goto(f"/corrections/{correction['id']}")
    stage, zoom = page.locator(".stage"), page.locator(".zoom-words")
    expect(zoom).not_to_have_text("")
    stage.scroll_into_view_if_needed()
    box, first = stage.bounding_box(), zoom.inner_text()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    touch = page.context.new_cdp_session(page)
    for half in (60, 100, 180):  # beside the handle of the split
        points = [{"x": x + sign * half, "y": y, "id": k} for k, sign in enumerate((-1, 1))]
        kind = "touchStart" if half == 60 else "touchMove"
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    expect(zoom).not_to_have_text(first)


def test_a_lens_answers_three_questions_on_one_screen(page: Page, pages: dict[str, str]) -> None:
    page.set_viewport_size({"width": 1440, "height": 900})
    open_complete(page, pages["lens"])

    expect(page.locator(".verdict")).to_contain_text("this copy is")
    copy = page.locator("section[aria-labelledby=copy-title]")
    expect(copy).to_contain_text(re.compile("Yes|No|Not known"))
    expect(page.locator("section[aria-labelledby=next-title]")).to_contain_text("photo")
    expect(page.locator(".map")).not_to_have_js_property("naturalWidth", 0)
    bottoms = "[...document.querySelectorAll('.answers > *')].map((e) => e.getBoundingClientRect().bottom)"
    assert max(page.evaluate(bottoms)) <= 900
    page.get_by_role("link", name="f/5.6").click()
    expect(page.locator(".verdict")).to_contain_text("At f/5.6")


def test_a_lens_has_legible_charts_and_a_report(page: Page, pages: dict[str, str], tmp_path: Path) -> None:
    open_complete(page, pages["lens"])
    page.get_by_role("link", name="Charts and figures").click()
    chart = page.locator("#charts img").first
    expect(chart).to_be_visible()
    smallest = "(image) => 7 * 96 / 72 * image.clientWidth / image.naturalWidth"  # figures in a cell of a map
    page.set_viewport_size({"width": WIDTHS[0], "height": 900})
    assert chart.evaluate(smallest) >= 12.0
    with page.expect_response(lambda answer: "/charts?" in answer.url and "lp%2Fmm" not in answer.url) as got:
        page.locator("#chart-controls [name=aperture]").select_option("5.6")
    assert got.value.ok
    expect(page.locator("#charts img[alt$='f/5.6']").first).to_be_visible()
    assert download(page, "As CSV", tmp_path).suffix == ".csv"


def test_a_lens_is_renamed_merged_and_its_profile_taken_along(
    visitor: Visitor, page: Page, service: Service, tmp_path: Path
) -> None:
    def insist() -> None:
        asked = "its serial number is M-0, that of the lens M-1"
        expect(page.get_by_role("dialog")).to_contain_text(asked)
        visitor.complaints.clear()  # the browser notes that the service refused
        press(page, "It is the same lens")

    one, other = (
        service.calibrated(small(tmp_path / f"m{k}.dng", 61 + k, f"M-{k}"))["lens_id"] for k in range(2)
    )
    page.goto(f"/lenses/{one}")
    page.get_by_text("Rename, merge").click()
    profile = download(page, "Download the profile", tmp_path)
    page.get_by_label("Name", exact=True).fill("My first")
    press(page, "Rename")
    expect(page.locator("h1")).to_have_text("My first")
    expect(page.get_by_role("button", name="Rename")).to_be_focused()  # and what was open is open

    page.get_by_label("It is the same copy as").select_option(other)
    press(page, "Merge into it", "Cancel")
    expect(page.get_by_role("button", name="Merge into it")).to_be_focused()
    press(page, "Merge into it", "Merge")
    insist()
    page.wait_for_url(f"**/lenses/{other}")
    expect(page.locator(".facts").first).to_contain_text("2 photos")
    assert service.http.get(f"/v1/lenses/{one}").status_code == 404

    before = service.get(f"/v1/lenses/{other}")
    page.get_by_text("Rename, merge").click()
    page.get_by_label("Add a lens profile").set_input_files(profile)
    press(page, "Add")
    with page.expect_navigation():
        insist()
    assert service.get(f"/v1/lenses/{other}") == before  # the photo of the profile is one of its own
    press(page, "Delete lens", "Delete the lens")
    page.wait_for_url("**/")
    page.get_by_text("Add a lens from a profile").click()
    page.get_by_label("A file that ends in").set_input_files(profile)
    press(page, "Add")
    page.wait_for_url("**/lenses/*")
    expect(page.locator("h1")).to_have_text("Test Optics Test 35mm f/1.8")  # as the profile says
    expect(page.locator(".facts").first).to_contain_text("1 photo")


def test_a_page_does_not_go_while_somebody_is_asked(page: Page, pages: dict[str, str]) -> None:
    looks: list[Route] = []
    open_complete(page, pages["lens"])  # complete: it is not loaded anew by itself
    page.evaluate("window.first = true")
    page.route("**/ui/parts?*", lambda look: looks.append(look), times=1)  # noqa: PLW0108 - playwright marks it
    with page.expect_request("**/ui/parts?*"):
        page.evaluate(LOOK, pages["lens"].rpartition("/")[2])
    page.get_by_text("Rename, merge").click()
    press(page, "Delete lens")
    expect(page.get_by_role("dialog")).to_be_visible()
    looks[0].continue_()  # answered only now, and later ones would be: the work of the page has ended
    page.wait_for_timeout(2500)  # longer than between two looks
    expect(page.get_by_role("dialog")).to_be_visible()
    assert page.evaluate("window.first")
    with page.expect_navigation():
        press(page, "Cancel")
    assert not page.evaluate("window.first")


def test_a_page_says_when_the_service_is_away(visitor: Visitor, page: Page) -> None:
    offline, away = "dispatchEvent(new Event('offline'))", page.locator("#away")
    page.goto("/")
    expect(away).to_be_hidden()
    with page.expect_response(lambda answer: "/ui/parts" in answer.url) as asked_anew:
        page.evaluate(offline)  # no network, but the service is on this computer
    assert asked_anew.value.ok
    expect(away).to_be_hidden()
    page.context.set_offline(True)
    page.evaluate(offline)
    expect(away).to_be_visible()
    page.context.set_offline(False)
    expect(away).to_be_hidden()
    visitor.complaints.clear()  # the browser notes that it is offline


@pytest.mark.parametrize("kind", ["home", "lens", "tests", "photo", "correction"])
def test_a_page_is_accessible_fits_each_screen_and_shows_the_focus(
    page: Page, pages: dict[str, str], correction: dict[str, Any], kind: str
) -> None:
    page.goto({**pages, "correction": f"/corrections/{correction['id']}"}[kind])
    page.wait_for_load_state("load")
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme, reduced_motion="reduce")
        assert faults(page) == [], scheme
    page.evaluate("document.querySelectorAll('details').forEach((one) => (one.open = true))")
    for width in WIDTHS:
        page.set_viewport_size({"width": width, "height": 800})
        assert overhang(page) <= 0, width
    page.evaluate("document.querySelectorAll('details').forEach((one) => (one.open = false))")

    page.set_viewport_size({"width": 1280, "height": 900})
    wanted = page.evaluate(
        "[...document.querySelectorAll('a[href], button:not(:disabled), input, select, summary, "
        '[tabindex="0"]\')].filter((e) => e.checkVisibility() && e.tabIndex >= 0).length'
    )
    seen = set()
    page.keyboard.press("Tab")
    expect(page.locator(".skip")).to_be_focused()
    expect(page.locator(".skip")).to_be_in_viewport()
    for _ in range(wanted):
        name, outline = page.evaluate(STOP)
        assert outline >= 2, name
        seen.add(name)
        page.keyboard.press("Tab")

    assert len(seen) == wanted
