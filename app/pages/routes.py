"""Pages, and their parts that change while one looks; all they do goes through the same API as others use."""

from __future__ import annotations

import hashlib
import re
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path, PurePath
from typing import Annotated, Any, Final, Literal
from urllib.parse import quote

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse, StreamingResponse
from fastapi.staticfiles import StaticFiles
from jinja2 import Environment, PackageLoader, select_autoescape
from pydantic import BeforeValidator

from app.blobs.account_data import zipped
from app.errors import NotReadyError
from app.http import errors, views
from app.http.dependencies import Call, CallDep, OneSession, call_of
from app.jobs.answers import SHOWN, SIDES
from app.pages import pictures, shown
from app.routes.common import file_headers
from app.routes.corrections import list_corrections
from app.routes.lenses import get_lens, list_calibrations, stored_report
from app.schemas import Aperture, PhotoOut, blank_is_none
from app.store.tables import PHOTO_WORKED_ON, CorrectionRow, LensRow
from lensmodel.api import SEEN_DB
from lensmodel.cli.console import gain_words
from lensmodel.core.errors import NoSamplesError
from lensmodel.core.names import full_name
from lensmodel.photo.values import ENDINGS
from lensmodel.report.export import place_table
from lensmodel.report.lens_report import LensReport, Unit, caution, sharpness

STATIC: Final = Path(__file__).parent / "static"
HEADERS: Final = {
    **errors.HEADERS,
    "Content-Security-Policy": (
        "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; "
        "frame-ancestors 'none'; base-uri 'none'; form-action 'self'"
    ),
}
# Letters of a list of corrections (chosen): those of the photos of one page, and what addresses may have
MAX_LENGTH: Final = 4000
SHOWN_VERSIONS: Final = 200  # Versions of the history on the page (chosen): the newest of them
# Width over height before there are photos: that of a full-frame sensor, 36 x 24 mm
DEFAULT_ASPECT: Final = 1.5
router = APIRouter(include_in_schema=False, route_class=OneSession)
# What whoever is not signed in yet may see
strangers = APIRouter(include_in_schema=False, route_class=OneSession)

templates = Environment(loader=PackageLoader("app.pages"), autoescape=select_autoescape(), trim_blocks=True)
templates.filters.update(
    sharpness=sharpness,
    caution=caution,
    gain_words=gain_words,
    f_stop="f/{:.3g}".format,
    # without the figures, in brackets or after a colon, which are for testers
    plain=partial(re.sub, r" \([^)]*\)|: [^:]*\d%[^:]*?(?=\.?$)", ""),
)
templates.globals.update(picker_endings=",".join((*sorted(ENDINGS), "image/*")), full_name=full_name)
templates.globals["words"] = templates.get_template("words.html").module  # in all of them


def include(site: APIRouter) -> None:
    """Add the pages and their files to the routes of the service."""
    site.include_router(strangers)
    for part in (router, pictures.router):
        site.include_router(part, dependencies=[Depends(call_of)])
    site.mount("/static", StaticFiles(directory=STATIC), name="static")


async def refusal(request: Request, error: Exception) -> Response:
    """Answer an exception: by a page where a browser asked for one, else as programs read it.

    An open page whose session has ended goes to the sign-in; one whose subject is gone, to the first page.
    """
    plain = errors.answer(request, error)
    status = plain.status_code
    if status in {401, 404} and "hx-request" in request.headers:
        seen = quote(request.headers.get("hx-current-url", "/"), safe="/")
        plain.headers["HX-Redirect"] = f"/sign-in?next={seen}" if status == 401 else "/"
    wanted = request.method == "GET" and "text/html" in request.headers.get("accept", "")
    if not wanted or request.url.path.startswith(("/v1/", "/ui/", "/static/")):
        return plain
    if status == 401:
        return RedirectResponse(f"/sign-in?next={quote(request.url.path, safe='/')}", 303)
    return page("missing.html", status, status_code=status, detail=str(error))


def page(name: str, status: int = 200, **values: Any) -> HTMLResponse:  # noqa: ANN401 - what the template shows
    """Return a page made from a template."""
    return HTMLResponse(templates.get_template(name).render(**values), status, headers=HEADERS)


@strangers.get("/sign-in")
async def sign_in() -> HTMLResponse:
    """Ask for a key."""
    return page("sign_in.html")


@router.get("/docs")
def interface(request: Request) -> HTMLResponse:
    """Show what programs can ask, from the same description that programs read; nothing is loaded for it."""
    return page("docs.html", paths=request.app.openapi()["paths"])


@router.get("/")
def home(call: CallDep) -> HTMLResponse:
    """Show where photos are given and what became of them."""
    return page("home.html", **_home(call))


# --- photos and corrections ---------------------------------------------------------------------------


