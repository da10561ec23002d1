"""Frames for the simulated camera, composed of sharp photographs; none serves twice for one lens."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image

from lab.cases import list_photos, photo_half
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import Planes
from lensmodel.simulate import load_scene

MARGIN: Final = 28
"""Pixels that a scene reaches beyond the frame on every side: half a kernel."""

_GRIDS: Final = {1: (1, 1), 2: (1, 2), 4: (2, 2)}  # rows and columns of so many


@dataclass(frozen=True, slots=True)
class Layout:
    """How frames are made of photographs.

    Parameters
    ----------
    rows, cols : int
        Grid of photographs in one frame.
    pieces : int
        Parts that one photograph is cut into; each part serves as if it were a photograph.
    tile : tuple of int
        (height, width) that is cut from the middle of each.
    """

    rows: int
    cols: int
    pieces: int
    tile: tuple[int, int]

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
    """Photographs of the test half of a folder; all five of the library when there is no folder.

    Raises
    ------
    InvalidInputError
        If the folder holds none of the test half.
    """
    found = list_photos(folder)
    if folder is None:
        return found
    tested = tuple(path for path in found if photo_half(path.stem) == "test")
    if not tested:
        raise InvalidInputError(f"{folder} holds no photograph of the test half; add some")
    return tested


def layout_for(files: Sequence[Path], frames: int, wanted: tuple[int, int] | None = None) -> Layout:
    """Decide how to make `frames` frames without using anything twice.

    Parameters
    ----------
    files : sequence of Path
        The photographs.
    frames : int
        How many frames.
    wanted : tuple of int, optional
        (height, width) that each has to cover: the smallest grid that does. None: the largest grid.

    Raises
    ------
    InvalidInputError
        If there are too few photographs, or they are too small.
    """
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

    Parameters
    ----------
    order : sequence of int
        Permutation of the numbers of all parts, `len(files) * layout.pieces`.

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

    Raises
    ------
    InvalidInputError
        If the scene is smaller than the frame.
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
