"""The demo's camera: sharp photographs seen through a simulated lens, as Bayer DNG files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from lensmodel.core.types import LensSettings, Planes
from lensmodel.simulate import (
    ChartEdge,
    SimulatedCamera,
    SimulatedLens,
    demo_scene,
    draw_lens,
    edge_chart,
    photograph,
    write_photo,
)

LENS_SEED = 2024  # chosen: any number, fixed so that the demo is reproducible
LENS_KIND = "soft-fast"
LEARN_FROM = ("city", "lake", "tea-gardens")
HELD_OUT = "colosseum"
CHART = "chart"


@dataclass(frozen=True, slots=True)
class DemoShot:
    """One photo that the demo took."""

    name: str  # name of the scene
    path: Path  # the DNG file
    truth: Path  # the light that a perfect lens would have put on the sensor, npy `(3, row, col)` float32

    def sharp(self) -> Planes:
        """Load the truth: camera colours, not white-balanced, saturation 1."""
        return np.load(self.truth, allow_pickle=False)


def demo_lens() -> SimulatedLens:
    """Return the lens of the demo; nothing in the project was tuned on it."""
    return draw_lens(LENS_SEED, LENS_KIND)


def demo_camera() -> SimulatedCamera:
    """Return the camera of the demo: 1.3 megapixels, base ISO; every scene covers its frame."""
    return SimulatedCamera(height=896, width=1456)


def demo_settings() -> LensSettings:
    """Return the settings of all its photos: wide open."""
    lens = demo_lens()
    return LensSettings(aperture=lens.at_focal().f_number, focal_mm=lens.focal_mm[0])


def chart_edges() -> tuple[ChartEdge, ...]:
    """Return the edges of the chart that the demo photographs."""
    return edge_chart(demo_camera().frame).edges


def take_photos(
    folder: Path, *, workers: int, on_photo: Callable[[str, int, int], None], names: Sequence[str] = ()
) -> dict[str, DemoShot]:
    """Photograph every scene through the lens, in parallel processes.

    Parameters
    ----------
    on_photo : callable
        Called as `on_photo(name, done, total)` when a photo is finished.
    """
    names = tuple(names) or (*LEARN_FROM, HELD_OUT, CHART)
    folder.mkdir(parents=True, exist_ok=True)
    shots: dict[str, DemoShot] = {}
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(_take, name, number, folder) for number, name in enumerate(names)]
        for job in as_completed(jobs):
            shot = job.result()
            shots[shot.name] = shot
            on_photo(shot.name, len(shots), len(names))
    return shots


def _take(name: str, number: int, folder: Path) -> DemoShot:
    lens, camera, settings = demo_lens(), demo_camera(), demo_settings()
    scene = edge_chart(camera.frame).scene if name == CHART else _framed(demo_scene(name), camera)
    photo = photograph(scene, lens, settings, camera, np.random.default_rng(number))
    shot = DemoShot(name, folder / f"{name}.dng", folder / f"{name}-sharp.npy")
    np.save(shot.truth, photo.sharp, allow_pickle=False)
    write_photo(shot.path, photo)
    return shot


def _framed(scene: Planes, camera: SimulatedCamera) -> Planes:
    """Cut the middle of a scene so that it exceeds the frame by an even margin, or equals it."""
    cut = []
    for have, want in zip(scene.shape[1:], (camera.height, camera.width), strict=True):
        spare = (have - want) // 2 * 2
        start = (have - want - spare) // 2
        cut.append(slice(start, start + want + spare))
    return np.ascontiguousarray(scene[:, cut[0], cut[1]])
