"""Fitted constants lie in one file a room, beside the commands that print them."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

import lensmodel
from lensmodel.core.files import fitted

ROOMS = sorted(path.parents[1].name for path in Path(lensmodel.__file__).parent.glob("*/data/fitted.json"))
ROW = re.compile(r"^\| `([a-z_]+)` \|.*\| ([^|]+) \|$", re.MULTILINE)
COMMAND = re.compile(r"`python -m ([a-z_.]+)[^`]*`")


@pytest.mark.parametrize("room", ROOMS)
def test_each_constant_has_a_row_that_says_where_it_comes_from(room: str) -> None:
    """A command of the laboratory printed it, or it was chosen for a reason."""
    folder = Path(lensmodel.__file__).parent / room / "data"
    rows = dict(ROW.findall((folder / "README.md").read_text(encoding="utf-8")))

    assert rows.keys() == fitted(room).keys()
    for source in rows.values():
        assert COMMAND.match(source) or source.startswith("chosen: ")
        assert all(importlib.util.find_spec(command) for command in COMMAND.findall(source))


def test_the_rooms_that_have_fitted_constants_are_found() -> None:
    assert {"blind"} <= set(ROOMS)
