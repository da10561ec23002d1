"""A photo is developed with others of its body, which show its hot pixels: as at the terminal."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
from conftest import TasksHere
from running import scene
from uploads import receive

from app.blobs.storage import Storage
from app.jobs.context import JobContext
from app.jobs.work import inspect
from app.runtime.settings import Settings
from app.store import Store
from app.store.owners import ANY_OWNER
from lensmodel import photo
from lensmodel.blind import sampling
from lensmodel.photo.dng import write_bayer_dng
from lensmodel.photo.values import PhotoMetadata

HOT = 60


def write(path: Path, seed: int, body: str = "B-1") -> Path:
    """Write a photo of a sensor with hot pixels, some of which one photo alone cannot tell from the scene."""
    rng = np.random.default_rng(seed)
    mosaic = 512.0 + rng.poisson(scene(seed) * 20000.0) * 0.6
    hot = np.random.default_rng(7)
    mosaic.flat[hot.choice(mosaic.size, HOT, replace=False)] += hot.uniform(400.0, 4000.0, HOT)
    metadata = PhotoMetadata(camera_maker="Test", camera_model="T-1", body_serial=body)
    write_bayer_dng(path, mosaic.round().astype(np.uint16), black=512, white=16383, metadata=metadata)
    return path


def test_a_photo_is_developed_with_others_of_its_owner_and_body(
    settings: Settings, store: Store, tmp_path: Path
) -> None:
    sandbox: Any = TasksHere(tmp_path / "scratch")
    context = JobContext(settings, store, Storage(settings.storage), sandbox)
    paths = [write(tmp_path / f"{seed}.dng", seed) for seed in range(4)]
    foreign, other_body = write(tmp_path / "foreign.dng", 4), write(tmp_path / "other.dng", 5, "B-2")

    def stored(path: Path, owner: str = "local") -> Any:
        store.photos.expect(f"photos/{path.stem}/", within=timedelta(minutes=1))
        row = receive(store, path.stem, owner=owner, kind="dng", sha256=path.stem).photo
        context.storage.put(row.blob_key, path.read_bytes())
        inspect(context, row)
        return store.photos.get(row.public_id, ANY_OWNER)

    first, *_ = [stored(path) for path in (*paths, other_body)]
    stored(foreign, "somebody")

    developed = sampling.load_developed(context.developed(first, wanted=lambda: True))

    alone, together = photo.develop(paths[0]), photo.develop(paths[0], siblings=paths[:0:-1])
    assert np.array_equal(developed.planes, together.planes)
    assert not np.array_equal(developed.planes, alone.planes)
