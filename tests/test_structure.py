"""How large the rooms of the house are."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[1]
MOST_LINES, MOST_MODULES = 400, 15
PACKAGES = ("lensmodel", "app")


def modules() -> list[Path]:
    return [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]


def test_modules_are_short() -> None:
    long = {
        str(path.relative_to(ROOT)): lines
        for path in modules()
        if (lines := len(path.read_text(encoding="utf-8").splitlines())) > MOST_LINES
    }
    assert long == {}


def test_a_room_of_many_modules_says_why() -> None:
    silent = []
    for room in {path.parent for path in modules()}:
        count = sum(path.name != "__init__.py" for path in room.glob("*.py"))
        says = (room / "__init__.py").read_text(encoding="utf-8") if (room / "__init__.py").exists() else ""
        if count > MOST_MODULES and "more than fifteen modules because" not in says:
            silent.append(f"{room.relative_to(ROOT)}: {count}")
    assert silent == []
