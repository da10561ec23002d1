"""The gallery's page: one file of HTML beside its crops, and the same figures as a table of text."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Final

from lab.gallery.crops import SIDE, ZOOM
from lab.gallery.run import GalleryEntry
from lab.reproduce.pages.sheet import written_whole
from lab.reproduce.pages.tables import table

PAGE: Final = "index.html"

HEAD: Final = (
    "picture",
    "state",
    "dots",
    "hue flips",
    "overshoot %",
    "grain",
    "texture kept",
    "gain dB",
    "blocks < -0.5 dB",
    "worst block",
)

_STYLE: Final = """
body{font:16px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:1400px;padding:0 1rem;color:#202124}
table{border-collapse:collapse;margin:1rem 0;font-size:14px}
td,th{border:1px solid #dadce0;padding:.25rem .6rem;text-align:left}
td.missed{background:#fce8e6}h2{margin-top:3rem}
figure{margin:1rem 0}figcaption{font-size:14px;color:#5f6368}
img{display:block;max-width:none;image-rendering:pixelated}
"""

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
        "" if found["texture"] is None else f"{found['texture']:.2f}",
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
    """Write the page; its crops are there already."""
    output.mkdir(parents=True, exist_ok=True)
    parts = ["<h1>Gallery</h1>", f"<p>{escape(_INTRODUCTION)}</p>", "<h2>Bars</h2>"]
    parts.append("<ul>" + "".join(f"<li>{escape(line)}</li>" for line in summary(entries)) + "</ul>")
    parts.append(_figures(entries))
    for entry in entries:
        parts += _section(entry)
    html = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>Gallery</title>'
        f"<style>{_STYLE}</style></head><body>\n" + "\n".join(parts) + "\n</body></html>\n"
    )
    return written_whole(output / PAGE, html)


_INTRODUCTION: Final = (
    "Each picture is calibrated from itself and corrected with default settings. "
    f"Crops show {SIDE} pixels at {ZOOM}:1. Figures are taken from the pictures as shown: dots are single "
    "pixels outside what the original has around them, hue flips colours that it has nowhere near; overshoot "
    "is the 99th percentile beside clean edges, in percent of the step; grain is noise power in even places, "
    "corrected over original, coarse, middle and fine; texture kept is the 5th percentile of the contrast of "
    "low-contrast places, corrected over original; gains are against the truth, after each block's own "
    "best shift. A shaded figure misses its bar."
)


def _figures(entries: Sequence[GalleryEntry]) -> str:
    head = "".join(f"<th>{escape(word)}</th>" for word in HEAD)
    rows = []
    for entry in entries:
        missed = {_COLUMN_OF[bar] for bar, kept in entry.bars.items() if not kept}
        row = [
            f"<td{' class=missed' if name in missed else ''}>{escape(cell)}</td>"
            for name, cell in zip(HEAD, cells(entry), strict=True)
        ]
        row[0] = f'<td><a href="#{entry.picture.slug}">{escape(entry.picture.name)}</a></td>'
        rows.append(f"<tr>{''.join(row)}</tr>")
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


def _section(entry: GalleryEntry) -> list[str]:
    unit = entry.work
    parts = [f'<h2 id="{entry.picture.slug}">{escape(entry.picture.name)}</h2>']
    parts.append(f"<p>{escape('; '.join(_words(entry)))}.</p>")
    if unit.get("announced"):
        gains = ", ".join(
            f"{zone} {'not known' if value is None else f'{value:+.1f} dB'}"
            for zone, value in unit["announced"].items()
        )
        parts.append(f"<p>Announced gain: {escape(gains)}.</p>")
    if entry.audit:
        words = "What the audit would hold back: white is everything"
        parts.append(
            f'<figure><img src="{entry.audit}" alt="{words}"><figcaption>{words}</figcaption></figure>'
        )
    columns = ", ".join(entry.columns)
    for place in entry.places:
        caption = f"{place.name}: {columns}; row {place.row}, column {place.col}"
        parts.append(
            f'<figure><img src="{place.file}" alt="{escape(caption)}">'
            f"<figcaption>{escape(caption)}</figcaption></figure>"
        )
    return parts


def _words(entry: GalleryEntry) -> list[str]:
    """How a picture was made."""
    unit = entry.work
    words = [unit["state"] + (f" ({unit['reason']})" if unit["reason"] else ""), *unit["notes"]]
    if entry.figures:
        words.append(f"{100 * entry.figures['changed']:.1f} % of the pixels changed visibly")
    if "seconds" in unit:
        calibrated, corrected = unit["seconds"]
        words.append(f"calibrated in {calibrated:.0f} s, corrected in {corrected:.0f} s")
    rival = unit.get("rival")
    if rival is not None and rival["reason"]:
        words.append(f"no {rival['name']}: {rival['reason']}")
    return words
