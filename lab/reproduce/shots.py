"""The photos of a case: DNG files with noise, and what our own development makes of them as TIFF and JPEG.

Photos are kept, and taken again only if lens, frame or photographs change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeAlias

import numpy as np

from lab.reproduce.cases import Case, centred_cut, frame_scene
from lensmodel.core.files import atomic, save_array
from lensmodel.core.types import Planes
from lensmodel.photo import develop, write_image
from lensmodel.simulate import edge_chart, photograph, write_photo

Container: TypeAlias = Literal["dng", "tiff", "jpeg"]

JPEG_QUALITY: Final = 92  # of 100 (chosen): that of a fine JPEG of a camera

SUFFIXES: Final[dict[Container, str]] = {"dng": ".dng", "tiff": ".tif", "jpeg": ".jpg"}


@dataclass(frozen=True, slots=True)
class Shots:
    """Files of the photos of one case."""

    learn: tuple[Path, ...]  # in the order in which the lens learns from them
    held_out: Path  # never used for calibration
    chart: Path
    sharp: Path  # npy, the light that a perfect lens would have put on the sensor for `held_out`

    @classmethod
    def of(cls, case: Case, folder: Path) -> Shots:
        """Name the files of a case in a folder."""
        return cls(
            tuple(folder / f"photo-{i:02d}.dng" for i in range(case.photos[-1])),
            folder / "held-out.dng",
            folder / "chart.dng",
            folder / "held-out-sharp.npy",
        )

    def truth(self) -> Planes:
        """Load the truth behind `held_out`: camera colours, not white-balanced."""
        planes: Planes = np.load(self.sharp, allow_pickle=False)
        return planes


def take(case: Case, files: Sequence[Path], folder: Path, *, photos: int | None = None) -> Shots:
    """Take the photos of a case that are not there yet; the first `photos` alone if that is given."""
    folder.mkdir(parents=True, exist_ok=True)
    shots, camera = Shots.of(case, folder), case.camera
    order = np.random.default_rng(case.seed).permutation(len(files))
    mixed = [files[i] for i in order]
    wanted: list[tuple[Path, int | None]] = [(path, i) for i, path in enumerate(shots.learn[:photos])]
    wanted += [] if photos else [(shots.held_out, None), (shots.chart, None)]
    for path, number in wanted:
        if path.exists():
            continue
        if path == shots.chart:
            scene = edge_chart(camera.frame, guard=guard_of(case)).scene
        else:
            scene = centred_cut(frame_scene(mixed, case.layout, number), case.height, case.width)
        seed = [case.seed, len(SUFFIXES) if path == shots.chart else 0 if number is None else number + 10]
        photo = photograph(scene, case.lens, case.settings, camera, np.random.default_rng(seed))
        if path == shots.held_out:
            with atomic(shots.sharp) as file:
                save_array(file, photo.sharp)
        write_photo(path, photo)  # last, and whole or not at all: a photo that is there is complete
    return shots


def in_container(path: Path, container: Container) -> Path:
    """Return a photo as another kind of file, developed by the library in sRGB; made where it is missing."""
    made = path.with_suffix(SUFFIXES[container])
    if not made.exists():
        developed = develop(path)
        kind: Literal["jpeg", "tiff16"] = "jpeg" if container == "jpeg" else "tiff16"
        write_image(
            made, developed.planes, developed.encoding, format=kind, color_space="srgb", quality=JPEG_QUALITY
        )
    return made


def guard_of(case: Case) -> int:
    """Pixels between an edge and the border of its tile of the chart: half a kernel if it fits."""
    tile = min(case.height // 6, case.width // 8)
    return min(27, (tile - 32) // 2)
