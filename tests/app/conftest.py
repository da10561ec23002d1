"""A service on an empty database, and photos in it as far as a test needs them."""

from __future__ import annotations

import itertools
import shutil
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import uploads
from starlette.testclient import TestClient

from app.blobs.storage import Storage
from app.runtime.settings import Settings
from app.sandbox.child import Outcome
from app.sandbox.runner import Budget
from app.store import LensName, Store
from app.store.database import new_id, upgrade
from app.store.lenses import LensState
from app.store.owners import ANY_OWNER
from app.store.tables import PROFILE_FILE, CorrectionRow, LensRow, PhotoRow
from lab.kernels import gaussian
from lensmodel.core.errors import LensModelError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings, ignore_step

BODY = {"width": 6000, "height": 4000, "pixel_pitch_um": 6.0}
PLACES = [(0.05, 0.0), (0.3, 0.6), (0.5, 2.2), (0.6, -2.2), (0.8, -0.6), (0.9, 0.59)]


class Steps:
    """Does to the tables what uploads and workers do, step by step."""

    def __init__(self, store: Store, owner: str = "local") -> None:
        self.store, self.owner = store, owner
        self._numbers = itertools.count(1)

    def receive(
        self, *, sha256: str = "", filename: str = "", calibrate: bool = True, **given: Any
    ) -> PhotoRow:
        number, public_id = next(self._numbers), new_id()
        self.store.photos.expect(f"photos/{public_id}/", within=timedelta(minutes=1))
        names = {"sha256": sha256 or f"{number:064x}", "filename": filename or f"p{number}.dng"}
        options = {"owner": self.owner, "byte_size": 1000, "calibrate": calibrate, "given": given}
        return uploads.receive(self.store, public_id, **names, **options).photo

    def receive_again(self, photo: PhotoRow, **given: Any) -> PhotoRow:
        return self.receive(sha256=photo.sha256, filename=photo.filename, calibrate=photo.calibrate, **given)

    def named(self, name: LensName) -> str:
        """Give a lens to a photo that waits for one; return its id."""
        photo = self.receive()
        assert self.store.photos.change([photo.public_id], self.owner, {}, lens=name)
        return self.fresh(photo).given["lens_id"]

    def waiting(self, *, serial: str | None = None, aperture: float | None = 1.4) -> PhotoRow:
        """Let a photo wait for its owner, who has to say what its file does not."""
        photo = self.receive()
        self.inspect(photo, serial=serial, aperture=aperture)
        self.store.photos.set_state(photo.public_id, ("inspecting",), "needs_lens")
        return photo

    def inspect(
        self,
        photo: PhotoRow,
        *,
        serial: str | None = "123",
        aperture: float | None = 1.4,
        body: Mapping[str, Any] = BODY,
    ) -> None:
        self.store.photos.set_state(photo.public_id, ("received",), "inspecting")
        name = LensName("Canon", "EF24mm f/1.4L", serial, "exif" if serial else "none")
        header = {"aperture": aperture, "focal_mm": 24.0, "focus_m": None}
        self.store.photos.record_inspection(photo.public_id, name, **header, **body)

    def plan(self, photo: PhotoRow, count: int = 2) -> None:
        self.store.photos.set_state(photo.public_id, ("inspecting",), "selecting")
        places = enumerate(itertools.islice(itertools.cycle(PLACES), count))
        chosen = {"row": 100, "size": 64, "score": 1.0}
        patches = [{**chosen, "col": 100 * k, "r": r, "phi": phi, "cell": k % 2} for k, (r, phi) in places]
        rejected = [{"row": 0, "col": 0, "size": 64, "r": 0, "phi": 0, "reason": "flat"}]
        self.store.photos.plan_patches(photo.public_id, photo.epoch, patches, rejected)
        self.store.photos.set_state(photo.public_id, ("selecting",), "estimating")

    def planned(self, count: int = 2, *, filename: str = "", **header: Any) -> PhotoRow:
        """Bring a photo so far that its patches can be estimated."""
        photo = self.receive(filename=filename)
        self.inspect(photo, **header)
        self.plan(photo, count)
        return photo

    def estimate(
        self, photo: PhotoRow, indices: Sequence[int] = (0, 1), *, width: float = 1.0, size: int = 15
    ) -> int:
        kernel = gaussian(size, width * np.eye(2))
        samples = [
            (k, PsfSample(kernel, place, LensSettings(channel=channel), weight=0.5, estimator="default/1"))
            for k in indices
            for place in [FieldPosition(*PLACES[k % len(PLACES)])]
            for channel in CHANNELS
        ]
        return self.store.photos.add_samples(photo.public_id, photo.epoch, samples)

    def counted(self, *, patches: int = 2, width: float = 1.0, size: int = 15, **header: Any) -> PhotoRow:
        photo = self.planned(patches, **header)
        self.estimate(photo, range(patches), width=width, size=size)
        assert self.store.photos.finish(photo.public_id, photo.epoch) is not None
        return self.fresh(photo)

    def correct(self, photo: PhotoRow, **params: Any) -> CorrectionRow:
        return self.store.jobs.correct(photo, photo.lens, 1, params)[0]

    def fresh(self, photo: PhotoRow) -> PhotoRow:
        found = self.store.photos.get(photo.public_id, ANY_OWNER)
        assert found is not None
        return found

    def lens(self, photo: PhotoRow) -> LensRow:
        lens = self.fresh(photo).lens
        assert lens is not None
        return lens

    def lens_id(self, photo: PhotoRow) -> str:
        return self.lens(photo).public_id

    def learned(self, photo: PhotoRow) -> tuple[LensState, list[PsfSample]]:
        """Return the state of the lens of a photo and all its samples."""
        return self.store.lenses.samples_of(self.lens_id(photo))


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(
        data_dir=tmp_path / "data",
        min_free_mb=0,
        task_user="none",  # trying others out takes a process for each folder
        task_niceness=0,  # tests wait for photos too: beside other programs they would starve
        max_upload_mb=1,
        patches=3,  # of so few one is enough: the made-up photos of these tests have two
    )


