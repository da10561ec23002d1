"""The application: `create_app(settings)` and its lifespan."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import cache
from importlib.metadata import version

from fastapi import APIRouter, Depends, FastAPI, Security
from fastapi.routing import APIRoute
from starlette.routing import BaseRoute

from app import pages
from app.access import Gate
from app.blobs.storage import Storage
from app.http import errors
from app.http.dependencies import BEARER, Fresh, Services, call_of
from app.http.middleware import Guard
from app.http.model_cache import ModelCache
from app.routes import account, corrections, health, jobs, lenses, photos, psf
from app.routes.common import PROBLEMS
from app.runtime.outage import missable
from app.runtime.settings import Settings
from app.schemas import Readiness
from app.store import Store


def create_app(settings: Settings | None = None) -> FastAPI:
    """Build the application; the database is opened when it starts and closed when it stops."""
    # The schema is not changed here: `app.runtime.supervisor` migrates before it starts the API, and until
    # then `/readyz` says what is missing
    chosen = Settings() if settings is None else settings

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        store = Store(chosen)
        storage = Storage(chosen.storage, patience_s=chosen.storage_seconds, create=False)
        with missable():  # /readyz tries again
            storage.settle(store.photos.have_files)
        uploads, gate = asyncio.Semaphore(photos.MAX_UPLOADS), Gate(chosen, store.accounts)
        cache, readiness = ModelCache(store), Fresh[Readiness](health.FRESH_S)
        app.state.services = Services(chosen, store, storage, cache, uploads, gate, readiness)
        yield
        store.close()

    app = FastAPI(
        title="lensmodel",
        version=version("lensmodel"),
        summary="Learns the blur of one copy of a lens from ordinary photos and removes it.",
        lifespan=lifespan,
        docs_url=None,  # it would load scripts from another site: the pages have their own
        redoc_url=None,
    )
    app.add_middleware(Guard, allowed=chosen.hosts, max_upload_mb=chosen.max_upload_mb)
    for kind in errors.KINDS:
        app.add_exception_handler(kind, pages.refusal)
    app.router.routes.extend(_routes())
    return app


def _operation(route: APIRoute) -> str:
    """Name an operation by its function: `getPhoto` for `get_photo`."""
    first, *more = route.name.split("_")
    return first + "".join(map(str.capitalize, more))


@cache
def _routes() -> tuple[BaseRoute, ...]:
    """All routes, the same for each application of a process."""
    # What FastAPI works out of a route, at the first request, it keeps with the route: it takes longer than
    # most requests, and need not be done again for an application with other settings
    router = APIRouter(generate_unique_id_function=_operation)
    router.include_router(health.probes)
    router.include_router(account.sign_ins, prefix="/v1", responses=PROBLEMS)
    # also here, not only in each route: a route without it would be open to all
    known = [Depends(call_of), Security(BEARER)]
    # PSFs first: routes are tried in their order, and these are asked for most often
    for resource in (psf, photos, jobs, lenses, corrections, account, health):
        router.include_router(resource.router, prefix="/v1", dependencies=known, responses=PROBLEMS)
    pages.include(router)
    return tuple(router.routes)
