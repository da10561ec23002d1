"""The photos of a case: DNG files of a Bayer sensor with noise, clipping and lateral colour.

Where a case's path is not raw, the files are what our own development makes of these DNG files.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Final

import numpy as np

from lab.reproduce.cases import Case
from lab.reproduce.scenes import centred_cut, frame_scene
from lensmodel.core.files import atomic, save_array
from lensmodel.core.types import Planes, StepHook, ignore_step
from lensmodel.photo import develop, write_image
from lensmodel.simulate import SimulatedPhoto, edge_chart, photograph, write_photo

JPEG_QUALITY: Final = 92  # of 100 (chosen): that of a fine JPEG, as in `lab.camera_jpeg`


@dataclass(frozen=True, slots=True)
class Shots:
    """Files of the photos of one case.

    Parameters
    ----------
    learn : tuple of Path
        In the order in which the lens learns from them.
    held_out, chart : Path
        Never used for calibration; the chart is None where the case has none.
    sharp : Path
        npy, the light that a perfect lens would have put on the sensor for `held_out`.
    """

    learn: tuple[Path, ...]
    held_out: Path
    chart: Path | None
    sharp: Path

    @classmethod
    def of(cls, case: Case, folder: Path) -> Shots:
        """Name the files of a case in a folder."""
        suffix = case.conditions.suffix
        return cls(
            tuple(folder / f"photo-{i:02d}{suffix}" for i in range(case.photos[-1])),
            folder / f"held-out{suffix}",
            folder / f"chart{suffix}" if case.conditions.with_chart else None,
            folder / "held-out-sharp.npy",
        )

    @property
    def files(self) -> tuple[Path, ...]:
        """All photos, in the order in which they are taken."""
        return (*self.learn, self.held_out, *(() if self.chart is None else (self.chart,)))

    def truth(self) -> Planes:
        """Load the truth behind `held_out`: camera colours, not white-balanced."""
        planes: Planes = np.load(self.sharp, allow_pickle=False)
        return planes


def take(
    case: Case,
    files: Sequence[Path],
    folder: Path,
    *,
    first: int | None = None,
    workers: int = 1,
    on_step: StepHook = ignore_step,
) -> Shots:
    """Take the photos of a case that are not there yet; only the `first` so many if that is given."""
    folder.mkdir(parents=True, exist_ok=True)
    shots = Shots.of(case, folder)
    missing = [number for number, path in enumerate(shots.files[:first]) if not path.exists()]
    if not missing:
        return shots
    if workers <= 1 or len(missing) == 1:
        for done, number in enumerate(missing, start=1):
            _take(case, tuple(files), folder, number)
            on_step(done, len(missing))
        return shots
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(_take, case, tuple(files), folder, number) for number in missing]
        for done, job in enumerate(as_completed(jobs), start=1):
            job.result()
            on_step(done, len(missing))
    return shots


def _take(case: Case, files: tuple[Path, ...], folder: Path, number: int) -> None:
    shots, camera = Shots.of(case, folder), case.camera
    frames = len(shots.learn) + 1  # the held-out photo is the last of them
    if number < frames:
        order = case.order(len(files) * case.layout.pieces)
        scene = centred_cut(frame_scene(files, case.layout, order, number), case.height, case.width)
    else:
        scene = edge_chart(camera.frame, guard=guard_of(case)).scene
    rng = np.random.default_rng([case.seed, number])
    if number < frames and case.conditions.scenery is not None:
        scene = case.conditions.scenery(scene, np.random.default_rng([case.seed, number, 1]))
    photo = photograph(scene, case.lens, case.settings, camera, rng)
    if number == frames - 1:
        with atomic(shots.sharp) as file:
            save_array(file, photo.sharp)
    # last, and whole or not at all: a photo that is there is complete
    _write(shots.files[number], photo, case)


def _write(path: Path, photo: SimulatedPhoto, case: Case) -> None:
    container = case.conditions.container
    if container == "dng":
        write_photo(path, photo)
        return
    raw = path.with_suffix(".raw.dng")
    write_photo(raw, photo)
    developed = develop(raw)
    write_image(
        path,
        developed.planes,
        developed.encoding,
        format="jpeg" if container == "jpeg" else "tiff16",
        color_space="srgb",
        quality=JPEG_QUALITY,
    )
    raw.unlink()


def guard_of(case: Case) -> int:
    """Pixels between an edge and the border of its tile of the chart: half a kernel if it fits."""
    tile = min(case.height // 6, case.width // 8)
    return min(27, (tile - 32) // 2)
