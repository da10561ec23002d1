"""What the service makes of samples: pooled evidence, the likeliest mode, and pixels of several bodies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import event
from starlette.testclient import TestClient

from app.blobs.evidence import MODES, with_evidence
from app.blobs.storage import Storage
from app.http.model_cache import ModelCache
from app.jobs import tasks
from app.jobs.context import write_samples
from app.jobs.task_files import EVIDENCE, LEARNED
from app.main import create_app
from app.runtime.settings import Settings
from app.store import LensName, NewPatch, NewSample, Store
from app.store.versions import learned_key
from lensmodel.core.evidence import PatchEvidence
from lensmodel.core.psf import gaussian, rms_width
from lensmodel.core.spectrum import RINGS, SECTORS
from lensmodel.core.types import FieldPosition, LensSettings, ignore_step
from lensmodel.model import LensModel, ModelSettings
from lensmodel.model.answer import NEEDING_EVIDENCE

Steps = Any  # the fixture `steps` of conftest.py; test modules do not import each other
SIDE, SUPPORT = 64, 11
ASKED = {"r": 0.5, "phi": 0.4, "aperture": 1.4, "size": 15}
PLACE, SETTINGS = FieldPosition(0.5, 0.4), LensSettings(1.4)


def evidence(seed: int) -> PatchEvidence:
    """Of a patch whose scene is known, behind a blur of 1.3 px."""
    rng = np.random.default_rng(seed)
    scene = np.kron(rng.random((SIDE // 4, SIDE // 4)), np.ones((4, 4))) + 0.2 * rng.random((SIDE, SIDE))
    x = np.fft.fft2(scene - scene.mean())
    spread = np.zeros((SIDE, SIDE))
    spread[:SUPPORT, :SUPPORT] = gaussian(SUPPORT, 1.3**2 * np.eye(2))
    blur = np.fft.fft2(np.roll(spread, (-(SUPPORT // 2),) * 2, axis=(0, 1)))
    own = np.roll(np.fft.ifft2(np.abs(x) ** 2).real, (SUPPORT - 1,) * 2, axis=(0, 1))
    cross = np.roll(np.fft.ifft2(np.abs(x) ** 2 * blur).real, (SUPPORT // 2,) * 2, axis=(0, 1))
    return PatchEvidence(
        own[: 2 * SUPPORT - 1, : 2 * SUPPORT - 1].astype(np.float32),
        cross[:SUPPORT, :SUPPORT].astype(np.float32),
        SIDE * SIDE,
        0.01,
        np.ones((RINGS, SECTORS), dtype=np.float32),
        0.0,
    )


@pytest.fixture
def storage(settings: Settings) -> Storage:
    return Storage(settings.storage)


@pytest.fixture
def lens(steps: Steps, store: Store, storage: Storage) -> str:
    """Return the id of a lens with a photo of six green patches with evidence, their kernels too narrow."""
    photo = steps.receive()
    steps.inspect(photo)
    steps.plan(photo, 6)
    samples = []
    for k in range(6):
        key = f"photos/{photo.public_id}/statistics/e1/{k}-g.npz"
        storage.put(key, evidence(k).to_bytes())
        samples.append(
            NewSample(k, "g", gaussian(15, (1 + 0.01 * k) * np.eye(2)), 0.5, "default/1", statistics_key=key)
        )
    store.patches.finish(photo.public_id, photo.epoch, samples)
    assert store.photos.finish(photo.public_id, photo.epoch) is not None
    return str(steps.lens_id(photo))


def serve(settings: Settings, mode: str) -> TestClient:
    chosen = settings.model_copy(update={"model_mode": mode})
    return TestClient(create_app(chosen), raise_server_exceptions=False)


def psf(client: TestClient, lens_id: str, **more: float) -> dict[str, Any]:
    answer = client.get(f"/v1/lenses/{lens_id}/psf", params={**ASKED, **more})
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def width(answer: dict[str, Any]) -> float:
    return rms_width(np.array(answer["psf"]["data"]))


def test_worker_and_model_agree_on_what_needs_evidence() -> None:
    assert MODES == NEEDING_EVIDENCE


def test_pooled_evidence_answers_over_http(
    settings: Settings, store: Store, storage: Storage, lens: str
) -> None:
    with serve(settings, "kernels") as plain, serve(settings, "evidence") as pooling:
        averaged, pooled = psf(plain, lens), psf(pooling, lens)

    assert (averaged["support"]["mode"], pooled["support"]["mode"]) == ("kernels", "evidence")
    assert width(averaged) == pytest.approx(1.0, abs=0.05)
    assert width(pooled) > 1.2  # the patches know better than the kernels that came with them
    samples = with_evidence(store.samples.of_lens(lens)[1], storage, "evidence")
    model = LensModel.fit([one.sample for one in samples], ModelSettings(mode="evidence"))
    mine = model.query(PLACE, SETTINGS, 15).kernel
    assert np.abs(np.array(pooled["psf"]["data"]) - mine).max() < 1e-6


def test_photo_that_joins_a_pooling_lens_brings_its_evidence(
    settings: Settings, steps: Steps, store: Store, storage: Storage, lens: str
) -> None:
    cache = ModelCache(store, 1 << 30, storage, settings=ModelSettings(mode="evidence"))
    before = cache.get(lens)
    photo = steps.counted(patches=6)
    assert steps.lens_id(photo) == lens

    after = cache.get(lens)

    assert after.state.version == before.state.version + 1
    assert sum(s.evidence is not None for s in after.model.samples) == 6
    assert after.model.query(PLACE, SETTINGS, 15).mode == "evidence"


def test_lost_and_damaged_evidence_costs_only_itself(store: Store, storage: Storage, lens: str) -> None:
    stored = store.samples.of_lens(lens)[1]
    keys = [one.statistics_key for one in stored]
    assert keys[0] is not None
    assert keys[1] is not None
    storage.delete(f"{keys[0].rpartition('/')[0]}/")
    storage.put(keys[1], b"torn")
    storage.put(str(keys[2]), evidence(2).to_bytes())

    found = with_evidence(stored, storage, "likeliest")

    assert [one.sample.evidence is not None for one in found] == [False, False, True, False, False, False]


def test_evidence_is_bounded_and_the_newest_kept(store: Store, storage: Storage, lens: str) -> None:
    stored = store.samples.of_lens(lens)[1]
    one = evidence(0)
    room = 2 * (one.autocorrelation.nbytes + one.crosscorrelation.nbytes)

    found = with_evidence(stored, storage, "evidence", most_bytes=room)

    assert [s.sample.evidence is not None for s in found] == [False] * 4 + [True] * 2
    assert all(s.sample.evidence is None for s in with_evidence(stored, storage, "kernels"))


def test_likeliest_mode_is_found_by_a_worker_and_served(
    settings: Settings, store: Store, storage: Storage, lens: str, tmp_path: Path
) -> None:
    state, stored = store.samples.of_lens(lens)
    folder = tmp_path / "task"
    folder.mkdir()
    write_samples(folder, with_evidence(stored, storage, "likeliest"))
    assert (folder / EVIDENCE.format(5)).is_file()

    tasks.measure({"model": {"mode": "likeliest", "unit": "micrometre"}}, folder, ignore_step)
    storage.put(learned_key(lens, state.version, state.rebuild_epoch), (folder / LEARNED).read_bytes())

    with serve(settings, "likeliest") as client:
        # kernels are all that these patches are judged by, and evidence says something else than they
        assert psf(client, lens)["support"]["mode"] in {"kernels", "mixed"}
        assert "-l-" in client.get(f"/v1/lenses/{lens}/psf", params=ASKED).headers["etag"]
    cache = ModelCache(store, 1 << 30, storage)  # of another mode: what was learned is not for it
    assert not cache.get(lens).learned


@pytest.fixture
def taken(steps: Steps, store: Store) -> Callable[..., str]:
    """Let a photo of a body count; return the id of its lens."""

    def take(pitch_um: float | None, size: Sequence[int], sigma_px: float) -> str:
        photo = steps.receive()
        store.photos.set_state(photo.public_id, ("received",), "inspecting")
        store.photos.record_inspection(
            photo.public_id,
            width=size[0],
            height=size[1],
            identity=LensName("Canon", "EF24mm f/1.4L", "123", "exif"),
            aperture=1.4,
            focal_mm=24.0,
            focus_m=None,
            pixel_pitch_um=pitch_um,
        )
        store.photos.assign_lens(photo.public_id)
        store.photos.set_state(photo.public_id, ("inspecting",), "selecting")
        places = [(0.1 + 0.15 * k, 1.1 * k - 3.0) for k in range(6)]
        patches = [NewPatch(k, 0, 0, 64, r, phi, cell=k, score=1.0) for k, (r, phi) in enumerate(places)]
        store.patches.add(photo.public_id, photo.epoch, patches)
        store.photos.set_state(photo.public_id, ("selecting",), "estimating")
        kernel = gaussian(25, sigma_px**2 * np.eye(2))
        samples = [NewSample(k, "g", kernel, 0.5, "default/1") for k in range(6)]
        store.patches.finish(photo.public_id, photo.epoch, samples)
        assert store.photos.finish(photo.public_id, photo.epoch) is not None
        return str(steps.lens_id(photo))

    return take


def test_bodies_of_different_pitch_share_a_lens(client: TestClient, taken: Callable[..., str]) -> None:
    lens = taken(6.0, (6000, 4000), 1.5)
    assert taken(6.0, (6000, 4000), 1.5) == lens
    assert taken(4.0, (6000, 4000), 2.25) == lens  # the same 9 um of blur

    coarse, fine, usual = (
        psf(client, lens, pixel_pitch_um=6),
        psf(client, lens, pixel_pitch_um=4),
        psf(client, lens),
    )

    assert width(coarse) == pytest.approx(1.5, rel=0.05)
    assert width(fine) == pytest.approx(2.25, rel=0.05)
    assert [a["units"]["pixel_pitch_um"] for a in (coarse, fine, usual)] == [6.0, 4.0, 6.0]
    assert usual["psf"] == coarse["psf"]
    assert fine["support"]["photos"] == 3
    assert client.get(f"/v1/lenses/{lens}/psf", params={**ASKED, "pixel_pitch_um": -1}).status_code == 422


def test_sizes_of_one_sensor_share_a_lens_in_half_diagonals(
    settings: Settings, taken: Callable[..., str]
) -> None:
    lens = taken(None, (6000, 4000), 2.0)
    assert taken(None, (6000, 4000), 2.0) == lens
    assert taken(None, (3600, 2400), 1.2) == lens
    chosen = settings.model_copy(update={"model_unit": "half-diagonal"})
    with TestClient(create_app(chosen), raise_server_exceptions=False) as client:
        large = psf(client, lens, half_diagonal_px=float(np.hypot(6000, 4000)) / 2)
        small = psf(client, lens, half_diagonal_px=float(np.hypot(3600, 2400)) / 2)

    assert width(large) == pytest.approx(2.0, rel=0.05)
    assert width(small) == pytest.approx(1.2, rel=0.05)


def test_warm_answers_cost_one_read_of_the_tables(client: TestClient, taken: Callable[..., str]) -> None:
    lens = taken(6.0, (6000, 4000), 1.5)
    services = client.app.state.services  # type: ignore[attr-defined] # Starlette's own attribute
    psf(client, lens)
    services.models.get(lens)
    statements: list[str] = []

    def note(*told: Any) -> None:
        statements.append(str(told[2]))

    event.listen(services.store.database.reader, "before_cursor_execute", note)
    psf(client, lens, r=0.7)

    assert len([text for text in statements if "SELECT" in text]) == 1


def test_that_read_tells_what_two_others_do(store: Store, steps: Steps, taken: Callable[..., str]) -> None:
    lens = taken(6.0, (6000, 4000), 1.5)
    alone = store.samples.known_of(lens, "local")
    steps.counted(serial="other copy", patches=6)

    both = store.samples.known_of(lens, "local")

    assert alone == (store.samples.state_of(lens), ())
    assert both == (store.samples.state_of(lens), store.samples.family_of(lens))
    assert both is not None
    assert len(both[1]) == 1
    assert store.samples.known_of(lens, "somebody else") is None
    assert store.samples.known_of("none", "local") is None


def test_every_pixel_of_an_answer_has_a_standard_error(client: TestClient, taken: Callable[..., str]) -> None:
    lens = taken(6.0, (6000, 4000), 1.5)
    taken(6.0, (6000, 4000), 1.9)

    plain, more = psf(client, lens, r=0.98), psf(client, lens, r=0.98, std=True, pixel_pitch_um=4)

    assert plain["std"] is None
    error, kernel = np.array(more["std"]), np.array(more["psf"]["data"])
    assert error.shape == kernel.shape == (15, 15)
    assert 0.005 * kernel.max() < error.max() < 0.5 * kernel.max()
    assert (error >= 0).all()
    assert client.get(f"/v1/lenses/{lens}/psf", params={**ASKED, "aperture": 16}).json()["support"][
        "beyond"
    ] == ["aperture_stops"]
