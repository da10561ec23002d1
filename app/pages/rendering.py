"""Pages from templates, with what a browser must know of them."""

from __future__ import annotations

from typing import Any, Final

from fastapi.responses import HTMLResponse
from jinja2 import Environment, PackageLoader, select_autoescape

from app.pages import words
from lensmodel.photo.values import ENDINGS

HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; "
        "frame-ancestors 'none'; base-uri 'none'; form-action 'self'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}

templates = Environment(loader=PackageLoader("app.pages"), autoescape=select_autoescape(), trim_blocks=True)
templates.filters.update(words.FILTERS)
templates.globals["picker_endings"] = ",".join((*sorted(ENDINGS), "image/*"))


def page(name: str, status: int = 200, **values: Any) -> HTMLResponse:  # noqa: ANN401 - what the template shows
    """Return a page made from a template."""
    return HTMLResponse(fragment(name, **values), status, headers=HEADERS)


def fragment(name: str, **values: Any) -> str:  # noqa: ANN401 - what the template shows
    """Return the HTML of a template."""
    return templates.get_template(name).render(**values)
