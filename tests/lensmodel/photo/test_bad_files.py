"""Hostile and damaged files, each in a process of its own with little memory and time."""

from __future__ import annotations

import multiprocessing
import resource
import warnings
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest

from lensmodel import photo
from lensmodel.core.errors import LensModelError

MEMORY = 1 << 30
SECONDS = 10

# What must be refused, and why; every other file may be refused or be a photo.
REFUSED = {
    "2018-01-09-exiv2-crash-003.tiff": "not_an_image",
    "CanonRaw.cr2": "truncated_image",
    "DNG.dng": "decompression_bomb",
    "Minolta.mrw": "decompression_bomb",
    "Panasonic.rw2": "decompression_bomb",
    "bomb_40000x40000_1bit.png": "decompression_bomb",
    "bomb_header_100000x100000.tif": "decompression_bomb",
    "bomb_header_2147483647.png": "decompression_bomb",
    "cve_2017_18005_reproducer.tiff": "not_an_image",
    "issue_1841_poc.webp": "unsupported_format",
    "issue_428_poc2.png": "truncated_image",
    "issue_790_poc2.png": "truncated_image",
    "issue_845_poc.png": "not_an_image",
    "issue_857_poc.raf": "not_an_image",
    "truncated_colorchart.dng": "truncated_image",
}
# Real pictures in spite of odd metadata.
PHOTOS = {
    "67-0_length_string.jpg": (2012, 4032),
    "Issue_247-1.nef": (3008, 2000),
    "image00971.jpg": (227, 636),
}


def attempt(path: Path, report: Connection) -> None:
    """Develop one file and send `(code or None, shape, finite)`."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
    warnings.simplefilter("ignore")
    try:
        planes = photo.develop(path).planes
        report.send((None, planes.shape, bool(np.isfinite(planes).all() and planes.min() >= 0)))
    except LensModelError as error:
        report.send((error.code, (), bool(str(error))))
    except BaseException as error:  # noqa: BLE001  the kind of any other exception is the finding
        report.send((f"foreign: {error!r}", (), False))


def outcome(path: Path) -> tuple[str | None, tuple[int, ...], bool]:
    context = multiprocessing.get_context("forkserver")
    # what a child needs of this file too: it would import it anew for each
    context.set_forkserver_preload(["lensmodel.photo", "pytest"])
    receive, send = context.Pipe(duplex=False)
    process = context.Process(target=attempt, args=(path, send))
    process.start()
    send.close()
    try:
        if not receive.poll(3 * SECONDS):  # CPU time is bounded in the child; this bounds sleep
            return "foreign: no answer in time", (), False
        return receive.recv()
    except EOFError:
        process.join()
        return f"foreign: died with {process.exitcode}", (), False
    finally:
        process.kill()
        process.join()


@pytest.mark.tools
def test_bad_files_are_refused_in_our_words_or_are_photos(shared_data: Path) -> None:
    paths = sorted((shared_data / "bad").iterdir())
    assert len(paths) > 40
    for path in paths:
        code, shape, sound = outcome(path)
        assert not (code or "").startswith("foreign"), f"{path.name}: {code}"
        assert sound, path.name
        if path.name in REFUSED:
            assert code == REFUSED[path.name], path.name
        if path.name in PHOTOS:
            assert shape == (3, *PHOTOS[path.name]), path.name
