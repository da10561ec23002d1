"""What the documents say of files, against the code."""

from __future__ import annotations

import re
from pathlib import Path

from lensmodel.photo.endings import ENDINGS

FORMATS = Path(__file__).parents[1] / "docs" / "formats.md"


def test_the_page_of_formats_lists_the_endings_that_are_taken() -> None:
    read = FORMATS.read_text(encoding="utf-8").partition("\n## Photos that are written\n")[0]
    named = {f".{word}" for word in re.findall(r"\.([a-z0-9]+)\b", " ".join(re.findall(r"`[^`\n]+`", read)))}

    assert named == ENDINGS
