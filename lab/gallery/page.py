"""The gallery's page beside its crops, and the same figures as a table of text."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from lab.gallery.crops import SIDE, ZOOM
from lab.gallery.run import GalleryEntry
from lab.page import Page, table

PAGE: Final = "index.md"

HEAD: Final = (
    "picture",
    "state",
    "dots",
    "hue flips",
    "overshoot %",
    "grain",
    "gain dB",
    "blocks < -0.5 dB",
    "worst block",
)

_COLUMN_OF: Final = {
    "dots": "dots",
    "hue flips": "hue flips",
    "overshoot": "overshoot %",
    "grain": "grain",
    "zones": "gain dB",
    "blocks": "blocks < -0.5 dB",
}
"""Bar -> column of its figure."""


def cells(entry: GalleryEntry) -> list[str]:
    """One row of the table of figures, in the order of `HEAD`."""
    found, state = entry.figures, entry.work["state"]
    if not found:
        return [entry.picture.name, state, *[""] * (len(HEAD) - 2)]
    overshoot, grain, gains = found["overshoot"], found["grain"], found["gains"]
    row = [
        entry.picture.name,
        state,
        str(found["dots"]),
        str(found["hue_flips"]),
        f"few edges ({found['edges']})"
        if overshoot is None
        else f"{overshoot[1]:.1f} (original {overshoot[0]:.1f})",
        "nothing even" if grain is None else " ".join(f"{ratio:.2f}" for ratio in grain.values()),
    ]
    if gains is None:
        return [*row, "", "", ""]
    zones = ", ".join(f"{zone} {value:+.2f}" for zone, value in gains["zones"].items())
    return [*row, zones, f"{100 * gains['loss_share']:.1f} %", f"{gains['worst_db']:+.2f}"]


def summary(entries: Sequence[GalleryEntry]) -> list[str]:
    """Which bars hold, in words: one line for each."""
    lines = []
    for bar in _COLUMN_OF:
        asked = [entry for entry in entries if bar in entry.bars]
        missed = [entry.picture.name for entry in asked if not entry.bars[bar]]
        kept = f"{len(asked) - len(missed)} of {len(asked)} pictures"
        lines.append(f"{bar}: {kept}" + (f"; missed by {', '.join(missed)}" if missed else ""))
    return lines


def text(entries: Sequence[GalleryEntry]) -> str:
    """Figures and bars as Markdown, for a terminal."""
    rows = [cells(entry) for entry in entries]
    return table(HEAD, rows) + "\n\nBars\n\n" + "\n".join(f"- {line}" for line in summary(entries))


def write_page(entries: Sequence[GalleryEntry], output: Path) -> Path:
    """Write the page as Markdown and HTML; its crops are there already. Returns the path of the HTML."""
    page = Page()
    page.title("Gallery", 1)
    page.text(_INTRODUCTION)
    page.title("Bars")
    page.text("; ".join(summary(entries)) + ".")
    rows = []
    for entry in entries:
        missed = {_COLUMN_OF[bar] for bar, kept in entry.bars.items() if not kept}
        named = zip(HEAD, cells(entry), strict=True)
        rows.append([f"**{cell}**" if name in missed else cell for name, cell in named])
    page.table(HEAD, rows)
    for entry in entries:
        page.title(entry.picture.name)
        page.text("; ".join(_words(entry)) + ".")
        if entry.work.get("announced"):
            gains = ", ".join(
                f"{zone} {'not known' if value is None else f'{value:+.1f} dB'}"
                for zone, value in entry.work["announced"].items()
            )
            page.text(f"Announced gain: {gains}.")
        columns = ", ".join(entry.columns)
        for place in entry.places:
            page.picture(place.file, f"{place.name}: {columns}; row {place.row}, column {place.col}")
    return page.write(output / PAGE, "Gallery")[1]


_INTRODUCTION: Final = (
    "Each picture is calibrated from itself and corrected with default settings. "
    f"Crops show {SIDE} pixels at {ZOOM}:1. Figures are taken from the pictures as shown: dots are single "
    "pixels outside what the original has around them, hue flips colours that it has nowhere near; overshoot "
    "is the 99th percentile beside clean edges, in percent of the step; grain is noise power of lightness in "
    "even places, corrected over original, coarse, middle and fine; gains are against the truth, after each "
    "block's own best shift. A figure in bold misses its bar."
)


def _words(entry: GalleryEntry) -> list[str]:
    """How a picture was made."""
    unit = entry.work
    words = [unit["state"] + (f" ({unit['reason']})" if unit["reason"] else ""), *unit["notes"]]
    if entry.figures:
        words.append(f"{100 * entry.figures['changed']:.1f} % of the pixels changed visibly")
    if "seconds" in unit:
        calibrated, corrected = unit["seconds"]
        words.append(f"calibrated in {calibrated:.0f} s, corrected in {corrected:.0f} s")
    return words
