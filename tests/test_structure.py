"""How large the rooms of the house are, and what their classes are called."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
MOST_LINES, MOST_MODULES = 400, 15
PACKAGES = ("lensmodel", "app")


def modules() -> list[Path]:
    return [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]


def public_classes(*, lab: bool) -> dict[str, list[str]]:
    """Where the public top-level classes are defined, by name: those of the laboratory or of the product."""
    homes = defaultdict(list)
    for path in modules():
        home = path.relative_to(ROOT)
        if home.is_relative_to("lensmodel/lab") is lab:
            tree = ast.parse(path.read_text(encoding="utf-8"))
            for node in tree.body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    homes[node.name].append(str(home))
    return dict(homes)


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


def test_each_class_of_the_product_has_a_name_of_its_own() -> None:
    shared = {name: homes for name, homes in public_classes(lab=False).items() if len(homes) > 1}
    assert shared == {}


def test_the_laboratory_calls_nothing_as_a_class_of_the_product_is_called() -> None:
    product, lab = public_classes(lab=False), public_classes(lab=True)
    assert {name: lab[name] + product[name] for name in lab.keys() & product.keys()} == {}
