"""A service on an empty database, and photos in it as far as a test needs them."""

from __future__ import annotations

import itertools
import os
import shutil
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import Engine, MetaData, create_engine
from starlette.testclient import TestClient

from app.blobs.storage import Storage
from app.runtime.settings import Settings
from app.sandbox.child import Outcome
from app.sandbox.runner import Budget
from app.store import LensName, Store, database
from app.store.database import Database, new_id, upgrade
from app.store.owners import ANY_OWNER
from app.store.tables import PROFILE_FILE, CorrectionRow, PhotoRow
from lab.kernels import gaussian
from lensmodel.core.errors import LensModelError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings, ignore_step

PLACES = [(0.05, 0.0), (0.3, 0.6), (0.5, 2.2), (0.6, -2.2), (0.8, -0.6), (0.9, 0.59)]


def window(r: float, phi: float, **more: Any) -> dict[str, Any]:
    """Return a window of a photo as a task tells of it."""
    return {"row": 0, "col": 0, "size": 64, "r": r, "phi": phi, **more}


class Steps:
    """Does to the tables what uploads and workers do, step by step."""

    def __init__(self, store: Store, owner: str = "local") -> None:
        self.store, self.owner = store, owner
        self._numbers = itertools.count(1)

    def receive(self, *, calibrate: bool = True, filename: str = "", **given: Any) -> PhotoRow:
        return self._receive(f"{next(self._numbers):064x}", filename, calibrate=calibrate, given=given)

    def receive_again(self, photo: PhotoRow, **given: Any) -> PhotoRow:
        return self._receive(photo.sha256, photo.filename, calibrate=photo.calibrate, given=given)

    def _receive(self, sha256: str, filename: str, *, calibrate: bool, given: dict[str, Any]) -> PhotoRow:
        public_id = new_id()
        self.store.photos.expect(f"photos/{public_id}/", within=timedelta(minutes=1))
        return self.store.photos.receive(
            self.owner,
            public_id=public_id,
            sha256=sha256,
            filename=filename or f"p{int(sha256, 16)}.dng",
            kind="dng",
            byte_size=1000,
            blob_key=f"photos/{public_id}/original",
            calibrate=calibrate,
            given=given,
        ).photo

    def named(self, name: LensName) -> str:
        """Give a lens to a photo that waits for one; return its id."""
        photo = self.receive()
        assert self.store.photos.change([photo.public_id], self.owner, {}, lens=name)
        lens_id: str = self.fresh(photo).given["lens_id"]
        return lens_id

    def inspect(self, photo: PhotoRow, *, serial: str | None = "123", aperture: float | None = 1.4) -> None:
        self.store.photos.set_state(photo.public_id, ("received",), "inspecting")
        self.store.photos.record_inspection(
            photo.public_id,
            LensName("Canon", "EF24mm f/1.4L", serial, "exif" if serial else "none"),
            width=6000,
            height=4000,
            aperture=aperture,
            focal_mm=24.0,
            focus_m=None,
            pixel_pitch_um=6.0,
        )

    def plan(self, photo: PhotoRow, count: int = 2) -> None:
        self.store.photos.set_state(photo.public_id, ("inspecting",), "selecting")
        places = enumerate(itertools.islice(itertools.cycle(PLACES), count))
        patches = [window(r, phi, row=100, col=100 * k, cell=k % 2, score=1.0) for k, (r, phi) in places]
        self.store.photos.plan_patches(photo.public_id, photo.epoch, patches, [window(0, 0, reason="flat")])
        self.store.photos.set_state(photo.public_id, ("selecting",), "estimating")

    def estimate(self, photo: PhotoRow, indices: tuple[int, ...] = (0, 1), *, width: float = 1.0) -> int:
        kernel = gaussian(15, width * np.eye(2))
        samples = [
            (k, PsfSample(kernel, place, LensSettings(channel=channel), weight=0.5, estimator="default/1"))
            for k in indices
            for place in [FieldPosition(*PLACES[k % len(PLACES)])]
            for channel in CHANNELS
        ]
        return self.store.photos.add_samples(photo.public_id, photo.epoch, samples)

    def counted(
        self, *, patches: int = 2, width: float = 1.0, filename: str = "", **options: Any
    ) -> PhotoRow:
        photo = self.receive(filename=filename)
        self.inspect(photo, **options)
        self.plan(photo, patches)
        self.estimate(photo, tuple(range(patches)), width=width)
        assert self.store.photos.finish(photo.public_id, photo.epoch) is not None
        return self.fresh(photo)

    def correct(self, photo: PhotoRow, **params: Any) -> CorrectionRow:
        assert photo.lens is not None
        return self.store.jobs.correct(photo, photo.lens, 1, params)[0]

    def fresh(self, photo: PhotoRow) -> PhotoRow:
        found = self.store.photos.get(photo.public_id, ANY_OWNER)
        assert found is not None
        return found

    def lens_id(self, photo: PhotoRow) -> str:
        lens = self.fresh(photo).lens
        assert lens is not None
        return lens.public_id


