"""The photos of a case: frames composed of sharp photographs, as DNG files with noise.

No part of a photograph serves twice for one lens. Where a case's path is not raw, the files are what our own
development makes of these DNG files.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from PIL import Image

from lab.cases import list_photos, photo_half
from lab.scenes import HARD_SCENES
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import atomic, save_array
from lensmodel.core.types import Planes
from lensmodel.photo import develop, write_image
from lensmodel.simulate import edge_chart, load_scene, photograph, write_photo

if TYPE_CHECKING:
    from lab.reproduce.cases import Case

MARGIN: Final = 28
"""Pixels that a scene reaches beyond the frame on every side: half a kernel."""

JPEG_QUALITY: Final = 92  # of 100 (chosen): that of a fine JPEG of a camera

_GRIDS: Final = {1: (1, 1), 2: (1, 2), 4: (2, 2)}  # rows and columns of so many


@dataclass(frozen=True, slots=True)
class Layout:
    """How frames are made of photographs."""

    rows: int  # grid of photographs in one frame
    cols: int
    pieces: int  # parts that one photograph is cut into; each part serves as if it were a photograph
    tile: tuple[int, int]  # (height, width) that is cut from the middle of each

    @property
    def frame(self) -> tuple[int, int]:
        """Largest (height, width) of a frame that still has its margin; even."""
        height, width = self.rows * self.tile[0] - 2 * MARGIN, self.cols * self.tile[1] - 2 * MARGIN
        return height // 2 * 2, width // 2 * 2

    def words(self) -> str:
        """Say it in words."""
        whole = self.rows * self.cols
        source = "a photograph" if self.pieces == 1 else f"a part (one of {self.pieces}) of a photograph"
        return f"each frame is {source}" if whole == 1 else f"each frame is composed of {whole} photographs"


def scene_files(folder: Path | None) -> tuple[Path, ...]:
    """Photographs of the test half of a folder; all five of the library when there is no folder."""
    found = list_photos(folder)
    if folder is None:
        return found
    tested = tuple(path for path in found if photo_half(path.stem) == "test")
    if not tested:
        raise InvalidInputError(f"{folder} holds no photograph of the test half; add some")
    return tested


def layout_for(files: Sequence[Path], frames: int, wanted: tuple[int, int] | None = None) -> Layout:
    """Decide how to make `frames` frames without using anything twice."""
    share = len(files) // frames
    if share == 0 and 2 * len(files) < frames:
        raise InvalidInputError(
            f"{frames} frames need at least {(frames + 1) // 2} photographs, there are {len(files)}: "
            "ask for fewer photos a lens or give a folder with more photographs"
        )
    pieces = 1 if share else 2
    layouts = [_layout(files, pieces, _GRIDS[n]) for n in _GRIDS if n <= max(share, 1)]
    if wanted is None:
        return layouts[-1]
    for layout in layouts:
        if layout.rows * layout.tile[0] >= wanted[0] and layout.cols * layout.tile[1] >= wanted[1]:
            return layout
    raise InvalidInputError(
        f"the photographs do not cover {frames} frames of {wanted[0]} x {wanted[1]}: give larger ones"
    )


def _layout(files: Sequence[Path], pieces: int, grid: tuple[int, int]) -> Layout:
    rows, cols = grid
    sizes = np.array([_turned_size(path, pieces, upright=cols > rows) for path in files])
    height, width = (int(n) // 2 * 2 for n in sizes.min(axis=0))
    return Layout(rows, cols, pieces, (height, width))


def frame_scene(files: Sequence[Path], layout: Layout, order: Sequence[int], number: int) -> Planes:
    """Compose frame `number` from photographs in the given order.

    Returns
    -------
    Planes, shape (3, rows * tile height, cols * tile width)
    """
    per = layout.rows * layout.cols
    parts = [_part(files, layout, index) for index in order[number * per : (number + 1) * per]]
    rows = [parts[i * layout.cols : (i + 1) * layout.cols] for i in range(layout.rows)]
    return np.ascontiguousarray(np.concatenate([np.concatenate(row, axis=2) for row in rows], axis=1))


def content_of(files: Sequence[Path]) -> str:
    """Hash of the photographs' bytes, in order."""
    total = hashlib.sha256()
    for path in files:
        total.update(hashlib.sha256(path.read_bytes()).digest())
    return total.hexdigest()[:16]


