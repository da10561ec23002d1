"""Changes of an open page, sent to it in one event stream."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Mapping
from functools import partial
from typing import Annotated, Final, Literal

from fastapi import APIRouter, Query
from sse_starlette import EventSourceResponse, ServerSentEvent
from starlette.concurrency import run_in_threadpool

from app.errors import UnknownCorrectionError, UnknownLensError, UnknownPhotoError
from app.http import views
from app.http.dependencies import Call, CallDep
from app.http.open_pages import Fragments
from app.pages import shown
from app.pages.rendering import fragment
from app.routes import corrections as correction_routes
from app.routes import lenses as lens_routes
from app.routes import photos as photo_routes

router = APIRouter(include_in_schema=False)

REDRAW_S: Final = 15.0
"""Seconds after which an unchanged page is rendered anew (chosen): estimates of time left change."""

Page = Literal["home", "photo", "correction", "lens"]


@router.get("/ui/events")
async def events(
    call: CallDep,
    page: Page = "home",
    id: Annotated[str, Query(max_length=60)] = "",  # noqa: A002
) -> EventSourceResponse:
    """Send the parts of a page now and whenever they change."""
    draw = _DRAWERS[page]
    await run_in_threadpool(draw, call, id)  # a missing object is refused before the stream begins
    return EventSourceResponse(_changes(call, page, id), ping=15)


async def _changes(call: Call, page: Page, key: str) -> AsyncIterator[ServerSentEvent]:
    sent: dict[str, str] = {}
    draw = partial(_DRAWERS[page], call, key)
    with call.services.pages.view(call.owner, page, key, draw) as view:
        while True:
            if not await run_in_threadpool(call.services.gate.is_still, call.who):
                return  # the key was revoked meanwhile
            try:
                parts = await view.parts()
            except (UnknownPhotoError, UnknownLensError, UnknownCorrectionError):  # deleted while watched
                yield ServerSentEvent(data="", event="gone")
                return
            for name, html in parts.items():
                if sent.get(name) != html:
                    sent[name] = html
                    yield ServerSentEvent(data=html, event="part", id=name)
            await view.changed(REDRAW_S)


def _home(call: Call, _: str) -> Fragments:
    photos, more = shown.photos(call)
    return {
        "waiting": fragment(
            "_waiting.html", groups=shown.waiting(call), lenses=shown.lenses_with_photos(call)
        ),
        "lenses": fragment("_lenses.html", lenses=shown.lenses_with_photos(call)),
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


def _lens(call: Call, lens_id: str) -> Fragments:
    lens = lens_routes.read_lens(lens_id, call)
    known = {"counting": shown.counting(call, lens_id), "anew": shown.anew(call, lens_id)}
    return {"lens-state": fragment("_lens_state.html", lens=lens, **known)}


_DRAWERS: Final[Mapping[Page, Callable[[Call, str], Fragments]]] = {
    "home": _home,
    "photo": _photo,
    "correction": _correction,
    "lens": _lens,
}