SERVER = os.environ.get("LENSMODEL_TEST_DATABASE", "")
"""A PostgreSQL database to empty and to run the tests on, instead of SQLite files."""


@pytest.fixture(scope="session")
def usual_settings() -> Settings:
    """Read and check the environment once: for each test anew it takes as long as a small test."""
    return Settings(
        database_url=SERVER,
        storage_url="file:///the-folder-of-each-test" if SERVER else "",
        min_free_mb=0,
        task_user="none",  # trying others out takes a process for each folder
        task_niceness=0,  # tests wait for photos too: beside other programs they would starve
        max_upload_mb=1,
        patches=3,  # of so few one is enough: the made-up photos of these tests have two
    )


@pytest.fixture
def settings(usual_settings: Settings, tmp_path: Path) -> Settings:
    data = tmp_path / "data"
    own = {"storage_url": f"file://{data / 'blobs'}"} if SERVER else {}
    return usual_settings.model_copy(update={"data_dir": data, **own})


@pytest.fixture(scope="session", autouse=True)
def statements_compiled_once() -> Iterator[None]:
    """Let all engines of SQLite share what they make of statements.

    Each test opens six of them, three of its own and three of its application; each would compile every
    statement anew, which takes longer than the test.
    """
    first = create_engine("sqlite://", query_cache_size=5000)
    first.connect().close()  # now its dialect knows the version

    def sharing(url: Any, **options: Any) -> Engine:
        engine = create_engine(url, **options)
        if engine.dialect.name == first.dialect.name:
            engine.dialect, engine._compiled_cache = first.dialect, first._compiled_cache
        return engine

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(database, "create_engine", sharing)
        yield


@pytest.fixture(scope="session")
def empty_database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Migrate once: the tests copy the file."""
    folder = tmp_path_factory.mktemp("empty")
    opened = Store(Settings(data_dir=folder))
    upgrade(opened.database)
    opened.close()
    return folder / "app.db"


def emptied_of_tables(opened: Database) -> Database:
    """Drop all tables that are there."""
    there = MetaData()
    there.reflect(opened.writer)
    there.drop_all(opened.writer)
    return opened


@pytest.fixture
def store(settings: Settings, empty_database: Path) -> Iterator[Store]:
    settings.data_dir.mkdir(parents=True)
    if SERVER:
        emptied = emptied_of_tables(Database(SERVER))
        upgrade(emptied)
        emptied.close()
    else:
        shutil.copy(empty_database, settings.data_dir / "app.db")
    opened = Store(settings)
    # before rows that name files which are not there
    Storage(settings.storage, create=False).settle(opened.photos.have_files)
    yield opened
    opened.close()


@pytest.fixture
def steps(store: Store) -> Steps:
    return Steps(store)


class TasksHere:
    """A sandbox without children: runs tasks in this process."""

    account = None

    def __init__(self, scratch: Path) -> None:
        self.scratch, self.budget = scratch, Budget(1, 4096)

    @contextmanager
    def folder(self) -> Iterator[Path]:
        self.scratch.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self.scratch) as path:
            yield Path(path)

    def run(self, task: str, arguments: Any, *, folder: Path, **_: Any) -> Outcome:
        from app.jobs.tasks import TASKS  # noqa: PLC0415 - slow to import, and few tests need it

        try:
            return Outcome("ok", value=TASKS[task](dict(arguments), folder, ignore_step))
        except LensModelError as error:
            return Outcome("error", code=error.code, detail=str(error))


@pytest.fixture
def reading(settings: Settings, store: Store) -> Iterator[None]:
    """Read the profiles that are sent meanwhile, as a worker does."""
    from app.jobs.context import JobContext  # noqa: PLC0415 - as above
    from app.jobs.queue import durable, end_job  # noqa: PLC0415 - as above
    from app.jobs.work import work_on  # noqa: PLC0415 - as above

    sandbox: Any = TasksHere(settings.data_dir / "scratch")
    context = JobContext(settings, store, Storage(settings.storage, create=False), sandbox)
    work = durable("photo", partial(work_on, context), partial(end_job, store))
    ended = threading.Event()

    def read() -> None:
        while not ended.wait(0.02):
            for job in store.jobs.to_do():
                photo_id, epoch = str(job.arguments[0]), int(job.arguments[1])
                row = store.photos.get(photo_id, ANY_OWNER)
                if row is not None and row.kind == PROFILE_FILE:  # photos are the test's own
                    work(photo_id, epoch)

    thread = threading.Thread(target=read)
    thread.start()
    yield
    ended.set()
    thread.join()


@pytest.fixture
def client(settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch) -> Iterator[TestClient]:
    """Speak HTTP with the service; `store` and `steps` see the same database."""
    from app.main import create_app  # noqa: PLC0415 - most tests of the store need no application

    monkeypatch.setattr("app.routes.jobs.LONG_POLL_S", 2.0)
    with TestClient(create_app(settings), raise_server_exceptions=False) as opened:
        yield opened
