"""Which pictures hang in the gallery: every real one of the test data, and the simulated frames."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from lab.gallery.frames import FRAMES
from lab.gallery.frames import version as frames_version
from lensmodel.core.errors import InvalidInputError, LensModelError, NotAnImageError
from lensmodel.photo import inspect

FOLDERS: Final = ("real", "large", "raw", "series", "meta")
STARS: Final = ("psf", (".tif", ".tiff"))
"""Star fields lie among other measurements of points."""

SUBJECTS: Final = {"faces": (215, 230)}
"""An eye and the skin below it."""

SMALLEST: Final = 64
"""Shorter side of a picture that shows anything; stand-ins for metadata are smaller."""


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture of the gallery.

    Parameters
    ----------
    name : str
        For people: folder and file, or "simulated/" and the frame.
    path : Path
        The photo; of a simulated frame it is taken when its turn comes.
    truth : Path or None
        npy of what a perfect lens would have shown; only of simulated frames.
    unreadable : str
        Why the file cannot be read; "" where it can.
    subject : tuple of int or None
        Pixel `(row, col)` of what the picture is about, where the usual places may miss it.
    """

    name: str
    path: Path
    truth: Path | None = None
    unreadable: str = ""
    subject: tuple[int, int] | None = None

    @property
    def slug(self) -> str:
        """The name as part of a file's name."""
        return re.sub(r"[^A-Za-z0-9_]+", "-", self.name).strip("-")


def real_pictures(folder: Path) -> list[Picture]:
    """Find the real pictures of the test data, those included that cannot be read.

    Raises
    ------
    InvalidInputError
        If the folder has none.
    """
    files = [path for name in FOLDERS for path in sorted((folder / name).glob("*")) if path.is_file()]
    files += [path for path in sorted((folder / STARS[0]).glob("*")) if path.suffix.lower() in STARS[1]]
    found = []
    for path in files:
        name = f"{path.parent.name}/{path.name}"
        try:
            info = inspect(path)
        except NotAnImageError:
            continue
        except LensModelError as error:
            found.append(Picture(name, path, unreadable=str(error)))
            continue
        if min(info.width, info.height) >= SMALLEST:
            found.append(Picture(name, path))
    if not found:
        raise InvalidInputError(
            f"{folder} has no picture in {', '.join(FOLDERS)}; name the test data's folder"
        )
    return found


def simulated_pictures(cache: Path) -> list[Picture]:
    """Name the simulated frames; they are taken when their turn comes."""
    folder = cache / f"frames-{frames_version()}"
    return [
        Picture(
            f"simulated/{frame.name}",
            folder / frame.file,
            folder / f"{frame.name}-truth.npy",
            subject=SUBJECTS.get(frame.name),
        )
        for frame in FRAMES
    ]


def chosen(pictures: Sequence[Picture], only: Sequence[str]) -> list[Picture]:
    """Keep the pictures whose name holds one of some texts; all where none is given.

    Raises
    ------
    InvalidInputError
        If a text is in no name.
    """
    for text in only:
        if not any(text in picture.name for picture in pictures):
            names = ", ".join(picture.name for picture in pictures)
            raise InvalidInputError(f"no picture is called {text!r}; there are {names}")
    return [p for p in pictures if not only or any(text in p.name for text in only)]
