"""Data of the pages and their streams, by the same routes as the API."""

from __future__ import annotations

from typing import Final

from app.http.dependencies import Call
from app.pages.groups import WaitingGroup, grouped
from app.routes import lenses as lens_routes
from app.routes import photos as photo_routes
from app.schemas import LensOut, PhotoOut

PHOTOS: Final = 60
"""Photos and lenses of a list (chosen): the newest of them."""

HOPELESS: Final = frozenset({"failed", "cancelled"})
"""States of photos without a result."""

MAX_WAITING: Final = 1000
"""Waiting photos on the page at most: as many as one request can change."""


def photos(call: Call, lens_id: str | None = None) -> tuple[list[PhotoOut], bool]:
    """Return the newest photos, of one lens or of all, and whether there are more."""
    page = photo_routes.list_photos(call, limit=PHOTOS, lens_id=lens_id)
    return page.items, page.next is not None


def lenses(call: Call) -> list[LensOut]:
    """Return the newest lenses."""
    return lens_routes.list_lenses(call, limit=PHOTOS).items


def lenses_with_photos(call: Call) -> list[LensOut]:
    """Return the newest lenses, except those without samples whose photos all failed or were cancelled."""
    listed = lenses(call)
    hopeful = call.store.lenses.with_photos_beyond(HOPELESS, [lens.id for lens in listed if not lens.samples])
    return [lens for lens in listed if lens.samples or lens.id in hopeful]


def counting(call: Call, lens_id: str) -> bool:
    """Whether a worker has yet to measure the newest version of a lens."""
    lens = lens_routes.find_lens(call, lens_id)
    newest = call.store.lenses.history(lens, after=lens.version - 1)
    return lens.sample_count > 0 and any(event.metrics is None for event in newest)


def anew(call: Call, lens_id: str) -> int:
    """How many photos of a lens that changes its model are still to be measured."""
    return call.store.lenses.learned_anew(lens_routes.find_lens(call, lens_id))


def waiting(call: Call) -> list[WaitingGroup]:
    """Group the photos that wait for their owner to say which lens it was."""
    rows = call.store.photos.page(call.owner, before=None, limit=MAX_WAITING, state="needs_lens")
    return grouped([row for row in rows if row.lens_id is None])
