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
from playwright.sync_api import (
    Browser,
    ConsoleMessage,
    Page,
    Request,
    Route,
    expect,
    sync_playwright,
)
from running import BRIEF, OWN_ACCOUNT, SMALL, Service, running, write_photo

from lensmodel.photo import upright

PATIENCE_MS = 120_000.0
FLAGS = [
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--process-per-site",  # all pages are of one service: see `first_page`
    "--disable-features=SpareRendererForSitePerProcess",  # none is begun for the next
]
WIDTHS = (360, 390, 768, 1280, 2560)
RULES = {"resultTypes": ["violations"]}  # all that axe has
PICTURE = """async (canvas) => {
  window.picture = canvas.toDataURL();
  const sum = await crypto.subtle.digest("SHA-256", new TextEncoder().encode(picture));
  return String(new Uint8Array(sum));
}"""
DROP = """([name, data]) => {
  const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
  const carried = new DataTransfer();
  carried.items.add(new File([bytes], name));
  for (const kind of ["dragenter", "dragover", "drop"]) {
    const event = new DragEvent(kind, { bubbles: true, cancelable: true, dataTransfer: carried });
    document.querySelector("main").dispatchEvent(event);
  }
}"""
RECORD = """() => {
  window.states = new Set();
  const note = () => document.querySelectorAll("#photos .state").forEach((e) => states.add(e.textContent));
  new MutationObserver(note).observe(
    document.querySelector("#photos"), { childList: true, subtree: true, characterData: true });
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
        self.asked: list[str] = []
        page.on("console", self._listen)
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("request", self._watch)

    def _listen(self, message: ConsoleMessage) -> None:
        if message.type in {"error", "warning"}:
            self.complaints.append(f"{message.text} ({message.location.get('url')})")

    def _watch(self, request: Request) -> None:
        self.asked.append(request.url)
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
    found: dict[str, Any] = service.get(f"/v1/photos/{sent[0]['id']}")
    return found


@pytest.fixture(scope="module")
def correction(service: Service, learned: dict[str, Any]) -> dict[str, Any]:
    wish = {"photo_id": learned["id"], "method": "fast", "output": {"format": "png16"}}
    made: dict[str, Any] = service.http.post("/v1/corrections", json=wish).json()
    assert service.job(made["id"])["state"] == "succeeded"
    return made


def address_of(kind: str, learned: dict[str, Any], correction: dict[str, Any]) -> str:
    return {
        "home": "/",
        "lens": f"/lenses/{learned['lens_id']}",
        "tests": f"/lenses/{learned['lens_id']}/tests",
        "photo": f"/photos/{learned['id']}",
        "correction": f"/corrections/{correction['id']}",
    }[kind]


def faults(page: Page) -> list[str]:
    if page.evaluate("typeof axe") == "undefined":  # half a megabyte, once for a page
        page.evaluate(Axe().axe_script)
    # what holds would be megabytes, and nobody reads it
    found = page.evaluate("(rules) => axe.run(document, rules).then((all) => all.violations)", RULES)
    return [f"{fault['id']}: {node['html'][:160]}" for fault in found for node in fault["nodes"]]


def overhang(page: Page) -> int:
    found: int = page.evaluate("document.documentElement.scrollWidth - innerWidth")
    return found


def test_an_empty_service_says_how_to_begin(page: Page) -> None:
    page.goto("/")

    expect(page.locator("#photos .empty")).to_contain_text("No photo yet")
    expect(page.locator("#lenses .empty")).to_contain_text("No lens yet")
    expect(page.locator(".steps li")).to_have_count(3)
    assert faults(page) == []


def test_photos_chosen_and_dropped_are_learned_from_while_the_page_watches(
    visitor: Visitor, page: Page, tmp_path: Path
) -> None:
    chosen = write_photo(tmp_path / "chosen.dng", 1, serial="C-1", shape=SMALL)
    dropped = write_photo(tmp_path / "dropped.dng", 2, serial="C-1", shape=SMALL)
    page.goto("/")
    page.evaluate(RECORD)

    page.set_input_files("#files", chosen)
    page.evaluate(DROP, [dropped.name, base64.b64encode(dropped.read_bytes()).decode()])
    for name in ("chosen.dng", "dropped.dng"):
        row = page.locator(".row", has_text=name)
        expect(row.locator(".state")).to_contain_text("Used: blur measured")
        expect(row.locator("img")).not_to_have_js_property("naturalWidth", 0)
    expect(page.locator("#lenses .card")).to_have_count(1)

    states = page.evaluate("[...window.states]")  # gone if the page had been loaded again
    assert any(
        state.startswith("Used: blur measured") for state in states
    )  # the only one where it ends within a poll
    assert not visitor.complaints


def test_a_file_that_is_no_photo_is_refused_in_a_plain_sentence(visitor: Visitor, page: Page) -> None:
    page.goto("/")

    page.evaluate(DROP, ["holiday.nef", base64.b64encode(b"not a photo" * 50).decode()])
    refusal = page.locator("#uploads li")
    expect(refusal.locator(".error")).to_contain_text("Not a photo file.")
    expect(page.locator("#announce")).to_have_text("0 of 1 photos sent, 1 not accepted.")
    refusal.get_by_role("button", name="Dismiss").click()
    expect(refusal).to_have_count(0)

    page.evaluate(DROP, ["IMG_1.HEIC", base64.b64encode(b"\0\0\0\x18ftypheic" + bytes(500)).decode()])
    expect(refusal.locator(".error")).to_contain_text("exported as JPEG")

    assert all("415" in complaint for complaint in visitor.complaints)
    visitor.complaints.clear()


def test_a_file_that_is_dropped_on_another_page_does_not_take_its_place(
    page: Page, learned: dict[str, Any]
) -> None:
    page.goto(f"/lenses/{learned['lens_id']}")
    dropped = DROP.replace("document.querySelector", "window.prevented = !document.querySelector")
    page.evaluate(dropped, ["holiday.nef", base64.b64encode(b"any").decode()])

    assert page.evaluate("window.prevented") is True


def test_a_file_that_is_dropped_into_a_field_leaves_the_page_as_it_was(page: Page) -> None:
    page.goto("/")
    into = '"#add-lens [type=file]"'
    page.evaluate(
        DROP.replace('("main")', f'(kind === "drop" ? {into} : "main")'), ["my.lensprofile", "YW55"]
    )

    assert page.evaluate("document.body.className") == ""
    expect(page.locator("#sending")).to_be_hidden()


def test_a_tester_begins_with_a_lens_without_photos(page: Page, service: Service) -> None:
    page.goto("/")
    page.get_by_text("Add a lens from a profile").click()
    page.get_by_role("button", name="Add", exact=True).click()
    expect(page.locator("#add-lens .alert")).to_have_text("Give a name, or choose a profile.")
    page.get_by_label("Name", exact=True).fill("Lens on the bench")
    page.get_by_role("button", name="Add", exact=True).click()
    page.wait_for_url("**/lenses/*")
    page.get_by_role("link", name="Measure it with a test photo").click()

    expect(page.locator("h1")).to_contain_text("Lens on the bench")
    page.get_by_text("Send a test photo").click()
    expect(page.get_by_label("What it shows")).to_be_visible()
    assert service.http.delete(f"/v1/lenses/{page.url.split('/')[-2]}").status_code == 204


def test_a_photo_sent_twice_is_said_to_be_used_already(page: Page, service: Service, tmp_path: Path) -> None:
    photo = write_photo(tmp_path / "twice.dng", 3, serial="C-2", shape=SMALL)
    sent = service.upload(photo)
    page.goto("/")
    page.set_input_files("#files", photo)

    expect(page.locator("#uploads li")).to_contain_text("Already used: the same photo was sent before.")
    expect(page.get_by_role("link", name="Open it")).to_have_attribute("href", f"/photos/{sent['id']}")
    assert service.http.delete(f"/v1/photos/{sent['id']}").status_code == 204


def test_a_photo_without_any_lens_can_still_be_looked_at_and_deleted(
    page: Page, learned: dict[str, Any]
) -> None:
    def without_lens(route: Route) -> None:
        answer = route.fetch()
        route.fulfill(
            response=answer, body=answer.text().replace("<button disabled>Correct this photo</button>", "")
        )

    page.route(f"**/photos/{learned['id']}", without_lens)
    page.goto(f"/photos/{learned['id']}")

    expect(page.get_by_role("button", name="Correct this photo")).to_have_count(0)
    expect(page.get_by_role("button", name="Delete photo")).to_be_enabled()
    expect(page.get_by_role("button", name="Whole photo")).to_be_enabled()


def test_an_aperture_is_asked_for_where_photos_do_not_say_it(
    page: Page, service: Service, tmp_path: Path
) -> None:
    sent = service.upload(write_photo(tmp_path / "old.dng", 33, serial="", aperture=None, shape=SMALL))
    service.job(sent["id"], until=lambda job: job["state"] == "waiting")
    page.goto("/")
    group = page.locator(".group")

    for given, hint in (("", "such as 2.8"), ("1000", "between 0.5 and 128"), ("wide", "must be a number")):
        group.get_by_label("Aperture, f/").fill(given)
        page.get_by_role("button", name="Use the ticked photos").click()
        expect(group.locator(".alert")).to_contain_text(hint)
    assert service.http.delete(f"/v1/photos/{sent['id']}").status_code == 204


def test_photos_that_wait_are_named_together_by_their_pictures(
    page: Page, service: Service, learned: dict[str, Any], tmp_path: Path
) -> None:
    sent = [service.upload(write_photo(tmp_path / "nameless-0.dng", 31, serial="", shape=SMALL))]
    service.job(sent[0]["id"], until=lambda job: job["state"] == "waiting")
    Image.fromarray(np.full((200, 300, 3), 90, np.uint8)).save(tmp_path / "screenshot.png")
    screen = service.upload(tmp_path / "screenshot.png")
    service.job(screen["id"], until=lambda job: job["state"] == "waiting")
    page.goto("/")
    group = page.locator(".group", has=page.locator("legend", has_text="Test T-1"))
    expect(page.locator(".group")).to_have_count(2)
    # the group grows before the eyes
    sent.append(service.upload(write_photo(tmp_path / "nameless-1.dng", 32, serial="", shape=SMALL)))
    expect(group.locator("legend")).to_contain_text("Test T-1, Test 35mm f/1.8: 2 photos")
    expect(group.locator("img").first).not_to_have_js_property("naturalWidth", 0)
    expect(group.get_by_label("Its name")).to_have_value("Test 35mm f/1.8")
    assert faults(page) == []

    unknown = page.locator(".group", has=page.locator("legend", has_text="Unknown camera"))
    expect(unknown.get_by_role("checkbox")).not_to_be_checked()
    unknown.get_by_role("button", name="Leave out").click()
    expect(page.locator(".group")).to_have_count(1)
    expect(group.get_by_role("button", name="Leave out")).to_be_focused()
    assert service.get(f"/v1/photos/{screen['id']}")["state"] == "cancelled"

    learn = page.get_by_role("button", name="Use the ticked photos")
    group.get_by_label("Its name").fill("")
    learn.click()
    expect(group.locator(".alert")).to_have_text("Choose a lens, or give a new one a name.")
    wishes: list[str] = []
    page.on("request", lambda request: wishes.append(request.url) if request.method == "PATCH" else None)
    group.get_by_label("Its name").fill("Grandfather's 35 mm")
    learn.click()

    expect(page.locator(".group")).to_have_count(0)
    # no correction is offered until the service has looked at a photo again: the list has the focus before
    expect(page.locator("#next-title:focus, #photos-title:focus")).to_have_count(1)
    assert [url.rpartition("/v1/")[2] for url in wishes] == ["photos"]
    for photo in sent:
        job = service.job(photo["id"])
        assert job["state"] == "succeeded", job
    card = page.locator("#lenses .card", has_text="Grandfather's 35 mm")
    expect(card).to_contain_text("2 photos")
    lenses = {service.get(f"/v1/photos/{photo['id']}")["lens_id"] for photo in sent}
    assert len(lenses) == 1
    page.locator("#next").get_by_role("link", name="Correct this photo").click()
    page.wait_for_url(f"**/photos/{sent[1]['id']}")
    expect(page.get_by_role("button", name="Correct this photo")).to_be_in_viewport()


def test_a_damaged_file_leaves_no_empty_lens(page: Page, service: Service, tmp_path: Path) -> None:
    whole = write_photo(tmp_path / "whole.dng", 41, serial="", shape=SMALL)
    (tmp_path / "cut.dng").write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    photo = service.upload(tmp_path / "cut.dng", lens_serial="D-1", lens_model="Damaged 50 mm")
    assert service.job(photo["id"])["state"] == "failed"

    page.goto("/")
    expect(page.locator("#photos .row", has_text="cut.dng")).to_contain_text("the file ends too early")
    expect(page.locator("#lenses .card", has_text="Damaged")).to_have_count(0)


def test_a_lens_shows_its_blur_at_any_place_aperture_and_colour(page: Page, learned: dict[str, Any]) -> None:
    page.goto(f"/lenses/{learned['lens_id']}/tests")
    expect(page.locator("#live:not([hx-get])")).to_be_attached()
    field, words, drawn = page.locator("#field"), page.locator("#psf-words"), page.locator("#psf")
    expect(words).to_contain_text("of the way to the corner")
    expect(page.locator("#field img")).not_to_have_js_property("naturalWidth", 0)
    begun = drawn.evaluate(PICTURE)

    field.click()
    expect(words).to_contain_text("In the centre")
    assert drawn.evaluate(PICTURE) != begun
    field.press("ArrowRight")
    expect(words).to_contain_text("10 % of the way to the corner")
    with page.expect_response(lambda answer: "aperture=5.6" in answer.url and "psf.json" in answer.url):
        page.locator("#field-controls [name=aperture]").select_option("5.6")
    assert page.locator("#field-controls [name=aperture] option").all_inner_texts() == ["f/2.8", "f/5.6"]
    with page.expect_response(
        lambda answer: "channel=b" in answer.url and "field.png" in answer.url
    ) as answered:
        page.get_by_label("Colour").select_option("b")

    assert answered.value.ok
    expect(page.locator("#psf-numbers")).to_contain_text("Width of a point")
    expect(page.locator("#psf-npy")).to_have_attribute("href", re.compile("channel=b"))


def test_a_lens_shows_its_versions(page: Page, learned: dict[str, Any]) -> None:
    page.goto(f"/lenses/{learned['lens_id']}/tests")

    expect(page.locator("#live:not([hx-get])")).to_be_attached()
    page.get_by_text("All versions").click()
    versions = page.get_by_role("region", name="Calibration history")
    expect(versions.locator("tbody tr").first).to_be_visible()


def test_a_photo_says_how_much_it_taught_and_why_no_more(
    page: Page, service: Service, tmp_path: Path
) -> None:
    half = service.calibrated(write_photo(tmp_path / "half.dng", 30, serial="P-78", blank=228))
    page.goto(f"/photos/{half['id']}")

    used = page.locator("section[aria-labelledby=patches-title]")
    expect(used).to_contain_text(f"{half['patches']['done']} place")
    counts = [int(count) for count in used.locator(".facts b").all_inner_texts()]
    assert sum(counts) == half["patches"]["rejected"] > 0


def test_a_button_waits_until_the_scripts_of_the_page_are_there(page: Page, learned: dict[str, Any]) -> None:
    page.route("**/static/app.js*", lambda route: route.fulfill(body="", content_type="text/javascript"))
    page.goto(f"/photos/{learned['id']}")

    expect(page.get_by_role("button", name="Correct this photo")).to_be_disabled()
    expect(page.get_by_role("button", name="Delete photo")).to_be_disabled()


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
    sensor = np.arange(30 * 50).reshape(30, 50)
    part = {"x": 7, "y": 11, "width": 9, "height": 5}
    for orientation in range(1, 9):
        turned = upright(sensor, orientation)
        size = {"width": turned.shape[1], "height": turned.shape[0]}

        found = page.evaluate(
            "async (asked) => (await import('/static/preview.js')).inSensor(...asked)",
            [part, size, orientation],
        )

        rows = slice(found["y"], found["y"] + found["height"])
        columns = slice(found["x"], found["x"] + found["width"])
        wanted = turned[11:16, 7:16]
        assert sorted(sensor[rows, columns].ravel()) == sorted(wanted.ravel()), orientation


def test_a_preview_that_nobody_waits_for_is_stopped_and_sliders_show_their_effect_on_the_part_that_is_seen(
    page: Page, service: Service, learned: dict[str, Any]
) -> None:
    logged, deleted = len(service.log.read_text()), list[str]()
    page.on("request", lambda asked: deleted.append(asked.url) if asked.method == "DELETE" else None)
    page.goto(f"/photos/{learned['id']}")
    with page.expect_response(lambda answer: answer.url.endswith("/v1/corrections")) as begun:
        page.get_by_role("button", name="upper left").click()
    first = begun.value.json()["id"]
    page.get_by_role("button", name="lower right").click()

    expect(
        page.locator("#preview-words")
    ).to_be_in_viewport()  # a place that is chosen does not scroll it away
    expect(page.locator("#viewer")).to_have_attribute("data-previewed", "fast")  # the quick one first
    expect(page.locator("#viewer")).to_have_attribute("data-shown", "split")
    expect(page.locator("#viewer")).to_have_attribute("data-previewed", "standard")
    assert "compiling" not in service.log.read_text()[logged:]  # the worker has done that at its start
    assert any(address.endswith(first) for address in deleted)
    expect(page.locator("#preview-words")).to_contain_text("This is what you get")
    page.get_by_role("button", name="After", exact=True).click()
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
    expect(page.locator("#preview-words")).to_contain_text("This is what you get")
    asked.clear()
    page.get_by_label("Faint texture kept").fill("0.5")
    assert shown(page) != half
    assert asked == []
    assert page.locator(".rows a[href^='/corrections/']").count() == 0


def test_a_photo_is_corrected_and_compared(page: Page, learned: dict[str, Any], tmp_path: Path) -> None:
    page.goto(f"/photos/{learned['id']}")
    expect(page.get_by_role("button", name="Hold to see before")).to_be_hidden()  # there is nothing else yet
    page.get_by_text("More", exact=True).click()
    page.get_by_label("Method").select_option("fast")  # the page is the same after the slow one
    page.get_by_label("File").select_option("jpeg")
    page.get_by_role("button", name="Correct this photo").click()
    page.wait_for_url("**/corrections/*")
    expect(page.locator("#live")).to_contain_text("Done")
    viewer, hold = page.locator("#viewer"), page.get_by_role("button", name="Hold to see before")
    expect(viewer).to_have_attribute("data-shown", "split")

    page.get_by_role("button", name="lower right").click()
    expect(page.get_by_role("button", name="lower right")).to_have_attribute("aria-pressed", "true")
    expect(page.locator(".zoom-words")).to_have_text("100 %")
    seen = {}
    for name in ("Before", "After", "Side by side", "Split"):
        page.get_by_role("button", name=name, exact=True).click()
        seen[name] = shown(page)
    assert len(set(seen.values())) == 4
    page.get_by_role("button", name="After", exact=True).click()
    page.keyboard.down("b")
    expect(viewer).to_have_attribute("data-shown", "before")
    assert shown(page) == seen["Before"]
    page.keyboard.up("b")
    expect(viewer).to_have_attribute("data-shown", "after")
    hold.hover()
    page.mouse.down()
    expect(viewer).to_have_attribute("data-shown", "before")
    page.mouse.up()
    expect(viewer).to_have_attribute("data-shown", "after")

    page.get_by_role("button", name="Split", exact=True).click()
    handle = page.locator(".handle")
    expect(handle).to_be_visible()  # what is hidden takes no focus
    handle.focus()
    page.keyboard.press("ArrowRight")
    expect(handle).to_have_attribute("aria-valuenow", "52")
    stage = page.locator(".stage")
    box = stage.bounding_box()
    assert box is not None
    place = shown(page)
    page.mouse.move(box["x"] + 60, box["y"] + 60)
    page.mouse.wheel(0, -240)
    expect(page.locator(".zoom-words")).not_to_have_text("100 %")
    page.mouse.down()
    page.mouse.move(box["x"] + 160, box["y"] + 100, steps=4)
    page.mouse.up()
    assert shown(page) != place
    expect(page).to_have_url(re.compile("#at="))
    page.get_by_role("button", name="Whole window").click()
    assert viewer.bounding_box() == {"x": 0, "y": 0, "width": 1280, "height": 900}
    page.keyboard.press("Escape")
    page.get_by_role("button", name="Whole photo").click()

    expect(page.locator(".mosaic button")).to_have_count(9)
    expect(page.locator("section[aria-labelledby=gain] .zones")).to_contain_text("Corners")
    expect(page.locator("section[aria-labelledby=audit]")).to_contain_text("held back")
    with page.expect_download() as got:
        page.get_by_role("link", name="Download the").click()
    got.value.save_as(tmp_path / "saved")
    assert got.value.suggested_filename == "wall-0-corrected.jpg"
    saved = (tmp_path / "saved").read_bytes()
    assert saved[:2] == b"\xff\xd8"
    assert b"lens blur corrected by lensmodel: Test Optics Test 35mm" in saved
    assert b"xpacket" in saved


def test_photos_are_chosen_corrected_and_downloaded_together(
    page: Page, service: Service, learned: dict[str, Any], tmp_path: Path
) -> None:
    page.goto(f"/lenses/{learned['lens_id']}")
    page.get_by_role("checkbox", name="Choose wall-0.dng").check()
    expect(page.get_by_role("button", name="Correct 1 photo")).to_be_visible()
    page.get_by_role("button", name="Choose all").click()
    page.get_by_role("button", name="Correct 2 photos").click()
    page.wait_for_url("**/batch?ids=*")
    expect(page.locator("#live .lead")).to_have_text("All done")
    assert faults(page) == []

    with page.expect_download() as got:
        page.get_by_role("link", name="Download 2 photos").click()
    got.value.save_as(tmp_path / "corrected.zip")
    with zipfile.ZipFile(tmp_path / "corrected.zip") as archive:
        assert archive.testzip() is None
        assert sorted(archive.namelist()) == ["wall-0-corrected.tif", "wall-1-corrected.tif"]
    page.goto(f"/photos/{learned['id']}")  # it shows its correction
    expect(page.locator("#viewer")).to_have_attribute("data-shown", "split")
    expect(page.get_by_role("link", name="Download the corrected photo")).to_be_visible()


def test_fingers_zoom_and_move_the_view(page: Page, correction: dict[str, Any]) -> None:
    page.goto(f"/corrections/{correction['id']}")
    stage = page.locator(".stage")
    expect(page.locator(".zoom-words")).not_to_have_text("")
    stage.scroll_into_view_if_needed()
    box = stage.bounding_box()
    assert box is not None
    first = page.locator(".zoom-words").inner_text()
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    touch = page.context.new_cdp_session(page)
    for half in (60, 100, 180):  # beside the handle of the split
        points = [{"x": middle[0] + sign * half, "y": middle[1], "id": k} for k, sign in enumerate((-1, 1))]
        kind = "touchStart" if half == 60 else "touchMove"
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    expect(page.locator(".zoom-words")).not_to_have_text(first)


def test_a_lens_answers_three_questions_on_one_screen(page: Page, learned: dict[str, Any]) -> None:
    page.set_viewport_size({"width": 1440, "height": 900})
    page.goto(f"/lenses/{learned['lens_id']}")

    expect(page.locator("#live:not([hx-get])")).to_be_attached()
    expect(page.locator(".verdict")).to_contain_text("this copy is")
    expect(page.locator("section[aria-labelledby=copy-title]")).to_contain_text(
        re.compile("Yes|No|Not known")
    )
    expect(page.locator("section[aria-labelledby=next-title]")).to_contain_text("photo")
    expect(page.locator(".map")).not_to_have_js_property("naturalWidth", 0)
    bottom = page.evaluate("Math.max(...[...document.querySelectorAll('.answers > *')].map("
        "(part) => part.getBoundingClientRect().bottom))")  # fmt: skip
    assert bottom <= 900
    page.get_by_role("link", name="f/5.6").click()
    expect(page.locator(".verdict")).to_contain_text("At f/5.6")


def test_a_lens_has_charts_that_are_read_and_a_report(
    page: Page, service: Service, learned: dict[str, Any]
) -> None:
    page.goto(f"/lenses/{learned['lens_id']}")
    expect(page.locator("#live:not([hx-get])")).to_be_attached()
    page.get_by_role("link", name="Charts and figures").click()
    expect(page.locator("#charts img").first).to_be_visible()
    smallest = "(image) => 7 * 96 / 72 * image.clientWidth / image.naturalWidth"  # figures in a cell of a map
    for width in WIDTHS:
        page.set_viewport_size({"width": width, "height": 900})
        assert page.locator("#charts img").first.evaluate(smallest) >= 12.0, width
    controls = page.locator("#chart-controls")
    with page.expect_response(lambda answer: "/charts?" in answer.url and "lp%2Fmm" not in answer.url) as got:
        controls.locator("[name=aperture]").select_option("5.6")
    assert got.value.ok
    expect(page.locator("#charts img[alt$='f/5.6']").first).to_be_visible()
    with page.expect_download() as saved:
        page.get_by_role("link", name="As CSV").click()
    assert saved.value.suggested_filename.endswith(".csv")
    pdf = page.request.get(f"/v1/lenses/{learned['lens_id']}/report.pdf")
    assert pdf.body()[:5] == b"%PDF-"


def test_a_lens_is_renamed_merged_and_its_profile_taken_along(
    visitor: Visitor, page: Page, service: Service, tmp_path: Path
) -> None:
    made = [
        service.calibrated(write_photo(tmp_path / f"m{k}.dng", 61 + k, serial=f"M-{k}", shape=SMALL))[
            "lens_id"
        ]
        for k in range(2)
    ]
    page.goto(f"/lenses/{made[0]}")
    page.get_by_text("Rename, merge").click()
    with page.expect_download() as got:
        page.get_by_role("link", name="Download the profile").click()
    got.value.save_as(tmp_path / "one.lensprofile")
    page.get_by_label("Name", exact=True).fill("My first")
    page.get_by_role("button", name="Rename").click()
    expect(page.locator("h1")).to_have_text("My first")
    expect(page.get_by_role("button", name="Rename")).to_be_focused()  # and what was open is open

    page.get_by_label("It is the same copy as").select_option(made[1])
    page.get_by_role("button", name="Merge into it").click()
    page.get_by_role("button", name="Cancel").click()
    expect(page.get_by_role("button", name="Merge into it")).to_be_focused()
    page.get_by_role("button", name="Merge into it").click()
    page.get_by_role("button", name="Merge", exact=True).click()
    expect(page.get_by_role("dialog")).to_contain_text("its serial number is M-0, that of the lens M-1")
    visitor.complaints.clear()  # the browser notes that the service refused
    page.get_by_role("button", name="It is the same lens").click()
    page.wait_for_url(f"**/lenses/{made[1]}")
    expect(page.locator(".facts").first).to_contain_text("2 photos")
    assert service.http.get(f"/v1/lenses/{made[0]}").status_code == 404

    before = service.get(f"/v1/lenses/{made[1]}")
    page.get_by_text("Rename, merge").click()
    page.get_by_label("Add a lens profile").set_input_files(tmp_path / "one.lensprofile")
    page.get_by_role("button", name="Add", exact=True).click()
    expect(page.get_by_role("dialog")).to_contain_text("its serial number is M-0, that of the lens M-1")
    visitor.complaints.clear()  # the browser notes that the service refused
    with page.expect_navigation():
        page.get_by_role("button", name="It is the same lens").click()
    assert service.get(f"/v1/lenses/{made[1]}") == before  # the photo of the profile is one of its own
    page.get_by_role("button", name="Delete lens").click()
    page.get_by_role("button", name="Delete the lens").click()
    page.wait_for_url("**/")
    page.get_by_text("Add a lens from a profile").click()
    page.get_by_label("A file that ends in").set_input_files(tmp_path / "one.lensprofile")
    page.get_by_role("button", name="Add", exact=True).click()
    page.wait_for_url("**/lenses/*")
    expect(page.locator("h1")).to_have_text("Test Optics Test 35mm f/1.8")  # as the profile says
    expect(page.locator(".facts").first).to_contain_text("1 photo")


def test_a_page_does_not_go_while_somebody_is_asked(page: Page, learned: dict[str, Any]) -> None:
    looks: list[Route] = []
    page.goto(f"/lenses/{learned['lens_id']}")
    expect(page.locator("#live[hx-get]")).to_have_count(0)  # complete: it is not loaded anew by itself
    page.evaluate("window.first = true")
    page.route("**/ui/parts?*", lambda look: looks.append(look), times=1)  # noqa: PLW0108 - playwright marks it
    with page.expect_request("**/ui/parts?*"):
        page.evaluate(LOOK, learned["lens_id"])
    page.get_by_text("Rename, merge").click()
    page.get_by_role("button", name="Delete lens").click()
    expect(page.get_by_role("dialog")).to_be_visible()
    looks[0].continue_()  # answered only now, and later ones would be: the work of the page has ended
    page.wait_for_timeout(2500)  # longer than between two looks
    expect(page.get_by_role("dialog")).to_be_visible()
    assert page.evaluate("window.first")
    with page.expect_navigation():
        page.get_by_role("button", name="Cancel").click()
    assert not page.evaluate("window.first")


def test_the_focus_stays_where_a_button_was(page: Page, service: Service, tmp_path: Path) -> None:
    photo = service.calibrated(write_photo(tmp_path / "focus.dng", 63, serial="F-1", shape=SMALL))
    page.goto(f"/photos/{photo['id']}")
    page.get_by_role("button", name="Do not use it for the lens").click()

    expect(page.get_by_role("button", name="Use it again")).to_be_focused()


def test_a_page_says_when_the_service_is_away(visitor: Visitor, page: Page) -> None:
    page.goto("/")
    expect(page.locator("#away")).to_be_hidden()
    with page.expect_response(lambda answer: "/ui/parts" in answer.url) as asked_anew:
        page.evaluate(
            "dispatchEvent(new Event('offline'))"
        )  # no network, but the service is on this computer
    assert asked_anew.value.ok
    expect(page.locator("#away")).to_be_hidden()
    page.context.set_offline(True)
    page.evaluate("dispatchEvent(new Event('offline'))")
    expect(page.locator("#away")).to_be_visible()
    page.context.set_offline(False)
    expect(page.locator("#away")).to_be_hidden()
    visitor.complaints.clear()  # the browser notes that it is offline


def test_an_address_without_anything_is_a_page_for_people_and_json_for_programs(
    visitor: Visitor, page: Page, service: Service
) -> None:
    for address in ("/photos/gone", "/lenses/gone", "/corrections/gone", "/nowhere"):
        answer = page.goto(address)
        assert answer is not None
        assert answer.status == 404
        expect(page.locator("h1")).to_have_text("Not here")
    assert service.http.get("/photos/gone").json()["code"] == "unknown_photo"
    assert service.http.get("/v1/photos/gone", headers={"Accept": "text/html"}).json()["status"] == 404

    assert faults(page) == []
    visitor.complaints.clear()  # the browser notes each 404


@pytest.mark.parametrize("kind", ["home", "lens", "tests", "photo", "correction"])
def test_a_page_is_accessible_fits_each_screen_and_shows_the_focus(
    page: Page, learned: dict[str, Any], correction: dict[str, Any], kind: str
) -> None:
    page.goto(address_of(kind, learned, correction))
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
    check_each_stop_of_the_keyboard_is_seen(page)


def check_each_stop_of_the_keyboard_is_seen(page: Page) -> None:
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
