"""What the documents say of files, against the code."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from lensmodel.photo.values import ENDINGS

ROOT = Path(__file__).parents[1]
FORMATS = ROOT / "docs" / "formats.md"


def test_the_page_of_formats_lists_the_endings_that_are_taken() -> None:
    read = FORMATS.read_text(encoding="utf-8").partition("\n## Photos that are written\n")[0]
    named = {f".{word}" for word in re.findall(r"\.([a-z0-9]+)\b", " ".join(re.findall(r"`[^`\n]+`", read)))}

    assert named == ENDINGS


def test_the_search_of_the_documents_needs_neither_worker_nor_request(tmp_path: Path) -> None:
    site = pytest.importorskip("tools.docs_site")
    (tmp_path / "search").mkdir()
    sections = [{"location": "guide.html", "title": "Guide", "text": "aberration \u2028 coma"}]
    (tmp_path / "search" / "search_index.json").write_text(json.dumps({"config": {}, "docs": sections}))

    site.on_post_build(SimpleNamespace(site_dir=str(tmp_path)))

    index = (tmp_path / "search" / "index.js").read_text(encoding="utf-8")
    assert json.loads(index.removeprefix("const searchedSections = ").removesuffix(";\n")) == sections
    script = (tmp_path / "search" / "main.js").read_text(encoding="utf-8")
    assert "searchedSections" in script
    assert not re.search(r"Worker\(|fetch\(|XMLHttpRequest", script)


def test_what_the_first_page_of_the_documents_shows_and_links_to_is_part_of_the_site() -> None:
    site = pytest.importorskip("tools.docs_site")
    links = re.findall(r"\]\(([^)#]+)", site.beside("README.md"))

    added = {*site.BESIDE, "notebooks/index.md"}
    assert {"app/pages/static/before-after.jpg", "guide.md"} <= {*links}
    assert [link for link in links if link not in added and not (ROOT / "docs" / link).is_file()] == []
    assert len(re.findall(r"\]\(.*\.ipynb\)", site.notebooks())) == 5
