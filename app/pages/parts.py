"""The part of an open page that changes: htmx asks for it while there is work to wait for."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from typing import Any, Final, Literal

from fastapi import APIRouter, Response

from app.http import views
from app.http.dependencies import Call, CallDep, OneSession
from app.pages import batch, shown, words
from app.pages.rendering import fragment
from app.routes import corrections as correction_routes
from app.routes import lenses as lens_routes
from app.routes import photos as photo_routes
from app.routes.common import matches_tag

router = APIRouter(include_in_schema=False, route_class=OneSession)
Page = Literal["home", "photo", "correction", "batch", "lens"]


@router.get("/ui/parts")
def parts(
    call: CallDep,
    page: Page = "home",
    id: batch.Ids = "",  # noqa: A002
) -> Response:
    """Return the part of a page as it is now, 304 where the browser has it; at the end ask for all."""
    template, values, settled = _PARTS[page](call, id)
    body = fragment(template, **values).encode()
    tag = f'"{hashlib.sha256(body).hexdigest()[:16]}"'
    headers = {"ETag": tag, "Cache-Control": "private, no-cache"}
    if settled:
        headers["HX-Refresh"] = "true"
    elif matches_tag(call, tag):
        return Response(status_code=304, headers=headers)
    return Response(body, media_type="text/html", headers=headers)


# Template, what it shows, and whether the page has to be made anew
Part = tuple[str, Mapping[str, Any], bool]


def home(call: Call, _: str = "") -> Part:
    """Return what is shown of all photos and lenses."""
    photos, more = shown.photos(call)
    lenses = shown.lenses_with_photos(call)
    values = {
        "photos": photos,
        "more": more,
        "lenses": lenses,
        "groups": shown.waiting(call),
        "next": shown.next_step(call, photos, lenses),
    }
    return "_home.html", values, False


def _photo(call: Call, photo_id: str) -> Part:
    photo = photo_routes.get_photo(photo_id, call)
    return "_photo_state.html", {"photo": photo}, not words.active(photo)


def _correction(call: Call, correction_id: str) -> Part:
    plan = correction_routes.find_correction(call, correction_id)
    correction, job = views.correction_out(plan), views.job_out(plan)
    values = {"correction": correction, "job": job}
    return "_correction_state.html", values, job.state not in {"queued", "running"}


def _batch(call: Call, ids: str) -> Part:
    return "_batch.html", batch.state(call, ids), False


def _lens(call: Call, lens_id: str) -> Part:
    counting = shown.counting(call, lens_id)
    values = {"lens": lens_routes.get_lens(lens_id, call), "counting": counting}
    return "_lens_state.html", values, not counting


_PARTS: Final[Mapping[Page, Callable[[Call, str], Part]]] = {
    "home": home,
    "photo": _photo,
    "correction": _correction,
    "batch": _batch,
    "lens": _lens,
}
