"""Who chooses the patches of a photo: the library and `calibrate` pass the name on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from in_process import lensmodel as command
from running import write_photo

import lensmodel
from lensmodel.blind import sampling
from lensmodel.core.errors import NotEnoughEvidenceError, NoUsablePatchesError


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Selectors that were asked for the patches of a photo; they find none, which ends the work."""
    selectors: list[object] = []

    def find_patches(developed: object, *, selector: object, **_: object) -> Any:
        del developed
        selectors.append(selector)
        raise NoUsablePatchesError("no patch was chosen")

    monkeypatch.setattr(sampling, "find_patches", find_patches)
    return selectors


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "holiday").mkdir()
    write_photo(tmp_path / "holiday" / "one.dng", 1)
    return tmp_path


class Everywhere:
    """A selector of one's own."""

    name, version = "everywhere", 1


def test_the_library_takes_a_name_or_an_object(folder: Path, asked: list[object]) -> None:
    own = Everywhere()
    for selector in ("good-regions", own):
        with pytest.raises(NotEnoughEvidenceError, match="no patch was chosen"):
            lensmodel.calibrate(folder / "holiday" / "one.dng", selector=selector, workers=1)  # type: ignore[arg-type]  # never asked to score

    assert asked == ["good-regions", own]


@pytest.mark.parametrize(
    ("option", "taken"), [(("--selector", "good-regions"), "good-regions"), ((), "r-map")]
)
def test_the_command_passes_its_option_on(
    option: tuple[str, ...], taken: str, folder: Path, asked: list[object]
) -> None:
    command(
        "calibrate", "holiday/one.dng", "--profile", "new.lensprofile", *option, "--workers", "1", cwd=folder
    )

    assert asked == [taken]
