"""The application: `create_app(settings)` and its lifespan."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version

from fastapi import FastAPI

from app import errors, pages
from app.bodies import JsonBodies
from app.dependencies import Places, Services
from app.drawn import Drawn
from app.middleware import Heads, OwnNames, RequestLog, SameSite
from app.models import ModelCache
from app.reserve import Reserve
from app.routes import corrections, health, jobs, lenses, photos, psf
from app.settings import MIB, Settings
from app.storage import Storage
from app.store import Store
from app.store.jobs import JobStore
from app.watch import Watch
from lensmodel.regression import ModelSettings


def create_app(settings: Settings | None = None) -> FastAPI:
    """Build the application; the database is opened when it starts and closed when it stops.

    The schema is not changed here: the supervisor migrates before it starts the API, and until
    then `/readyz` says what is missing.
    """
    chosen = Settings() if settings is None else settings

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        store = Store(chosen)
        storage = Storage(chosen.storage, patience_s=chosen.storage_seconds)
        cache = ModelCache(
            store,
            chosen.model_cache_mb * MIB,
            storage,
            family=chosen.family,
            settings=ModelSettings(mode=chosen.model_mode, unit=chosen.model_unit),
        )
        reserve = Reserve(store.database.path.with_name("reserve") if store.database.is_sqlite else None)
        watch = Watch(JobStore(store.database).marks)
        app.state.services = Services(
            chosen, store, storage, cache, Places(chosen.max_uploads), reserve, Drawn(), watch
        )
        yield
        watch.stop()
        store.close()

    app = FastAPI(
        title="lensmodel",
        version=version("lensmodel"),
        summary="Learns the blur of one copy of a lens from ordinary photos and removes it.",
        lifespan=lifespan,
        docs_url=None,  # it would load scripts from elsewhere: the pages have their own
        redoc_url=None,
    )
    app.add_middleware(Heads)
    app.add_middleware(JsonBodies, patience_s=chosen.stall_seconds)
    app.add_middleware(SameSite, allowed=chosen.hosts)
    app.add_middleware(OwnNames, allowed=chosen.hosts)
    app.add_middleware(RequestLog)  # the last is the outermost
    errors.install(app)
    pages.install(app)
    app.include_router(health.probes)
    for router in (photos.router, jobs.router, lenses.router, psf.router, corrections.router, health.router):
        app.include_router(router, prefix="/v1")
    return app
