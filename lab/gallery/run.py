"""Hang the gallery: picture by picture, whatever is stored already is not made again."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from lab.gallery import crops, figures, measure, truth
from lab.gallery.pictures import Picture
from lab.gallery.work import Wishes, work
from lab.reproduce.store import Unit, stored

OnPicture = Callable[[str, int, int], None]
"""Hears what is being done, and how many of how many pictures are finished."""

CACHE = "cache"
CROPS = "crops"


@dataclass(frozen=True, slots=True)
class PicturePlace:
    """One place of a picture that is looked at.

    Parameters
    ----------
    name : str
        Which place.
    row, col : int
        First pixel.
    file : str
        Crops side by side, in the order of `GalleryEntry.columns`, relative to the page.
    """

    name: str
    row: int
    col: int
    file: str


@dataclass(frozen=True, slots=True)
class GalleryEntry:
    """What the page shows of one picture.

    Parameters
    ----------
    picture : Picture
    work : dict
        How it was made, see `work`.
    figures : dict
        See `measured`; empty for an unreadable file.
    bars : dict of str to bool
        Which it keeps.
    columns : tuple of str
        What stands side by side in the crops.
    places : tuple of PicturePlace
    audit : str
        File of the audit's map, "" without one.
    """

    picture: Picture
    work: Unit
    figures: dict[str, Any]
    bars: dict[str, bool]
    columns: tuple[str, ...]
    places: tuple[PicturePlace, ...]
    audit: str = ""


def hang(
    pictures: Sequence[Picture], output: Path, wishes: Wishes, *, on_picture: OnPicture
) -> Iterator[GalleryEntry]:
    """Make what the page shows, one picture after the other.

    Parameters
    ----------
    pictures : sequence of Picture
    output : Path
        Folder of the page; crops and stored results go below it.
    wishes : Wishes
    on_picture : OnPicture

    Yields
    ------
    GalleryEntry
        Of each picture as soon as it is finished.
    """
    (output / CROPS).mkdir(parents=True, exist_ok=True)
    for done, picture in enumerate(pictures):

        def say(words: str, done: int = done, name: str = picture.name) -> None:
            on_picture(f"{name}: {words}", done, len(pictures))

        entry = _entry(picture, output, wishes, say)
        say("done", done + 1)
        yield entry


def _entry(picture: Picture, output: Path, wishes: Wishes, say: Callable[[str], None]) -> GalleryEntry:
    if picture.unreadable:
        unit: Unit = {"state": "not read", "reason": picture.unreadable, "notes": []}
        return GalleryEntry(picture, unit, {}, {}, (), ())
    room, unit = work(picture, output / CACHE, wishes, say)
    before = room.picture(room.before)
    assert before is not None
    after = room.picture(room.after)
    shown = before if after is None else after
    known = None if picture.truth is None else np.load(picture.truth, mmap_mode="r", allow_pickle=False)
    say("measuring")
    name = f"figures-{_version()}.json"
    found, _ = stored(room.folder / name, lambda: measure.measured(before, shown, known))
    columns, sheets = ["original", "corrected"], [before, shown]
    for word, other in ((unit["rival"]["name"], room.picture(room.rival)), ("truth", known)):
        if other is not None:
            columns.append(word)
            sheets.append(other)
    say("cutting crops")
    keep = room.kept()
    side = crops.side_of(before)
    named: list[tuple[str, Sequence[int] | None]] = [("subject", picture.subject)]
    named += [("most dots", found["dots_at"]), ("most hue flips", found["hue_flips_at"])]
    if found["gains"] is not None and found["gains"]["worst_db"] < 0.0:
        middle = [k + truth.BLOCK // 2 for k in found["gains"]["worst_at"]]
        named.append((f"worst block, {found['gains']['worst_db']:+.2f} dB", middle))
    where = crops.places(before, shown, keep, named)
    made = []
    for number, (words, row, col) in enumerate(where, start=1):
        file = f"{CROPS}/{picture.slug}-{number}.png"
        Image.fromarray(crops.sheet(sheets, row, col, side)).save(output / file, optimize=True)
        made.append(PicturePlace(words, row, col, file))
    audit = ""
    if keep is not None:
        audit = f"{CROPS}/{picture.slug}-audit.png"
        Image.fromarray(crops.drawn(keep)).save(output / audit, optimize=True)
    return GalleryEntry(picture, unit, found, measure.bars(found), tuple(columns), tuple(made), audit)


def _version() -> str:
    """Hash of the code that figures come from."""
    total = hashlib.sha256()
    for module in (figures, measure, truth):
        total.update(Path(str(module.__file__)).read_bytes())
    return total.hexdigest()[:8]
