"""What the gallery shows of each picture: figures, and crops of the places that are looked at."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lab.gallery import figures
from lab.gallery.pictures import AFTER, BEFORE, Picture, Rendered, Words, work
from lab.images import BLOCK, crop_boxes, gains, side_by_side
from lab.images import Picture as Shown
from lab.page import Page, table
from lab.stored import Unit, stored, version_of

SIDE: Final = 96
ZOOM: Final = 3  # pixels of a crop, and how many times each is shown
WORST: Final = 3  # crops of the worst places (chosen)
_SQUARE: Final = 48  # pixels of a square that is scored: half a crop, so that one shows all of it
_EVEN: Final = 0.02  # added to the local contrast: a change of an even place counts against it

CACHE, CROPS = "cache", "crops"

# the column of each bar's figure
_COLUMNS: Final = {
    "dots": "dots", "hue flips": "hue flips", "overshoot": "overshoot %", "grain": "grain",
    "zones": "gain dB", "blocks": "blocks < -0.5 dB",
}  # fmt: skip
_HEAD: Final = ("picture", "state", *_COLUMNS.values(), "worst block")

Place = tuple[str, int, int]  # name, first row and first column


@dataclass(frozen=True, slots=True)
class GalleryEntry:
    """What the page shows of one picture."""

    picture: Picture
    work: Unit  # how it was made, see `work`
    figures: dict[str, Any]  # see `measured`; empty for an unreadable file
    bars: dict[str, bool]  # which it keeps
    crops: dict[str, str]  # files of crops side by side, relative to the page, by what they show


def entries_of(
    pictures: Sequence[Picture], output: Path, *, workers: int, on_picture: Callable[[str, int, int], None]
) -> Iterator[GalleryEntry]:
    """Make what the page shows, one picture after the other."""
    (output / CROPS).mkdir(parents=True, exist_ok=True)
    for done, picture in enumerate(pictures):

        def say(words: str, done: int = done, name: str = picture.name) -> None:
            on_picture(f"{name}: {words}", done, len(pictures))

        yield _entry(picture, output, workers, say)
        say("done", done + 1)


def _entry(picture: Picture, output: Path, workers: int, say: Words) -> GalleryEntry:
    if picture.unreadable:
        unit: Unit = {"state": "not read", "reason": picture.unreadable, "note": "", "announced": {}}
        return GalleryEntry(picture, unit, {}, {}, {})
    folder, unit = work(picture, output / CACHE, workers, say)
    before = np.load(folder / BEFORE, mmap_mode="r")
    after = np.load(folder / AFTER, mmap_mode="r") if (folder / AFTER).exists() else before
    truth = None if picture.truth is None else np.load(picture.truth, mmap_mode="r")
    say("measuring")
    name = f"figures-{version_of(__name__)[:8]}.json"
    found = stored(folder / name, lambda: measured(before, after, truth))
    sheets = {"original": before, "corrected": after} | ({} if truth is None else {"truth": truth})
    named: list[tuple[str, Sequence[int] | None]] = [("subject", picture.subject)]
    named += [("most dots", found["dots_at"]), ("most hue flips", found["hue_flips_at"])]
    if found["gains"] is not None and found["gains"]["worst_db"] < 0.0:
        middle = [k + BLOCK // 2 for k in found["gains"]["worst_at"]]
        named.append((f"worst block, {found['gains']['worst_db']:+.2f} dB", middle))
    crops = {}
    for number, (words, row, col) in enumerate(places(before, after, named), start=1):
        file = f"{CROPS}/{picture.slug}-{number}.png"
        made = sheet(list(sheets.values()), row, col, side_of(before))
        Image.fromarray(made).save(output / file, optimize=True)
        crops[f"{words}: {', '.join(sheets)}; row {row}, column {col}"] = file
    return GalleryEntry(picture, unit, found, bars(found), crops)


def places(
    before: Rendered, after: Rendered, named: Sequence[tuple[str, Sequence[int] | None]] = ()
) -> list[Place]:
    """Centre, corners, the three places where most was changed, and pixels with a name apart from these."""
    height, width = before.shape[:2]
    side = side_of(before)

    def around(row: int, col: int) -> tuple[int, int]:
        return min(max(row - side // 2, 0), height - side), min(max(col - side // 2, 0), width - side)

    found: list[Place] = [(name, *box) for name, box in crop_boxes(height, width, side).items()]
    for number, peak in enumerate(_peaks(_change(before, after), side), start=1):
        found.append((f"most changed {number}", *around(*peak)))
    for name, pixel in named:
        if pixel is not None:
            row, col = around(pixel[0], pixel[1])
            if all(max(abs(row - r), abs(col - c)) > side // 2 for _, r, c in found):
                found.append((name, row, col))
    return found


def side_of(picture: Rendered) -> int:
    """Side of the crops of a picture: less where it is small."""
    return min(SIDE, picture.shape[0] // 2, picture.shape[1] // 2)


def sheet(pictures: Sequence[Rendered], row: int, col: int, side: int) -> Shown:
    """One place of several pictures side by side, each pixel as a square of three."""
    crops = [(picture[row : row + side, col : col + side] // 257).astype(np.uint8) for picture in pictures]
    return side_by_side([crop.repeat(ZOOM, axis=0).repeat(ZOOM, axis=1) for crop in crops])


def _change(before: Rendered, after: Rendered) -> NDArray[np.float64]:
    """Mean change of each square over the original's contrast there."""
    across = before.shape[1] // _SQUARE
    rows = []
    for row in range(0, before.shape[0] - _SQUARE + 1, _SQUARE):
        old, new = (
            picture[row : row + _SQUARE, : across * _SQUARE].reshape(_SQUARE, across, _SQUARE, 3) / 65535.0
            for picture in (before, after)
        )
        contrast = old.std(axis=(0, 2)).mean(axis=-1)
        rows.append(np.abs(new - old).mean(axis=(0, 2, 3)) / (contrast + _EVEN))
    return np.array(rows)


