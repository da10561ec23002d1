"""A page of titles, texts, tables and pictures, written as Markdown and as HTML that needs nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from lab.reproduce.pages.tables import table
from lensmodel.core.files import write_atomically

_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;max-width:1000px;margin:2rem auto;padding:0 1rem;color:#202124}
table{border-collapse:collapse;margin:1rem 0;font-size:14px}
td,th{border:1px solid #dadce0;padding:.25rem .6rem;text-align:right}
td:first-child,th:first-child{text-align:left}
img{max-width:100%;display:block;margin:.3rem 0}
figure{margin:1rem 0}figcaption{font-size:14px;color:#5f6368}h2{margin-top:2.5rem}
"""


class Page:
    """Collects blocks; writes them twice."""

    def __init__(self) -> None:
        self._markdown: list[str] = []
        self._html: list[str] = []

    def title(self, text: str, level: int = 2) -> None:
        """Add a title."""
        self._markdown.append(f"{'#' * level} {text}")
        self._html.append(f"<h{level}>{escape(text)}</h{level}>")

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self._markdown.append(text)
        self._html.append(f"<p>{escape(text)}</p>")

    def table(self, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Add a table."""
        self._markdown.append(table(head, rows))
        top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
        body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
        self._html.append(f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>")

    def picture(self, name: str, words: str) -> None:
        """Add a picture of the folder `pictures`."""
        self._markdown.append(f"{words}:\n\n![{words}](pictures/{name})")
        self._html.append(
            f'<figure><img src="pictures/{escape(name)}" alt="{escape(words)}">'
            f"<figcaption>{escape(words)}</figcaption></figure>"
        )

    def write(self, folder: Path, title: str) -> tuple[Path, Path]:
        """Write `reproduction.md` and `reproduction.html`."""
        markdown = "\n\n".join(self._markdown) + "\n"
        html = (
            f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
            f"<style>{_STYLE}</style></head><body>\n" + "\n".join(self._html) + "\n</body></html>\n"
        )
        return written_whole(folder / "reproduction.md", markdown), written_whole(
            folder / "reproduction.html", html
        )


def written_whole(path: Path, text: str) -> Path:
    """Write a text that appears whole or not at all, and return its path."""
    write_atomically(path, text.encode())
    return path
