"""Pages; everything they do goes through the same API as others use."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Final, TypeAlias
from urllib.parse import quote

from fastapi import APIRouter, Depends, FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, RedirectResponse
from fastapi.staticfiles import StaticFiles
from starlette.exceptions import HTTPException

from app.http.dependencies import CallDep, OneSession, call_of
from app.pages import batch, lens_pages, parts, photo_pages, pictures, words
from app.pages.rendering import page
from lensmodel.core.errors import LensModelError

HERE: Final = Path(__file__).parent
router = APIRouter(include_in_schema=False, route_class=OneSession)
# What whoever is not signed in yet may see
strangers = APIRouter(include_in_schema=False, route_class=OneSession)


def include(site: APIRouter) -> None:
    """Add the pages and their files to the routes of the service."""
    site.include_router(strangers)
    for part in (
        router,
        parts.router,
        photo_pages.router,
        batch.router,
        lens_pages.router,
        pictures.router,
    ):
        site.include_router(part, dependencies=[Depends(call_of)])
    site.mount("/static", StaticFiles(directory=HERE / "static"), name="static")


def install(app: FastAPI) -> None:
    """Let browsers have errors as pages."""
    for kind in (LensModelError, HTTPException, RequestValidationError, Exception):
        app.add_exception_handler(kind, _for_people(app.exception_handlers[kind]))


Handler: TypeAlias = Callable[[Request, Any], Any]


def _for_people(answer: Handler) -> Handler:
    """Turn the response of an exception handler into a page where a browser requested one.

    An open page whose session has ended goes to the sign-in; one whose subject is gone, to the first page.
    """

    async def handle(request: Request, error: Exception) -> Response:
        waited = answer(request, error)
        plain: Response = await waited if isinstance(waited, Awaitable) else waited
        if plain.status_code in {401, 404} and "hx-request" in request.headers:
            shown = quote(request.headers.get("hx-current-url", "/"), safe="/")
            plain.headers["HX-Redirect"] = f"/sign-in?next={shown}" if plain.status_code == 401 else "/"
        if plain.status_code == 401 and _wants_page(request):
            path = quote(request.url.path, safe="/")
            return RedirectResponse(f"/sign-in?next={path}", 303)
        if plain.status_code < 400 or not _wants_page(request):
            return plain
        title, detail = words.refusal(plain.status_code, str(error))
        return page("missing.html", plain.status_code, title=title, detail=detail)

    return handle


def _wants_page(request: Request) -> bool:
    wanted = "text/html" in request.headers.get("accept", "")
    return (
        request.method == "GET" and wanted and not request.url.path.startswith(("/v1/", "/ui/", "/static/"))
    )


@router.get("/")
def home(call: CallDep) -> HTMLResponse:
    """Show where photos are given and what became of them."""
    return page("home.html", **parts.home(call)[1])


@router.get("/docs")
def interface(request: Request) -> HTMLResponse:
    """Show what programs can ask, from the same description that programs read; nothing is loaded for it."""
    paths = request.app.openapi()["paths"]
    operations = [
        {"path": path, "method": method, **entry}
        for path, methods in paths.items()
        for method, entry in methods.items()
    ]
    return page("docs.html", operations=operations)


@strangers.get("/sign-in")
async def sign_in() -> HTMLResponse:
    """Ask for a key."""
    return page("sign_in.html")
