"""A page of titles, texts, tables and pictures: Markdown, and HTML that needs nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Final

import markdown

from lensmodel.core.files import write_atomically

_STYLE: Final = """
body{font:16px/1.5 system-ui,sans-serif;max-width:1400px;margin:2rem auto;padding:0 1rem;color:#202124}
table{border-collapse:collapse;margin:1rem 0;font-size:14px}
td,th{border:1px solid #dadce0;padding:.25rem .6rem}
img{max-width:100%;display:block;image-rendering:pixelated}h2{margin-top:2.5rem}
"""


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Write a Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


class Page:
    """Collects blocks of Markdown."""

    def __init__(self) -> None:
        self._blocks: list[str] = []

    def title(self, text: str, level: int = 2) -> None:
        """Add a title."""
        self._blocks.append(f"{'#' * level} {escape(text, quote=False)}")

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self._blocks.append(escape(text, quote=False))

    def markdown(self, text: str) -> None:
        """Add Markdown as it is."""
        self._blocks.append(text.rstrip())

    def table(self, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        """Add a table."""
        self._blocks.append(table(head, ([escape(cell, quote=False) for cell in row] for row in rows)))

    def picture(self, path: str, words: str) -> None:
        """Add a picture by its path from the page."""
        words = escape(words, quote=False)
        self._blocks.append(f"{words}:\n\n![{words}]({path})")

    def write(self, path: Path, title: str) -> tuple[Path, Path]:
        """Write the page as Markdown to a path, and as HTML beside it."""
        text = "\n\n".join(self._blocks) + "\n"
        body = markdown.markdown(text, extensions=["tables"])
        html = (
            f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
            f"<style>{_STYLE}</style></head><body>\n{body}\n</body></html>\n"
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        beside = path.with_suffix(".html")
        write_atomically(path, text.encode())
        write_atomically(beside, html.encode())
        return path, beside
