"""Dependencies of the routes: the parts of the application, and who is asking."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from inspect import iscoroutinefunction
from typing import Annotated, Any, Generic, TypeVar

from fastapi import Depends, Request, Response, Security
from fastapi.routing import APIRoute
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.concurrency import run_in_threadpool

from app.access import Gate, Who
from app.blobs.storage import Storage
from app.http.model_cache import ModelCache
from app.runtime.settings import Settings
from app.schemas import Readiness
from app.store import Store

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Services:
    """The parts of one application."""

    settings: Settings
    store: Store
    storage: Storage
    models: ModelCache
    uploads: Places
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


class Places:
    """A limit on how many of something run at once, counted in the event loop."""

    def __init__(self, free: int) -> None:
        self.free = free

    @contextmanager
    def take(self, refusal: Exception) -> Iterator[None]:
        """Take a place; raise the refusal where none is free."""
        if self.free <= 0:
            raise refusal
        self.free -= 1
        try:
            yield
        finally:
            self.free += 1


@dataclass(frozen=True, slots=True)
class Call:
    """One request: the services, who asks, and the head of the response."""

    request: Request
    response: Response
    services: Services
    who: Who

    @property
    def owner(self) -> str:
        """Owner of the data that the request concerns."""
        return self.who.owner

    @property
    def settings(self) -> Settings:
        """The settings."""
        return self.services.settings

    @property
    def store(self) -> Store:
        """The tables."""
        return self.services.store

    @property
    def storage(self) -> Storage:
        """The blobs."""
        return self.services.storage

    @property
    def models(self) -> ModelCache:
        """The fitted models."""
        return self.services.models


BEARER = HTTPBearer(auto_error=False, description="A key that `lensmodel keys create` made.")
"""For the OpenAPI description only; `Gate` identifies who asks."""

NOBODY = Who("", ())


async def call_of(
    request: Request,
    response: Response,
    described: Annotated[HTTPAuthorizationCredentials | None, Security(BEARER)] = None,
) -> Call:
    """Return the `Call` of a route, after checking who asks."""
    del described
    services: Services = request.app.state.services
    # async: a plain function would run in a thread for each request, which only unknown keys need
    who = services.gate.quick(request)
    if who is None:
        who = await run_in_threadpool(services.gate.who, request)
    services.gate.admit(who, request.method)
    return Call(request, response, services, who)


async def probe_of(request: Request, response: Response) -> Call:
    """Return the `Call` of a probe, which anybody may ask: it has no owner."""
    return Call(request, response, request.app.state.services, NOBODY)


ProbeDep = Annotated[Call, Depends(probe_of)]
CallDep = Annotated[Call, Depends(call_of)]


class OneSession(APIRoute):
    """A route whose reads are all of one session of the database, and so of one moment.

    Not those of routes that wait: between two looks others must be able to change what they look at.
    """

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
