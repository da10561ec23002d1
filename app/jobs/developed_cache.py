"""The cache of developed photos on disk, bounded in size."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

KEEP_BYTES: Final = 20 << 30
"""Size of the cache at most (chosen: some seventy photos of 24 megapixels as planes of float32), or half of
the free disk if that is less."""


def drop_developed(base: Path, existing: Callable[[Iterable[str]], set[str]], idle_s: float) -> None:
    """Bound the cache in `base`; developed photos whose photo was deleted are removed first.

    Parameters
    ----------
    base : Path
        A folder for each photo.
    existing : callable
        Returns which of some photos exist.
    idle_s : float
        Folders used within so many seconds may be in use.
    """
    folders = [path for path in base.iterdir() if path.is_dir()] if base.is_dir() else []
    known = existing(path.name for path in folders)
    used = sorted((_used(path), path) for path in folders)
    free = shutil.disk_usage(base).free if folders else 0
    room = min(KEEP_BYTES, free // 2) if free else 0
    total = sum(_size(path) for path in folders)
    for last, path in used:
        idle = time.time() - last > idle_s
        if path.name not in known or (total > room and idle):
            total -= _size(path)
            shutil.rmtree(path, ignore_errors=True)


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.glob("*"))


def _used(folder: Path) -> float:
    planes = folder / "planes.npy"
    return planes.stat().st_mtime if planes.exists() else 0.0
