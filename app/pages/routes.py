"""Pages and their fragments and pictures; everything they do goes through the same API as others use."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Annotated, Any, Final, TypeAlias

from fastapi import APIRouter, FastAPI, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse
from fastapi.staticfiles import StaticFiles
from jinja2 import Environment, PackageLoader, select_autoescape
from starlette.exceptions import HTTPException

from app import views
from app.dependencies import Call, CallDep
from app.errors import InvalidParameterError, NotReadyError
from app.jobs.handover import BEFORE, PREVIEW, R_MAP
from app.pages import pictures, words
from app.pages.interface import operations
from app.routes import corrections as correction_routes
from app.routes import lenses as lens_routes
from app.routes import photos as photo_routes
from app.schemas import LensOut, PhotoOut
from app.store.corrections import CorrectionPlan
from app.store.corrections import folder_of as folder_of_correction
from app.store.photos import folder_of
from lensmodel.errors import LensModelError
from lensmodel.types import FieldPosition

HERE: Final = Path(__file__).parent
SHOWN: Final = 60
SHOWN_VERSIONS: Final = 200
ROWS: Final = (("upper", 0.0), ("", 0.5), ("lower", 1.0))
COLUMNS: Final = (("left", 0.0), ("middle", 0.5), ("right", 1.0))
PLACES: Final = tuple(
    (f"{above} {beside}".strip() if (above or beside != "middle") else "center", row, col)
    for above, row in ROWS
    for beside, col in COLUMNS
)
"""Nine places of a picture with their shares of its height and width."""

HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; "
        "frame-ancestors 'none'; base-uri 'none'; form-action 'self'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}

Share = Annotated[float, Query(ge=0, le=1, allow_inf_nan=False)]
Side = Annotated[int, Query(ge=16, le=2000)]

router = APIRouter(include_in_schema=False)
templates = Environment(loader=PackageLoader("app.pages"), autoescape=select_autoescape(), trim_blocks=True)
templates.filters.update(words.FILTERS)


def install(app: FastAPI) -> None:
    """Add the pages and their files to the application."""
    app.include_router(router)
    app.mount("/static", StaticFiles(directory=HERE / "static"), name="static")
    for kind in (LensModelError, HTTPException, RequestValidationError, Exception):
        app.add_exception_handler(kind, _for_people(app.exception_handlers[kind]))


Handler: TypeAlias = Callable[[Request, Any], Any]


def _for_people(answer: Handler) -> Handler:
    """Show what an exception handler answers as a page, where a person asked for one."""

    async def handle(request: Request, error: Exception) -> Response:
        waited = answer(request, error)
        plain: Response = await waited if isinstance(waited, Awaitable) else waited
        if plain.status_code < 400 or not _asked_for_page(request):
            return plain
        title, detail = words.refusal(plain.status_code, str(error))
        return _page("missing.html", plain.status_code, title=title, detail=detail)

    return handle


def _asked_for_page(request: Request) -> bool:
    wanted = "text/html" in request.headers.get("accept", "")
    return (
        request.method == "GET" and wanted and not request.url.path.startswith(("/v1/", "/ui/", "/static/"))
    )


def _page(name: str, status: int = 200, **values: Any) -> HTMLResponse:  # noqa: ANN401 - what the template shows
    return HTMLResponse(templates.get_template(name).render(**values), status, headers=HEADERS)


def _photos(call: Call, lens_id: str | None = None) -> tuple[list[PhotoOut], bool]:
    page = photo_routes.list_photos(call, limit=SHOWN, lens_id=lens_id)
    return page.items, page.next is not None


def _lenses(call: Call) -> list[LensOut]:
    return lens_routes.list_lenses(call, limit=SHOWN).items


@router.get("/")
def home(call: CallDep) -> HTMLResponse:
    """Show where photos are given and what became of them."""
    photos, more = _photos(call)
    return _page("home.html", photos=photos, more=more, lenses=_lenses(call))


@router.get("/docs")
def interface(request: Request) -> HTMLResponse:
    """Show what programs can ask, from the same description that programs read; nothing is loaded for it."""
    description = request.app.openapi()
    return _page("docs.html", title=description["info"]["title"], groups=operations(description))


@router.get("/ui/photos")
def photos_fragment(call: CallDep) -> HTMLResponse:
    """Show the list of photos again."""
    photos, more = _photos(call)
    return _page("_photos.html", photos=photos, more=more)


@router.get("/ui/lenses")
def lenses_fragment(call: CallDep) -> HTMLResponse:
    """Show the list of lenses again."""
    return _page("_lenses.html", lenses=_lenses(call))


@router.get("/lenses/{lens_id}")
def lens_page(lens_id: str, call: CallDep) -> HTMLResponse:
    """Show a lens: its field of blur, its history, its photos."""
    lens = lens_routes.read_lens(lens_id, call)
    before = max(lens.version - SHOWN_VERSIONS, 0)  # the newest are shown
    history = lens_routes.list_calibrations(lens_id, call, limit=SHOWN_VERSIONS, cursor=before).items
    photos, more = _photos(call, lens_id)
    seen = _seen(call, photos)
    newest = next((event.coverage for event in reversed(history) if event.coverage), None)
    return _page(
        "lens.html",
        lens=lens,
        counting=_counting(call, lens_id),
        history=history,
        coverage=words.coverage_bars(newest),
        seen=seen,
        spots=_spots(seen),
        photos=photos,
        more=more,
    )


@router.get("/ui/lenses/{lens_id}/state")
def lens_state(lens_id: str, call: CallDep) -> HTMLResponse:
    """Show whether the newest version of a lens is still being measured."""
    lens = lens_routes.read_lens(lens_id, call)
    return _page("_lens_state.html", lens=lens, counting=_counting(call, lens_id))


def _counting(call: Call, lens_id: str) -> bool:
    """Whether a worker has yet to measure the newest version of a lens."""
    lens = lens_routes.find_lens(call, lens_id)
    newest = call.store.lenses.history(lens, after=lens.version - 1)
    return lens.sample_count > 0 and any(event.metrics is None for event in newest)


def _spots(seen: list[FieldPosition]) -> list[tuple[float, float]]:
    """Return where places lie in a field of 3:2 from (-1.5, -1) to (1.5, 1), y downwards."""
    corner = math.hypot(1.5, 1.0)
    return [(corner * p.r * math.cos(p.phi), -corner * p.r * math.sin(p.phi)) for p in seen]


def _seen(call: Call, photos: list[PhotoOut]) -> list[FieldPosition]:
    """Return where patches of counted photos gave a PSF."""
    return [
        FieldPosition(patch.r, patch.phi)
        for photo in photos
        if photo.state == "counted"
        for patch in call.store.patches.all_of(photo.id)
        if patch.state == "done"
    ]


@router.get("/photos/{photo_id}")
def photo_page(photo_id: str, call: CallDep) -> HTMLResponse:
    """Show a photo: what it taught, and how to correct it."""
    row = photo_routes.find_photo(call, photo_id)
    photo = photo_routes.describe(call, row)
    turned = row.orientation or 1
    patches = [views.patch_out(patch) for patch in call.store.patches.listed(photo_id)]
    if row.height and row.width:
        patches = [pictures.upright_patch(patch, row.height, row.width, turned) for patch in patches]
        if turned > 4:
            photo = photo.model_copy(update={"width": row.height, "height": row.width})
    left_out = Counter(patch.reason for patch in patches if patch.state in {"rejected", "failed"})
    candidates = []
    if photo.lens_id is None:
        candidates = [lens for lens in _lenses(call) if lens.samples or photo.state == "needs_lens"]
    mine = correction_routes.list_corrections(call, limit=50, photo_id=photo_id).items
    return _page(
        "photo.html",
        photo=photo,
        patches=patches,
        used=sum(patch.state == "done" for patch in patches),
        reasons=left_out.most_common(),
        candidates=candidates,
        lens=None if photo.lens_id is None else lens_routes.read_lens(photo.lens_id, call),
        corrections=mine,
    )


@router.get("/ui/photos/{photo_id}/state")
def photo_state(photo_id: str, call: CallDep) -> HTMLResponse:
    """Show where a photo stands."""
    photo = photo_routes.describe(call, photo_routes.find_photo(call, photo_id))
    return _page("_photo_state.html", photo=photo)


@router.get("/corrections/{correction_id}")
def correction_page(correction_id: str, call: CallDep) -> HTMLResponse:
    """Show a corrected photo beside the original."""
    plan = correction_routes.find_plan(call, correction_id)
    correction = views.correction_out(plan)
    return _page(
        "correction.html",
        correction=correction,
        job=views.correction_job(plan),
        photo=photo_routes.describe(call, plan.photo),
        zones=words.gain_bars((correction.report or {}).get("zones") or {}),
        places=PLACES,
    )


@router.get("/ui/corrections/{correction_id}/state")
def correction_state(correction_id: str, call: CallDep) -> HTMLResponse:
    """Show where a correction stands."""
    plan = correction_routes.find_plan(call, correction_id)
    return _page(
        "_correction_state.html", correction=views.correction_out(plan), job=views.correction_job(plan)
    )


# --- pictures ------------------------------------------------------------------------------------


def _picture(data: bytes, media_type: str) -> Response:
    return Response(data, media_type=media_type, headers={"Cache-Control": "private, max-age=3600"})


@router.get("/ui/photos/{photo_id}/preview.jpg")
def photo_preview(photo_id: str, call: CallDep, size: Side = 1200) -> Response:
    """Show a photo in small."""
    key = f"{folder_of(photo_routes.find_photo(call, photo_id))}{PREVIEW}"
    return _picture(pictures.resized(pictures.stored(call.storage, key), size), "image/jpeg")


@router.get("/ui/photos/{photo_id}/r-map.png")
def photo_r_map(photo_id: str, call: CallDep, size: Side = 1200) -> Response:
    """Show where the edges of a photo tell about the blur."""
    key = f"{folder_of(photo_routes.find_photo(call, photo_id))}{R_MAP}"
    return _picture(pictures.resized(pictures.stored(call.storage, key), size), "image/png")


@router.get("/ui/photos/{photo_id}/crop.png")
def photo_crop(
    photo_id: str,
    correction: str,
    call: CallDep,
    row: Share,
    col: Share,
    width: Side = 640,
    height: Side = 420,
) -> Response:
    """Show a part of the photo as it was before a correction, 1:1."""
    photo_routes.find_photo(call, photo_id)
    plan = _compared(call, correction)
    key = f"{folder_of_correction(plan.correction)}{BEFORE}"
    picture = pictures.decoded(call.storage, key, "image/jpeg", plan.photo.orientation or 1)
    return _picture(pictures.crop(picture, row, col, height, width), "image/png")


@router.get("/ui/corrections/{correction_id}/crop.png")
def correction_crop(
    correction_id: str, call: CallDep, row: Share, col: Share, width: Side = 640, height: Side = 420
) -> Response:
    """Show a part of the corrected photo, 1:1."""
    plan = _compared(call, correction_id)
    done = plan.correction
    assert done.result_key is not None
    assert done.result_media_type is not None
    turned = plan.photo.orientation or 1
    picture = pictures.decoded(call.storage, done.result_key, done.result_media_type, turned)
    return _picture(pictures.crop(picture, row, col, height, width), "image/png")


def _compared(call: Call, correction_id: str) -> CorrectionPlan:
    plan = correction_routes.find_plan(call, correction_id)
    if plan.correction.state != "succeeded":
        raise NotReadyError(f"correction {correction_id} is {plan.correction.state}: wait for its job")
    if plan.correction.params["output"]["format"] == "dng":
        raise InvalidParameterError("a DNG is not a picture yet: download it and develop it to compare")
    return plan