@pytest.fixture(scope="session")
def empty_database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Migrate once: the tests copy the file."""
    folder = tmp_path_factory.mktemp("empty")
    with closing(Store(Settings(data_dir=folder))) as opened:
        upgrade(opened.database)
    return folder / "app.db"


@pytest.fixture
def store(settings: Settings, empty_database: Path) -> Iterator[Store]:
    settings.data_dir.mkdir(parents=True)
    shutil.copy(empty_database, settings.data_dir / "app.db")
    with closing(Store(settings)) as opened:
        # before rows that name files which are not there
        Storage(settings.storage, create=False).settle(opened.photos.have_files)
        yield opened


@pytest.fixture
def storage(settings: Settings, store: Store) -> Storage:
    return Storage(settings.storage)


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
def reading(settings: Settings, store: Store, storage: Storage) -> Iterator[None]:
    """Read the profiles that are sent meanwhile, as a worker does."""
    from app.jobs.context import JobContext  # noqa: PLC0415 - as above
    from app.jobs.queue import durable, end_job  # noqa: PLC0415 - as above
    from app.jobs.work import work_on  # noqa: PLC0415 - as above

    sandbox: Any = TasksHere(settings.data_dir / "scratch")
    context = JobContext(settings, store, storage, sandbox)
    work = durable("photo", partial(work_on, context), partial(end_job, store))
    ended = threading.Event()

    def read() -> None:
        while not ended.wait(0.02):
            for job in store.jobs.to_do():
                row = store.photos.get(job.arguments[0], ANY_OWNER)
                if row is not None and row.kind == PROFILE_FILE:  # photos are the test's own
                    work(*job.arguments)

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