def centred_cut(scene: Planes, height: int, width: int) -> Planes:
    """Cut the middle so that the scene exceeds `height` x `width` by twice the margin, or by less.

    What remains exceeds the frame by an even number, as the simulated camera wants it.
    """
    cut = []
    for have, want in zip(scene.shape[1:], (height, width), strict=True):
        if have < want:
            raise InvalidInputError(f"a scene of {scene.shape[1:]} does not cover {height} x {width}")
        spare = min((have - want) // 2, MARGIN)
        start = (have - want - 2 * spare) // 2
        cut.append(slice(start, start + want + 2 * spare))
    return np.ascontiguousarray(scene[:, cut[0], cut[1]])


def _part(files: Sequence[Path], layout: Layout, index: int) -> Planes:
    scene = load_scene(files[index // layout.pieces])
    if layout.pieces == 2:
        scene = _turned(scene, upright=False)
        half = scene.shape[2] // 2
        first = index % 2 == 0
        scene = scene[:, :, :half] if first else scene[:, :, -half:]
    scene = _turned(scene, upright=layout.tile[0] > layout.tile[1])
    height, width = layout.tile
    top, left = (scene.shape[1] - height) // 2, (scene.shape[2] - width) // 2
    return scene[:, top : top + height, left : left + width]


def _turned(scene: Planes, *, upright: bool) -> Planes:
    is_upright = scene.shape[1] > scene.shape[2]
    return scene if is_upright == upright else np.rot90(scene, axes=(1, 2))


def _turned_size(path: Path, pieces: int, *, upright: bool) -> tuple[int, int]:
    with Image.open(path) as image:
        short, long = sorted(image.size)
    if pieces == 2:
        short, long = sorted((short, long // 2))
    return (long, short) if upright else (short, long)


@dataclass(frozen=True, slots=True)
class Shots:
    """Files of the photos of one case."""

    learn: tuple[Path, ...]  # in the order in which the lens learns from them
    held_out: Path  # never used for calibration; the chart is None where the case has none
    chart: Path | None
    sharp: Path  # npy, the light that a perfect lens would have put on the sensor for `held_out`

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
) -> Shots:
    """Take the photos of a case that are not there yet; only the `first` so many if that is given."""
    folder.mkdir(parents=True, exist_ok=True)
    shots = Shots.of(case, folder)
    missing = [number for number, path in enumerate(shots.files[:first]) if not path.exists()]
    if workers <= 1 or len(missing) == 1:
        for number in missing:
            _take(case, tuple(files), folder, number)
        return shots
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for job in as_completed(
            [pool.submit(_take, case, tuple(files), folder, number) for number in missing]
        ):
            job.result()
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
    if number < frames and case.conditions.scene:
        drawn = HARD_SCENES[case.conditions.scene]
        scene = np.ascontiguousarray(drawn(scene, np.random.default_rng([case.seed, number, 1])))
    photo = photograph(scene, case.lens, case.settings, camera, rng)
    if number == frames - 1:
        with atomic(shots.sharp) as file:
            save_array(file, photo.sharp)
    # last, and whole or not at all: a photo that is there is complete
    path, container = shots.files[number], case.conditions.container
    if container == "dng":
        write_photo(path, photo)
        return
    raw = path.with_suffix(".raw.dng")
    write_photo(raw, photo)
    developed = develop(raw)
    kind: Literal["jpeg", "tiff16"] = "jpeg" if container == "jpeg" else "tiff16"
    write_image(
        path, developed.planes, developed.encoding, format=kind, color_space="srgb", quality=JPEG_QUALITY
    )
    raw.unlink()


def guard_of(case: Case) -> int:
    """Pixels between an edge and the border of its tile of the chart: half a kernel if it fits."""
    tile = min(case.height // 6, case.width // 8)
    return min(27, (tile - 32) // 2)
