"""What routes need, handed to them: the parts of the application and who is asking."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Request, Response

from app.drawn import Drawn
from app.models import ModelCache
from app.reserve import Reserve
from app.settings import Settings
from app.storage import Storage
from app.store import Store
from app.store.owners import LOCAL
from app.watch import Watch


@dataclass(frozen=True, slots=True)
class Services:
    """Everything that one application is made of."""

    settings: Settings
    store: Store
    storage: Storage
    models: ModelCache
    uploads: Places
    reserve: Reserve
    pictures: Drawn
    watch: Watch


class Places:
    """How many of something there may be at once, counted in the event loop."""

    def __init__(self, free: int) -> None:
        self.free = free

    @contextmanager
    def one(self, refusal: Exception) -> Iterator[None]:
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
    """One request: what serves it, who asks, and the head of its answer."""

    request: Request
    response: Response
    services: Services
    owner: str

    @property
    def settings(self) -> Settings:
        """What is configured."""
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


async def call_of(request: Request, response: Response) -> Call:
    """Put together what a route needs. With `auth=none` everybody is the same owner."""
    # async: a plain function would cost each request a trip to a thread
    return Call(request, response, request.app.state.services, LOCAL)


CallDep = Annotated[Call, Depends(call_of)]