@router.get("/photos/{photo_id}")
def photo_page(photo_id: str, call: CallDep) -> HTMLResponse:
    """Show a photo: how to correct it, and what it taught."""
    values = _photo(call, photo_id)
    row, photo = values["row"], values["photo"]
    patches = call.store.photos.windows(photo_id)
    left_out = Counter(patch.reason for patch in patches if patch.state in {"rejected", "failed"})
    lens = None if photo.lens_id is None else get_lens(photo.lens_id, call)
    candidates = [] if lens else shown.lenses_with_photos(call)
    candidates = [each for each in candidates if each.samples or photo.state == "needs_lens"]
    corrections = list_corrections(call, limit=50, photo_id=photo_id).items
    return page(
        "photo.html",
        **values,
        can_look=pictures.exists(call.storage, f"{row.folder}{SHOWN}"),
        used=sum(patch.state == "done" for patch in patches),
        reasons=left_out.most_common(),
        candidates=candidates,
        group=shown.grouped([row])[0],
        lens=lens,
        corrections=[correction for correction in corrections if correction.roi is None],
        least=SEEN_DB,
    )


@router.get("/corrections/{correction_id}")
def correction_page(correction_id: str, call: CallDep) -> HTMLResponse:
    """Show a corrected photo beside the original."""
    plan = call.correction(correction_id)
    looked = plan.params["roi"] is None and not (plan.report or {}).get("nothing_to_correct")
    can_look = looked and pictures.exists(call.storage, f"{plan.run_folder}{SIDES['after']}")
    return page(
        "correction.html",
        photo=views.photo_out(plan.photo),
        row=plan.photo,
        can_look=can_look,
        learned_from=0 if plan.lens is None else plan.lens.photo_count,
        **_correction(call, correction_id),
    )


# --- several corrections ------------------------------------------------------------------------------

Ids = Annotated[str, Query(max_length=MAX_LENGTH)]


@router.get("/batch")
def batch_page(ids: Ids, call: CallDep) -> HTMLResponse:
    """Show how far the corrections are whose ids have commas between them."""
    return page("batch.html", **_batch(call, ids))


@router.get("/batch.zip")
def batch_archive(ids: Ids, call: CallDep) -> StreamingResponse:
    """Return the files of the corrections that are done."""
    plans = [plan for plan in _plans(call, ids) if plan.state == "succeeded"]
    if not plans:
        raise NotReadyError("none of these corrections is done yet: wait for them")
    files = zipped(_files(call, plans))
    return StreamingResponse(files, media_type="application/zip", headers=file_headers("corrected.zip"))


def _plans(call: Call, ids: str) -> list[CorrectionRow]:
    return [call.correction(key) for key in dict.fromkeys(filter(None, ids.split(",")))]


def _files(call: Call, plans: Sequence[CorrectionRow]) -> Iterator[tuple[zipfile.ZipInfo, Iterable[bytes]]]:
    """Yield the files of corrections, which are compressed already."""
    used = set[str]()
    for row in plans:
        assert row.result_key is not None
        assert row.result_bytes is not None
        name = unused_name(row.result_name or row.public_id, used)
        entry = zipfile.ZipInfo(name, row.photo.received_at.timetuple()[:6])
        yield entry, call.storage.stream(row.result_key, 0, row.result_bytes)


def unused_name(name: str, used: set[str]) -> str:
    """Return a name that no file of the archive has yet."""
    path, count, free = PurePath(name), 1, name
    while free.casefold() in used:
        count += 1
        free = f"{path.stem} ({count}){path.suffix}"
    used.add(free.casefold())
    return free


# --- lenses -------------------------------------------------------------------------------------------

ChosenAperture = Annotated[Aperture | None, BeforeValidator(blank_is_none), Query()]  # of a form


@router.get("/lenses/{lens_id}")
def lens_page(lens_id: str, call: CallDep, aperture: ChosenAperture = None) -> HTMLResponse:
    """Show what a lens does to pictures, whether it is a good copy, and which photo would help."""
    lens, row = get_lens(lens_id, call), call.lens(lens_id)
    photos, more = shown.photos(call, lens_id)
    aspect, test = _aspect(call, row), _test(call, row)
    apertures = lens.apertures if test is None else [number for number in test.apertures if number]
    chosen = aperture or (apertures[0] if apertures else None)
    found = None if test is None else test.at(chosen)
    return page(
        "lens.html",
        **_lens(call, lens_id, photos),
        known={lens_id} if lens.samples else set(),
        photos=photos,
        more=more,
        others=[other for other in shown.lenses_with_photos(call) if other.id != lens_id],
        aspect=aspect,
        apertures=apertures,
        aperture=chosen,
        cell=shown.cell_px([] if found is None else [spot.kernel for spot in found.spots]),
        test=test,
        found=found,
    )


