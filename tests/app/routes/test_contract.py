"""What holds for all resources: pages, tags, ids of nothing, what is deleted, and what makes no sense."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any

import pytest
from starlette.testclient import TestClient
from states import Steps, finish, refusal

Filled = Callable[[str], str]
JSON = {"Content-Type": "application/json"}


@pytest.fixture
def filled(client: TestClient, steps: Steps) -> Filled:
    """Put the ids of a counted photo, its lens and a finished correction in place of their names."""
    photo = steps.counted()
    row = steps.correct(photo, method="fast", strength=1.0, output={"format": "png8"}, roi=None)
    finish(client, row.public_id)
    ids = {"PHOTO": photo.public_id, "LENS": steps.lens_id(photo), "CORRECTION": row.public_id}
    return lambda text: re.sub("|".join(ids), lambda name: ids[name[0]], text)


# --- all endpoints ----------------------------------------------------------------------------------

# What programs rely on: one that is missing here or there has come or gone unnoticed
ENDPOINTS = """
GET /healthz
GET /readyz
POST DELETE /v1/session
GET DELETE /v1/account
GET /v1/account/export
GET /v1/version
GET /v1/formats
GET /v1/limits
GET POST PATCH /v1/photos
GET PATCH DELETE /v1/photos/{photo_id}
GET /v1/photos/{photo_id}/patches
GET /v1/jobs
GET /v1/jobs/{job_id}
POST /v1/jobs/{job_id}/cancel
POST /v1/jobs/{job_id}/retry
GET /v1/jobs/{job_id}/events
GET POST /v1/lenses
GET PATCH DELETE /v1/lenses/{lens_id}
GET /v1/lenses/{lens_id}/calibrations
GET /v1/lenses/{lens_id}/field.png
GET /v1/lenses/{lens_id}/lateral-colour
POST /v1/lenses/{lens_id}/measurements
GET PUT /v1/lenses/{lens_id}/profile
GET /v1/lenses/{lens_id}/psf
GET /v1/lenses/{lens_id}/psf.{suffix}
GET /v1/lenses/{lens_id}/report.{form}
GET POST /v1/corrections
GET DELETE /v1/corrections/{correction_id}
GET /v1/corrections/{correction_id}/result
"""


def test_the_description_names_all_endpoints_and_no_others(client: TestClient) -> None:
    paths = client.get("/openapi.json").json()["paths"]
    described = {(method.upper(), path) for path, operations in paths.items() for method in operations}
    lines = map(str.split, ENDPOINTS.split("\n")[1:-1])

    assert described == {(method, path) for *methods, path in lines for method in methods}


# --- lists ------------------------------------------------------------------------------------------


def jobs(steps: Steps, number: int) -> list[str]:
    photo = steps.counted()
    asked = {"method": "fast", "output": {"format": "png8"}, "roi": None}
    made = [steps.correct(photo, strength=k / 10, **asked).public_id for k in range(number - 1)]
    return [photo.public_id, *made]


MAKERS: dict[str, Callable[[Steps, int], list[str]]] = {
    "/photos": lambda steps, number: [steps.receive().public_id for _ in range(number)],
    "/jobs": jobs,
    "/lenses": lambda steps, number: [
        steps.lens_id(steps.counted(serial=str(k), patches=1)) for k in range(number)
    ],
    "/corrections": lambda steps, number: jobs(steps, number + 1)[1:],
}


@pytest.mark.parametrize("path", MAKERS)
def test_pages_join_without_gap_or_overlap(client: TestClient, steps: Steps, path: str) -> None:
    made, seen = MAKERS[path](steps, 5), list[str]()
    link: str | None = f"/v1{path}?limit=2"
    while link is not None:
        answer = client.get(link)
        seen += [item["id"] for item in answer.json()["items"]]
        link = answer.json()["next"]
        assert answer.headers.get("link") == (None if link is None else f'<{link}>; rel="next"')

    assert seen == made[::-1]


# --- one thing --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path",
    ["/v1/jobs/PHOTO", "/v1/jobs/CORRECTION", "/v1/corrections/CORRECTION/result", "/ui/parts?page=home"],
)
def test_what_has_not_changed_is_not_sent_again(client: TestClient, filled: Filled, path: str) -> None:
    first = client.get(filled(path))

    for known, status in ((first.headers["etag"], 304), ('"other"', 200)):
        again = client.get(filled(path), headers={"If-None-Match": known})
        assert (known, again.status_code, bool(again.content)) == (known, status, status == 200)


@pytest.mark.parametrize("kind", ["photo", "job", "lens", "correction"])
def test_an_unknown_id_is_a_plain_404(client: TestClient, kind: str) -> None:
    rooms = {"lens": "lenses"}.get(kind, f"{kind}s")
    for bad in ("nothing", "..", "%2e%2e%2fetc", "a' OR 1=1 --", "💥", "x" * 3000, "%00"):
        told = refusal(client.get(f"/v1/{rooms}/{bad}"))

        assert told in {(404, f"unknown_{kind}"), (404, "not_found")}, bad


# --- what makes no sense ----------------------------------------------------------------------------

INVALID = "invalid_parameter"
NEW = {"label": "mine"}
# A bad change of a photo is refused with 422, a bad wish for a correction too
CHANGES: list[object] = [
    *({}, [], {"colour": "red"}, {"lens_id": "a", "lens_serial": "b"}, {"lens_model": "EF"}),
    *({"aperture": bad} for bad in (0.1, "wide", True)),
    *({"focal_length_mm": False}, {"focus_distance_m": True}),
    *({"new_lens": {"label": ""}}, {"lens_serial": "\x07"}),
]
WISHES: list[dict[str, Any]] = [
    *({"method": "magic"}, {"method": ""}, {"strength": 1.5}, {"strength": "NaN"}, {"iterations": 5}),
    *({"halo": -0.1}, {"halo": "NaN"}, {"denoise": 1.5}, {"lens_version": 0}, {"lens_version": 10**20}),
    *({"output": bad} for bad in ({"format": "bmp"}, {"quality": 0}, {"color_space": "adobe"})),
    {"roi": {"x": 0, "y": 0, "width": 6001, "height": 10}},
    {"roi": {"x": -1, "y": 0, "width": 10, "height": 10}},
    {"roi": {"x": 0, "y": 0, "width": 0, "height": 10}},
    *({"photo_id": 7}, {"photo_id": "../../x"}),
]
PAGES = ("limit=0", "limit=201", "limit=x", f"cursor={'x' * 50}")
QUERIES = [
    *(f"{path}?{page}" for path in MAKERS for page in PAGES),
    *(f"/lenses/LENS/field.png?grid={grid}" for grid in ("0x3", "26x1", "axb", "9", "-1x2")),
    "/lenses/LENS/field.png?grid=25x25&size=255&aperture=1.4",
    *(f"/jobs/PHOTO?wait={wait}" for wait in ("-1", "21", "nan", "soon")),
    f"/lenses/LENS/psf?r=0&version={10**20}",
    f"/lenses/LENS/calibrations?cursor={10**20}",
    *("/lenses/LENS/psf.exe?r=0", "/photos?state=lost"),
]
REFUSED: list[tuple[str, str, Any, int, str]] = [
    *(("PATCH", "/v1/photos/PHOTO", change, 422, INVALID) for change in CHANGES),
    ("PATCH", "/v1/photos/PHOTO", {"lens_id": "nothing"}, 404, "unknown_lens"),
    *(("POST", "/v1/corrections", {"photo_id": "PHOTO"} | wish, 422, INVALID) for wish in WISHES),
    ("POST", "/v1/corrections", {"photo_id": "nothing"}, 404, "unknown_photo"),
    ("POST", "/v1/corrections", {"photo_id": "PHOTO", "lens_id": "nothing"}, 404, "unknown_lens"),
    ("POST", "/v1/corrections", {"photo_id": "PHOTO", "lens_version": 7}, 409, "conflict"),
    ("PATCH", "/v1/photos", {"photo_ids": ["PHOTO"]}, 422, INVALID),
    ("PATCH", "/v1/photos", {"photo_ids": ["PHOTO"], "lens_id": "x", "new_lens": NEW}, 422, INVALID),
    ("PATCH", "/v1/photos", {"photo_ids": ["gone"], "lens_id": "LENS"}, 404, "unknown_photo"),
    ("PATCH", "/v1/photos", {"photo_ids": ["PHOTO"], "lens_id": "gone"}, 404, "unknown_lens"),
    ("PATCH", "/v1/lenses/LENS", {}, 422, INVALID),
    ("PATCH", "/v1/lenses/LENS", {"merge_into": "LENS"}, 422, INVALID),
    ("POST", "/v1/lenses", {"label": ""}, 422, INVALID),
    *(("GET", f"/v1{query}", None, 422, INVALID) for query in QUERIES),
    ("GET", "/v1/lenses/gone/report.json", None, 404, "unknown_lens"),
    ("GET", "/nothing", None, 404, "not_found"),
    ("GET", "/v1/nothing", None, 404, "not_found"),
    ("PUT", "/v1/photos", None, 405, "method_not_allowed"),
    ("PUT", "/v1/lenses", None, 405, "method_not_allowed"),
]


def test_what_makes_no_sense_is_refused_with_a_problem(client: TestClient, filled: Filled) -> None:
    for method, path, body, status, code in REFUSED:
        content = None if body is None else filled(json.dumps(body))
        answer = client.request(method, filled(path), content=content, headers=JSON)

        case, problem = (method, path, body), answer.json()
        assert (case, answer.status_code, problem["code"]) == (case, status, code)
        assert answer.headers["content-type"] == "application/problem+json", case
        assert {"type", "title", "status", "detail", "errors", "request_id"} <= set(problem), case
        assert problem["detail"], case
        assert body != {"photo_id": "PHOTO", "method": "magic"} or "standard" in problem["detail"]
        assert "25x25" not in path or "40.6 million pixels" in problem["detail"]


@pytest.mark.parametrize(
    "body", [b"{", b"", b"\xff\xfe", b'{"aperture": NaN}', b"[" * 5000, b'{"\\ud800": "\\ud800"}']
)
def test_bad_json_is_a_problem_and_not_a_crash(client: TestClient, filled: Filled, body: bytes) -> None:
    for method, path in (("PATCH", "/v1/photos/PHOTO"), ("POST", "/v1/corrections")):
        answer = client.request(method, filled(path), content=body, headers=JSON)

        assert answer.status_code in {400, 422}
        assert answer.headers["content-type"] == "application/problem+json"