def _peaks(score: NDArray[np.float64], side: int) -> list[tuple[int, int]]:
    """Middles of the highest squares whose crops do not overlap; none where nothing was changed."""
    apart = -(-side // _SQUARE)
    left = score.copy()
    found: list[tuple[int, int]] = []
    while len(found) < WORST and left.size and left.max() > 0.0:
        row, col = (int(k) for k in np.unravel_index(int(left.argmax()), left.shape))
        found.append((row * _SQUARE + _SQUARE // 2, col * _SQUARE + _SQUARE // 2))
        left[max(row - apart, 0) : row + apart + 1, max(col - apart, 0) : col + apart + 1] = 0.0
    return found


def _cells(entry: GalleryEntry) -> list[str]:
    """One row of the table of figures, in the order of `_HEAD`."""
    found, row = entry.figures, [entry.picture.name, entry.work["state"]]
    if not found:
        return [*row, *[""] * (len(_HEAD) - 2)]
    overshoot, grain, gained = found["overshoot"], found["grain"], found["gains"]
    row += [str(found["dots"]), str(found["hue_flips"]), f"few edges ({found['edges']})", "nothing even"]
    if overshoot is not None:
        row[-2] = "{1:.1f} (original {0:.1f})".format(*overshoot)
    if grain is not None:
        row[-1] = " ".join(f"{ratio:.2f}" for ratio in grain.values())
    if gained is None:
        return [*row, "", "", ""]
    zones = ", ".join(f"{zone} {value:+.2f}" for zone, value in gained["zones"].items())
    return [*row, zones, f"{100 * gained['loss_share']:.1f} %", f"{gained['worst_db']:+.2f}"]


def _summary(entries: Sequence[GalleryEntry]) -> list[str]:
    """Which bars hold, in words: one line for each."""
    lines = []
    for bar in _COLUMNS:
        asked = [entry for entry in entries if bar in entry.bars]
        missed = [entry.picture.name for entry in asked if not entry.bars[bar]]
        kept = f"{len(asked) - len(missed)} of {len(asked)} pictures"
        lines.append(f"{bar}: {kept}" + (f"; missed by {', '.join(missed)}" if missed else ""))
    return lines


def text(entries: Sequence[GalleryEntry]) -> str:
    """Figures and bars as Markdown, for a terminal."""
    lines = "\n".join(f"- {line}" for line in _summary(entries))
    return f"{table(_HEAD, map(_cells, entries))}\n\nBars\n\n{lines}"


def write_page(entries: Sequence[GalleryEntry], output: Path) -> Path:
    """Write the page as Markdown and HTML; its crops are there already. Returns the path of the HTML."""
    page = Page()
    page.title("Gallery", 1)
    page.text(
        "Each picture is calibrated from itself and corrected with default settings. "
        f"Crops show {SIDE} pixels at {ZOOM}:1. What the figures are: docs/lab/gallery.md. "
        "A figure in bold misses its bar."
    )
    page.title("Bars")
    page.text("; ".join(_summary(entries)) + ".")
    rows = []
    for entry in entries:
        missed = {_COLUMNS[bar] for bar, kept in entry.bars.items() if not kept}
        named = zip(_HEAD, _cells(entry), strict=True)
        rows.append([f"**{cell}**" if name in missed else cell for name, cell in named])
    page.table(_HEAD, rows)
    for entry in entries:
        page.title(entry.picture.name)
        unit = entry.work
        words = [unit["state"] + (f" ({unit['reason']})" if unit["reason"] else ""), unit["note"]]
        if entry.figures:
            words.append(f"{100 * entry.figures['changed']:.1f} % of the pixels changed visibly")
        words += [
            f"announced in {zone}: {'not known' if value is None else f'{value:+.1f} dB'}"
            for zone, value in unit["announced"].items()
        ]
        page.text("; ".join(filter(None, words)) + ".")
        for shown, file in entry.crops.items():
            page.picture(file, shown)
    return page.write(output / "index.md", "Gallery")[1]


TILE: Final = 1024  # side of a tile: a multiple of the squares of the figures; bounds the memory

OVERSHOOT_PERCENT: Final = 12.0
GRAIN: Final = (0.8, 1.0)
ZONE_LOSS_DB: Final = 0.05
LOSS_SHARE: Final = 0.01
"""Bars (chosen): most overshoot in percent, grain over the original's, a zone's loss, losing blocks."""

_MARGIN: Final = 14  # pixels around a tile: the reach of a profile, and two for its slope

Figures = dict[str, Any]


def measured(before: Rendered, after: Rendered, truth: Rendered | None) -> Figures:
    """Take all figures of a picture."""
    faults: dict[str, list[NDArray[np.intp]]] = {"dots": [], "hue_flips": []}
    edges, places, changed = [], [], 0
    for row, col, window, inner in _tiles(*before.shape[:2]):
        old, new = _unit(before[window]), _unit(after[window])
        true = None if truth is None else _unit(truth[window])
        for name, find in (("dots", figures.dots), ("hue_flips", figures.hue_flips)):
            faults[name].append(np.argwhere(find(old, new, true)[inner]) + np.array([row, col]))
        edges.append(figures.overshoots(old, new, true))
        places.append(figures.grain(old[inner], new[inner], None if true is None else true[inner]))
        changed += int((np.abs(new[inner] - old[inner]).max(axis=-1) > 1.0 / 255.0).sum())
    counts: Figures = {}
    for name, tiles in faults.items():
        pixels = np.concatenate(tiles)
        counts |= {name: len(pixels), f"{name}_at": _densest(pixels)}
    edge_table = np.concatenate(edges)
    gained = None if truth is None else gains(before, after, truth)
    return {
        **counts,
        "edges": len(edge_table),
        "overshoot": figures.percentile_of_edges(edge_table),
        "grain": figures.grain_ratio(np.concatenate(places)),
        "changed": changed / float(np.prod(before.shape[:2])),
        "gains": None if gained is None else asdict(gained),
    }


def bars(found: Figures) -> dict[str, bool]:
    """Say which bars a picture keeps; one that could not be measured on it is left out."""
    kept = {"dots": found["dots"] == 0, "hue flips": found["hue_flips"] == 0}
    if found["overshoot"] is not None:
        kept["overshoot"] = found["overshoot"][1] <= OVERSHOOT_PERCENT
    if found["grain"] is not None:
        kept["grain"] = all(GRAIN[0] <= round(ratio, 2) <= GRAIN[1] for ratio in found["grain"].values())
    if found["gains"] is not None:
        kept["zones"] = min(found["gains"]["zones"].values()) >= -ZONE_LOSS_DB
        kept["blocks"] = found["gains"]["loss_share"] <= LOSS_SHARE
    return kept


def _densest(pixels: NDArray[np.intp]) -> list[int] | None:
    """Middle of the square that holds most of some pixels."""
    if len(pixels) == 0:
        return None
    squares, numbers = np.unique(pixels // _SQUARE, axis=0, return_counts=True)
    return [int(k) * _SQUARE + _SQUARE // 2 for k in squares[numbers.argmax()]]


def _unit(part: Rendered) -> NDArray[np.float32]:
    return np.asarray(part, dtype=np.float32) / np.float32(65535.0)


def _tiles(height: int, width: int) -> Iterator[tuple[int, int, tuple[slice, slice], tuple[slice, slice]]]:
    """First row and column of each tile, the tile with its margin, and the tile within that."""
    for row in range(0, height, TILE):
        for col in range(0, width, TILE):
            top, left = max(row - _MARGIN, 0), max(col - _MARGIN, 0)
            window = (slice(top, row + TILE + _MARGIN), slice(left, col + TILE + _MARGIN))
            bottom, right = min(row + TILE, height) - top, min(col + TILE, width) - left
            yield row, col, window, (slice(row - top, bottom), slice(col - left, right))
