"""Dependencies of the routes: the parts of the application, and who is asking."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from inspect import iscoroutinefunction
from operator import attrgetter
from typing import Annotated, Any, Generic, TypeVar
from urllib.parse import urlencode

from fastapi import Depends, Request, Response
from fastapi.routing import APIRoute
from fastapi.security import HTTPBearer
from starlette.concurrency import run_in_threadpool

from app.access import Gate, Who
from app.blobs.storage import Storage
from app.errors import UnknownError
from app.http.model_cache import ModelCache
from app.runtime.settings import Settings
from app.schemas import Model, Page, Readiness
from app.store import Store
from app.store.tables import CorrectionRow, LensRow, PhotoRow

T = TypeVar("T")
M = TypeVar("M", bound=Model)


def found(what: str, key: str, row: T | None) -> T:
    """Return what was looked up of the owner; refuse what is not there, or somebody else's."""
    if row is None:
        raise UnknownError(what, key)
    return row


@dataclass(frozen=True)
class Services:
    """The parts of one application."""

    settings: Settings
    store: Store
    storage: Storage
    models: ModelCache
    uploads: asyncio.Semaphore
    gate: Gate
    readiness: Fresh[Readiness]


class Fresh(Generic[T]):
    """A value that is made anew after some seconds, once for all who ask at the same time."""

    def __init__(self, seconds: float) -> None:
        self._seconds, self._until = seconds, -math.inf
        self._value: T | None = None
        self._guard = threading.Lock()

    def get(self, make: Callable[[], T]) -> T:
        """Return the value; make it where it is missing or too old."""
        with self._guard:
            if self._value is None or time.monotonic() > self._until:
                self._value = make()
                self._until = time.monotonic() + self._seconds
            return self._value


@dataclass(frozen=True)
class Call(Services):
    """One request: the services, who asks, and the head of the response."""

    request: Request
    response: Response
    who: Who

    @property
    def owner(self) -> str:
        """Owner of the data that the request concerns."""
        return self.who.owner

    def photo(self, photo_id: str) -> PhotoRow:
        """Return a photo of the owner."""
        return found("photo", photo_id, self.store.photos.get(photo_id, self.owner))

    def lens(self, lens_id: str) -> LensRow:
        """Return a lens of the owner."""
        return found("lens", lens_id, self.store.lenses.get(lens_id, self.owner))

    def correction(self, correction_id: str) -> CorrectionRow:
        """Return a correction of the owner with its photo and lens."""
        return found("correction", correction_id, self.store.jobs.get(correction_id, self.owner))

    def knows(self, tag: str) -> bool:
        """Say whether the request already has the answer of this tag (RFC 9110, 13.1.2)."""
        sent = self.request.headers.get("if-none-match", "")
        return sent.strip() == "*" or tag in {entry.strip().removeprefix("W/") for entry in sent.split(",")}

    def page(
        self,
        rows: Sequence[T],
        limit: int,
        make: Callable[[T], M],
        cursor: Callable[[T], str] = attrgetter("public_id"),
    ) -> Page[M]:
        """Return a page of what one row more was read of, with the address of the next one."""
        items, following = [make(row) for row in rows[:limit]], None
        if len(rows) > limit:
            query = {**self.request.query_params, "cursor": cursor(rows[limit - 1])}
            following = f"{self.request.url.path}?{urlencode(query)}"
            self.response.headers["Link"] = f'<{following}>; rel="next"'
        return Page(items=items, next=following)

    @classmethod
    def of(cls, request: Request, response: Response, who: Who) -> Call:
        """Return a request to the application that it came to."""
        services: Services = request.app.state.services
        return cls(**vars(services), request=request, response=response, who=who)


BEARER = HTTPBearer(auto_error=False, description="A key that `lensmodel keys create` made.")
NOBODY = Who("", ())


async def call_of(request: Request, response: Response) -> Call:
    """Return the `Call` of a route, after checking who asks."""
    services: Services = request.app.state.services
    # async: a plain function would run in a thread for each request, which only unknown keys need
    who = services.gate.quick(request)
    if who is None:
        who = await run_in_threadpool(services.gate.who, request)
    services.gate.require(who, "read" if request.method in {"GET", "HEAD", "OPTIONS"} else "write")
    return Call.of(request, response, who)


async def probe_of(request: Request, response: Response) -> Call:
    """Return the `Call` of a probe, which anybody may ask: it has no owner."""
    return Call.of(request, response, NOBODY)


ProbeDep = Annotated[Call, Depends(probe_of)]
CallDep = Annotated[Call, Depends(call_of)]


class OneSession(APIRoute):
    """A route whose reads are all of one session of the database, and so of one moment."""

    # Not those of routes that wait: between two looks others must be able to change what they look at

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return what answers a request, in a session that ends before the answer is sent."""
        answer = super().get_route_handler()
        if iscoroutinefunction(self.endpoint):
            return answer

        async def in_session(request: Request) -> Response:
            services: Services = request.app.state.services
            with services.store.database.scope():
                return await answer(request)

        return in_session
