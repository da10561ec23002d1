"""The parts of an open page that change, which it asks for every two seconds."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from typing import Final, Literal, TypeAlias

from fastapi import APIRouter, Response

from app.http import views
from app.http.dependencies import Call, CallDep
from app.pages import batch, shown
from app.pages.rendering import fragment
from app.routes import corrections as correction_routes
from app.routes import lenses as lens_routes
from app.routes import photos as photo_routes
from app.routes.common import matches_tag

router = APIRouter(include_in_schema=False)

Page = Literal["home", "photo", "correction", "batch", "lens"]
Fragments: TypeAlias = Mapping[str, str]
"""HTML by the id of the element that it replaces."""


@router.get("/ui/parts")
def parts(
    call: CallDep,
    page: Page = "home",
    id: batch.Ids = "",  # noqa: A002
) -> Response:
    """Return the parts of a page as they are now; 304 where the browser has them."""
    body = json.dumps(_DRAWERS[page](call, id)).encode()
    tag = f'"{hashlib.sha256(body).hexdigest()[:16]}"'
    headers = {"ETag": tag, "Cache-Control": "private, no-cache"}
    if matches_tag(call, tag):
        return Response(status_code=304, headers=headers)
    return Response(body, media_type="application/json", headers=headers)


def _home(call: Call, _: str) -> Fragments:
    photos, more = shown.photos(call)
    lenses = shown.lenses_with_photos(call)
    return {
        "waiting": fragment("_waiting.html", groups=shown.waiting(call), lenses=lenses),
        "lenses": fragment("_lenses.html", lenses=lenses),
        "photos": fragment("_photos.html", photos=photos, more=more),
    }


def _photo(call: Call, photo_id: str) -> Fragments:
    photo = photo_routes.described_photo(call, photo_routes.find_photo(call, photo_id))
    return {"photo-state": fragment("_photo_state.html", photo=photo)}


def _correction(call: Call, correction_id: str) -> Fragments:
    plan = correction_routes.find_plan(call, correction_id)
    return {
        "correction-state": fragment(
            "_correction_state.html", correction=views.correction_out(plan), job=views.correction_job(plan)
        )
    }


def _batch(call: Call, ids: str) -> Fragments:
    return {"batch-state": fragment("_batch.html", **batch.state(call, ids))}


def _lens(call: Call, lens_id: str) -> Fragments:
    lens = lens_routes.read_lens(lens_id, call)
    state = fragment("_lens_state.html", lens=lens, counting=shown.counting(call, lens_id))
    return {"lens-state": state}


_DRAWERS: Final[Mapping[Page, Callable[[Call, str], Fragments]]] = {
    "home": _home,
    "photo": _photo,
    "correction": _correction,
    "batch": _batch,
    "lens": _lens,
}
