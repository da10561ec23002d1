"""How large the rooms of the house are, what classes are called, and where constants come from."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
MOST_LINES, MOST_MODULES = 400, 15
PACKAGES = ("lensmodel", "app")


@cache
def modules() -> tuple[Path, ...]:
    return tuple(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


@cache
def text(path: Path) -> str:
    return path.read_text(encoding="utf-8")


@cache
def parsed(source: str) -> ast.Module:
    return ast.parse(source)


def public_classes(*, lab: bool) -> dict[str, list[str]]:
    """Where the public top-level classes are defined, by name: those of the laboratory or of the product."""
    homes = defaultdict(list)
    for path in modules():
        home = path.relative_to(ROOT)
        if home.is_relative_to("lensmodel/lab") is lab:
            for node in parsed(text(path)).body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    homes[node.name].append(str(home))
    return dict(homes)


def test_modules_are_short() -> None:
    long = {
        str(path.relative_to(ROOT)): lines
        for path in modules()
        if (lines := len(text(path).splitlines())) > MOST_LINES
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


def test_tests_stand_in_the_same_tree_as_the_code() -> None:
    of = {path.parent.relative_to(ROOT / "tests") for path in (ROOT / "tests").rglob("*/test_*.py")}
    assert [str(room) for room in of if not (ROOT / room).is_dir()] == []
    full = [room for room in of if len(list((ROOT / "tests" / room).glob("*.py"))) > MOST_MODULES]
    assert full == []


def is_text(one: ast.stmt) -> bool:
    """Whether it is the words below a constant."""
    return (
        isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant) and isinstance(one.value.value, str)
    )


def is_numbers(value: ast.expr | None) -> bool:
    """Whether a value is numbers alone, and what is computed of them and of other names."""
    if value is None or not any(
        isinstance(one, ast.Constant)
        and isinstance(one.value, int | float)
        and not isinstance(one.value, bool)
        for one in ast.walk(value)
    ):
        return False
    kinds = (ast.Constant, ast.Tuple, ast.Set, ast.List, ast.Dict, ast.UnaryOp, ast.BinOp, ast.Name)
    whole = (one for one in ast.walk(value) if isinstance(one, ast.expr))
    return all(isinstance(one, kinds) and not isinstance(getattr(one, "value", 0), str) for one in whole)


def silent(source: str) -> Iterator[int]:
    """Yield the lines of constants without a word.

    A word stands on their own lines, or above or below the lines without a gap that they belong to.
    """
    lines, group = source.splitlines(), list[ast.Assign | ast.AnnAssign]()
    for one in [*parsed(source).body, ast.Pass(lineno=len(lines) + 9)]:
        below = bool(group) and one.lineno == (group[-1].end_lineno or 0) + 1
        if group and not (below and isinstance(one, ast.Assign | ast.AnnAssign)):
            said = (below and is_text(one)) or lines[group[0].lineno - 2].startswith("#")
            for mute in group if not said else ():
                if is_numbers(mute.value) and "#" not in "".join(lines[mute.lineno - 1 : mute.end_lineno]):
                    yield mute.lineno
            group = []
        if isinstance(one, ast.Assign | ast.AnnAssign):
            group.append(one)


def test_constants_have_a_word() -> None:
    mute = [f"{path.relative_to(ROOT)}:{line}" for path in modules() for line in silent(text(path))]
    assert mute == []


def test_a_constant_without_a_word_is_found() -> None:
    assert list(
        silent('A = 1  # one\nB = (2.0, -3)\n\n# of both\nC = 4\nD = 5\n\nE = 6\nF = 7\n"""Two."""\n')
    ) == [2]


def test_each_class_of_the_product_has_a_name_of_its_own() -> None:
    shared = {name: homes for name, homes in public_classes(lab=False).items() if len(homes) > 1}
    assert shared == {}


def test_the_laboratory_calls_nothing_as_a_class_of_the_product_is_called() -> None:
    product, lab = public_classes(lab=False), public_classes(lab=True)
    assert {name: lab[name] + product[name] for name in lab.keys() & product.keys()} == {}
