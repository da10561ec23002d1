"""A disk so small that a test can fill it."""

from __future__ import annotations

import contextlib
import os
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def small_disk(folder: Path, megabytes: int) -> Iterator[bool]:
    """Mount a disk of so many MiB at an empty folder; give False where that needs a right that is missing."""
    options = ["-t", "tmpfs", "-o", f"size={megabytes}m", "none", str(folder)]
    mount = ["mount", *options]
    made = os.geteuid() == 0 and subprocess.run(mount, check=False, capture_output=True).returncode == 0
    try:
        yield made
    finally:
        if made:
            subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill(path: Path) -> None:
    """Write a file, or go on with it, until the disk has no room left."""
    for block in (1 << 20, 4096, 1):
        with contextlib.suppress(OSError), path.open("ab", buffering=0) as file:
            while file.write(bytes(block)) == block:
                pass


@contextlib.contextmanager
def kept_full(folder: Path) -> Iterator[None]:
    """Fill the disk of a folder, and again whatever others give up meanwhile."""
    filler, ended = folder / "filler", threading.Event()

    def keep() -> None:
        while not ended.wait(0.05):
            fill(filler)

    fill(filler)
    keeper = threading.Thread(target=keep)
    keeper.start()
    try:
        yield
    finally:
        ended.set()
        keeper.join()
        filler.unlink()
