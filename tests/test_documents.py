"""The documents: short pages for users, one spelling, and no link, anchor or path that leads nowhere."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

from lensmodel.photo.endings import ENDINGS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
FIRST = ("guide", "expect", "formats", "library", "service")
"""The pages for users; what else they may want to know is in `topics`."""

PAGES = sorted([*(DOCS / f"{page}.md" for page in FIRST), *(DOCS / "topics").glob("*.md")])
"""What users and operators read; the changelog grows with each version."""

DOCUMENTS = sorted([*DOCS.rglob("*.md"), *ROOT.glob("*.md"), *(ROOT / "lensmodel").rglob("*.md")])
MOST_WORDS, MOST_OF_README = 800, 600
FENCED = re.compile(r"^( *)```.*?^\1```$", re.MULTILINE | re.DOTALL)
SPAN = re.compile(r"`[^`\n]+`")
INLINE = re.compile(r"\]\(([^)\s]+)\)")
REFERRED = re.compile(r"^\[[^\]]+\]: (\S+)$", re.MULTILINE)
SOURCE = re.compile(r'(?:src|href)="([^"]+)"')
ELSEWHERE = ("http://", "https://", "mailto:")
WORKSHOP = re.compile(r"\b(bars?|held|told|missed|beliefs?)\b", re.IGNORECASE)
AMERICAN = re.compile(r"\b(center(s|ed)?|colors?|grays?|neighbors?|meters?|license)\b", re.IGNORECASE)
PATH = re.compile(r"\bdocs/[\w/-]+\.(?:md|jpg|svg|ipynb)\b")


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def prose(page: Path) -> str:
    """Return the text without code."""
    return SPAN.sub("", FENCED.sub("", page.read_text(encoding="utf-8")))


@cache
def anchors(page: Path) -> frozenset[str]:
    """Return the anchors of the headings, as GitHub and MkDocs make them."""
    text = FENCED.sub("", page.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    plain = (re.sub(r"\]\([^)]*\)", "", heading) for heading in headings)
    return frozenset(re.sub(r"[^\w\- ]", "", heading).strip().lower().replace(" ", "-") for heading in plain)


def links(page: Path) -> list[str]:
    """Return the targets within this repository."""
    text = prose(page)
    targets = [*INLINE.findall(text), *REFERRED.findall(text), *SOURCE.findall(text)]
    return [target for target in targets if not target.startswith(ELSEWHERE)]


def broken(page: Path) -> list[str]:
    """Return the links of a page that lead to no file or to no heading of it."""
    lost = []
    for target in links(page):
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        if not there.exists() or (anchor and anchor not in anchors(there)):
            lost.append(target)
    return lost


def test_a_newcomer_sees_few_pages() -> None:
    assert {page.stem for page in DOCS.glob("*.md")} == {*FIRST, "changelog"}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_a_page_for_users_is_short(page: Path) -> None:
    assert len(page.read_text(encoding="utf-8").split()) < MOST_WORDS


def test_the_page_of_formats_lists_the_endings_that_are_taken() -> None:
    read = (DOCS / "formats.md").read_text(encoding="utf-8").partition("\n## Photos that are written\n")[0]
    named = {f".{word}" for word in re.findall(r"\.([a-z0-9]+)\b", " ".join(SPAN.findall(read)))}

    assert named == ENDINGS


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= MOST_OF_README


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md"], ids=name)
def test_a_page_for_users_has_one_spelling_and_no_words_of_the_workshop(page: Path) -> None:
    text = prose(page)

    assert not WORKSHOP.findall(text)
    assert not AMERICAN.findall(text)


@pytest.mark.parametrize("page", DOCUMENTS, ids=name)
def test_each_link_of_a_document_leads_somewhere(page: Path) -> None:
    assert broken(page) == []


def test_a_link_to_no_file_or_no_heading_is_found(tmp_path: Path) -> None:
    (tmp_path / "a.md").write_text("# One\n\n## Two words, `code`\n")
    (tmp_path / "b.md").write_text("[1](a.md#two-words-code) [2](a.md#three) [3](c.md)\n`[4](d.md)`\n")

    assert broken(tmp_path / "b.md") == ["a.md#three", "c.md"]


def test_paths_of_documents_in_code_exist() -> None:
    sources = [
        file for folder in ("app", "lensmodel", "tests", "tools") for file in (ROOT / folder).rglob("*.py")
    ]
    named = {path for file in sources for path in PATH.findall(file.read_text(encoding="utf-8"))}

    assert named
    assert sorted(path for path in named if not (ROOT / path).exists()) == []


def test_every_page_is_in_the_navigation() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2]
    pages = {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")}

    assert set(re.findall(r"([\w/-]+\.md)$", navigation, re.MULTILINE)) - pages == {
        "index.md",
        "reference/library.md",
        "reference/client.md",
        "reference/http.md",
    }
    assert {page for page in pages if page not in navigation} == {
        "lab/results/larger-frames.md",
        "lab/results/reproduction.md",
    }