@router.get("/lenses/{lens_id}/tests")
def lens_tests(lens_id: str, call: CallDep) -> HTMLResponse:
    """Show what testers and researchers ask of a lens: charts, its blur at any point, its versions."""
    lens, row = get_lens(lens_id, call), call.lens(lens_id)
    before = max(lens.version - SHOWN_VERSIONS, 0)  # the newest are shown
    history = list_calibrations(lens_id, call, limit=SHOWN_VERSIONS, cursor=before).items
    photos, _ = shown.photos(call, lens_id)
    test = _test(call, row)
    return page(
        "lens_tests.html",
        **_lens(call, lens_id, photos),
        history=history,
        names={photo.id: photo.filename for photo in photos},
        aspect=_aspect(call, row),
        test=test,
        **({} if test is None else _charts(test)),
    )


@router.get("/ui/lenses/{lens_id}/charts")
def lens_charts(
    lens_id: str, call: CallDep, aperture: ChosenAperture = None, unit: Unit = "c/px"
) -> HTMLResponse:
    """Show the charts of one aperture."""
    return page("_charts.html", **_charts(stored_report(call, call.lens(lens_id)), aperture, unit))


def _charts(test: LensReport, aperture: float | None = None, unit: Unit = "c/px") -> dict[str, Any]:
    from lensmodel.report.plots import charts  # noqa: PLC0415 - matplotlib is slow to import

    return {"charts": charts(test, aperture, unit), "table": place_table(test)}


def _test(call: Call, lens: LensRow) -> LensReport | None:
    try:
        return stored_report(call, lens)
    except (NotReadyError, NoSamplesError):
        return None


def _aspect(call: Call, lens: LensRow) -> float:
    """Return the commonest width over height of the photos of a lens, in sensor orientation."""
    shape = call.store.lenses.shape_of(lens)
    return DEFAULT_ASPECT if shape is None else round(shape[1] / shape[0], 4)


# --- parts that change: htmx asks for them while there is work to wait for ----------------------------

Open = Literal["home", "photo", "correction", "batch", "lens"]


@router.get("/ui/parts")
def parts(call: CallDep, page: Open = "home", id: Ids = "") -> Response:  # noqa: A002
    """Return the part of a page as it is now, 304 where the browser has it; at the end ask for all."""
    body = templates.get_template(f"_{page}_state.html").render(**_STATES[page](call, id)).encode()
    tag = f'"{hashlib.sha256(body).hexdigest()[:16]}"'
    headers = {"ETag": tag, "Cache-Control": "private, no-cache"}
    if b' hx-get="' not in body:  # it asks no more; quotes in names are escaped
        headers["HX-Refresh"] = "true"
    elif call.knows(tag):
        return Response(status_code=304, headers=headers)
    return Response(body, media_type="text/html", headers=headers)


def _home(call: Call, _: str = "") -> dict[str, Any]:
    """Return what is shown of all photos and lenses."""
    photos, more = shown.photos(call)
    lenses = shown.lenses_with_photos(call)
    steps = {"groups": shown.waiting(call), "next": shown.next_step(call, photos, lenses)}
    known = {lens.id for lens in lenses if lens.samples}
    return {"photos": photos, "more": more, "lenses": lenses, "known": known, **steps}


def _photo(call: Call, photo_id: str) -> dict[str, Any]:
    """Return a photo and the address of its best picture so far."""
    row = call.photo(photo_id)
    glance = f"/ui/photos/{photo_id}/thumbnail.jpg" if row.width else None
    if pictures.exists(call.storage, f"{row.folder}{SHOWN}"):
        glance = f"/ui/photos/{photo_id}/tiles/before/whole.jpg"
    return {"photo": views.photo_out(row), "row": row, "glance": glance}


def _lens(call: Call, lens_id: str, photos: Sequence[PhotoOut] | None = None) -> dict[str, Any]:
    """Return a lens, and whether and by what it is about to change."""
    listed = shown.photos(call, lens_id)[0] if photos is None else photos
    working = [photo for photo in listed if photo.state in PHOTO_WORKED_ON]
    return {"lens": get_lens(lens_id, call), "counting": shown.counting(call, lens_id), "working": working}


def _correction(call: Call, correction_id: str) -> dict[str, Any]:
    plan = call.correction(correction_id)
    return {"correction": views.correction_out(plan), "job": views.job_out(plan)}


def _batch(call: Call, ids: str) -> dict[str, Any]:
    plans = _plans(call, ids)
    return {"plans": plans, "corrections": [views.correction_out(plan) for plan in plans], "ids": ids}


_STATES: Final[Mapping[Open, Callable[[Call, str], dict[str, Any]]]] = {
    "home": _home,
    "photo": _photo,
    "correction": _correction,
    "batch": _batch,
    "lens": _lens,
}
