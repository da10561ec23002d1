"""Put the output of `lensmodel reproduce` into the documentation: the page with a summary.

    python -m lensmodel.lab.reproduce.pages.publish reproduction figures.json --lenses 3

`reproduction` is the output folder of the run, `figures.json` what `--json` wrote. Written are the page
of that name in `docs/lab/results`, a table of means of each family first, and its pictures (of each
family those of the first lenses only that have any, crops as JPEG).
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from lensmodel.core.types import ZONES, Zone

ROOT = Path(__file__).resolve().parents[4]
RESULTS = ROOT / "docs/lab/results"
SHOWN: tuple[Zone, ...] = ("center", "corner")
METHOD = "standard"
_QUALITY = 90  # of JPEG (chosen)


def page(folder: Path, written: Path, names: set[str], kept: set[str], summary: str) -> int:
    """Copy the page, a summary under its title, with some of the pictures; return how many pictures."""
    shown = written.with_name(f"{written.stem}-pictures")
    shutil.rmtree(shown, ignore_errors=True)
    blocks: list[str] = []
    count = 0
    for block in (folder / "reproduction.md").read_text(encoding="utf-8").rstrip().split("\n\n"):
        found = re.fullmatch(r"!\[(.*)\]\(pictures/(.*)\)", block, re.DOTALL)
        if not found:
            blocks.append(block)
            continue
        words, name = found.groups()
        own = any(name.startswith(f"{case}-") for case in names)
        if own and not any(name.startswith(f"{case}-") for case in kept):
            blocks.pop()  # the line that tells what it would show
            continue
        source, count = folder / "pictures" / name, count + 1
        shown.mkdir(parents=True, exist_ok=True)
        if own:
            name = f"{Path(name).stem}.jpg"
            with Image.open(source) as opened:
                opened.convert("RGB").save(shown / name, quality=_QUALITY, subsampling=0)
        else:
            shutil.copyfile(source, shown / name)
        blocks.append(f"![{words}]({shown.name}/{name})")
    with_content = [
        block
        for block, after in zip(blocks, [*blocks[1:], "#"], strict=True)
        if not (block.startswith("### ") and after.startswith("#"))
    ]
    title, *rest = with_content
    written.write_text("\n\n".join([title, summary, *rest]) + "\n", encoding="utf-8")
    return count


def table(cases: list[Mapping[str, Any]]) -> str:
    """Means over lenses of MTF50 and PSNR, and what PSNR gained where it gained least."""

    def line(label: str, of: Callable[[Mapping[str, Any]], Mapping[str, Any]]) -> str:
        cells = [f"{np.mean([of(case)['edges'][zone]['mtf50'] for case in cases]):.0f}" for zone in SHOWN] + [
            f"{np.mean([of(case)['psnr'][zone] for case in cases]):.2f}" for zone in SHOWN
        ]
        gains = [
            of(case)["psnr"][zone] - case["truth"]["before"]["psnr"][zone] for case in cases for zone in ZONES
        ]
        return f"| {label} | {' | '.join(cells)} | {min(gains):+.1f} |"

    lines = [
        "| | MTF50 center | corner | PSNR center | corner | least gain of a zone |",
        "|---|---|---|---|---|---|",
        line("the photo as it was", lambda case: case["truth"]["before"]),
    ]
    lines += [
        line(f"{name}, at its best setting", lambda case, name=name: case["programs"][name]["state"])  # type: ignore[misc]
        for name in cases[0]["programs"]
    ]
    for n in sorted(cases[0]["learned"], key=int):
        photos = "one photo" if n == "1" else f"{n} photos"
        lines.append(
            line(
                f"corrected, learned from {photos}",
                lambda case, n=n: case["learned"][n]["methods"][METHOD],  # type: ignore[misc]
            )
        )
    for n in sorted(cases[0]["paper"], key=int):
        lines.append(
            line(
                f"the paper's own way, n = {n}",
                lambda case, n=n: next(iter(case["paper"][n]["methods"].values())),  # type: ignore[misc]
            )
        )
    lines.append(line("corrected with the true PSF", lambda case: case["truth"]["true"][METHOD]))
    return "\n".join(lines)


def by_family(result: Mapping[str, Any]) -> str:
    """Write the table of each family's lenses wide open, and say what it is of."""
    whole = [case for case in result["cases"] if case["stops"] < 0.1 and "1" in case["learned"]]
    parts = []
    for family in dict.fromkeys(case["family"] for case in whole):
        cases = [case for case in whole if case["family"] == family]
        unseen = sum(case["unseen"] for case in cases)
        parts += [f"Means over {len(cases)} {family} lenses, {unseen} of them unseen:", table(cases)]
    return "\n\n".join([*parts, words(result)])


def words(result: Mapping[str, Any]) -> str:
    """Say what the tables are of."""
    held = result["bars_held"]
    said = (
        "MTF50 in line pairs per picture height, PSNR in dB, photographs that nothing was tuned on, raw "
        "files at base ISO. The last column is the worst zone of any lens. `lensmodel reproduce` made it; of "
        f"the bars that were set before measuring {held['held']} hold and {held['missed']} are missed."
    )
    return textwrap.fill(said, 110, break_long_words=False, break_on_hyphens=False)


def shown_lenses(cases: Sequence[Mapping[str, Any]], count: int) -> set[str]:
    """Names of the first lenses of each family that have pictures."""
    found: dict[str, list[str]] = {}
    for case in cases:
        if case["truth"]["pictures"]:
            found.setdefault(case["family"], []).append(case["name"])
    return {name for names in found.values() for name in names[:count]}


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("figures", type=Path)
    parser.add_argument("--lenses", type=int, default=3, help="so many lenses of a family keep pictures")
    parser.add_argument("--name", default="reproduction", help="of the page")
    asked = parser.parse_args()
    result = json.loads(asked.figures.read_text(encoding="utf-8"))
    cases = result["cases"]
    names = {case["name"] for case in (*cases, *result["hard"])}
    written = RESULTS / f"{asked.name}.md"
    count = page(asked.folder, written, names, shown_lenses(cases, asked.lenses), by_family(result))
    print(f"{count} pictures; {written}")


if __name__ == "__main__":
    main()
