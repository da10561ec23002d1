"""Measure simulated lenses in every way, and compare with their true PSFs."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np

from lab.measured.shots import Bench, take
from lensmodel.core.errors import LensModelError
from lensmodel.core.psf import distance, resized
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, Kernel
from lensmodel.estimation import measure
from lensmodel.estimation.measure.target import Target
from lensmodel.photo import develop
from lensmodel.workflow import pipeline

KINDS: Final = ("target", "pair", "points", "edges", "blind")

# Relative L2 that is asked of each (chosen): a pair may err more, its sharp photo is a little blurred too.
TARGET_GOAL: Final = 0.05
PAIR_GOAL: Final = 0.08

_BLIND_PATCHES: Final = 6  # of a small frame (chosen)
_NEAR: Final = 1.5  # an expected error within this factor of the true one is right


@dataclass(frozen=True, slots=True)
class WayResult:
    """How one way did with one lens.

    Parameters
    ----------
    lens, family, kind : str
    places : int
        Where a PSF was measured, in green.
    error : dict
        Median relative L2 by channel, after sub-pixel alignment.
    worst : float
        Nine in ten places are no further off, green.
    expected : float
        Median error that the samples themselves expect, green.
    right : float
        Share of samples whose expected error is right within a factor of 1.5.
    seconds : float
        CPU time of the measurement.
    refused : str
        Why there is nothing, or empty.
    """

    lens: str
    family: str
    kind: str
    places: int
    error: dict[str, float]
    worst: float
    expected: float
    right: float
    seconds: float
    refused: str = ""


Found = tuple[FieldPosition, Channel, Kernel, float]


def measured(
    bench: Bench,
    kind: str,
    folder: Path,
    *,
    detail: int,
    size: int,
    channels: Sequence[Channel] = CHANNELS,
    places: tuple[int, int] = (4, 3),
) -> WayResult:
    """Take the photos of one way, measure, and compare; a result that is there is read again."""
    stored = folder / f"{kind}.json"
    if stored.exists():
        return WayResult(**json.loads(stored.read_text(encoding="utf-8")))
    paths = take(bench, "pair" if kind == "blind" else kind, folder, detail)
    began = time.process_time()
    ways: dict[str, Callable[[], list[Found]]] = {
        "blind": lambda: _blind(paths[0], size),
        "target": lambda: _by(
            Target(across=places[0], down=places[1], details=(detail,)), paths, size, channels
        ),
    }
    try:
        found = ways.get(kind, lambda: _by(measure.methods.create(kind), paths, size, channels))()
        row = _compared(bench, kind, found, size, time.process_time() - began)
    except LensModelError as error:
        row = WayResult(bench.name, bench.family, kind, 0, {}, 1.0, 1.0, 0.0, 0.0, str(error))
    stored.write_text(json.dumps(asdict(row)), encoding="utf-8")
    return row


def _by(
    method: measure.Measurer, paths: Sequence[Path], size: int, channels: Sequence[Channel]
) -> list[Found]:
    photos = [develop(path) for path in paths]
    return [
        (one.position, one.channel, one.kernel, one.error)
        for one in method.measure(photos, size=size, channels=channels)
    ]


def _blind(path: Path, size: int) -> list[Found]:
    """Blind estimates of a few patches of the same photo, green only."""
    photo = develop(path)
    settings = pipeline.settings_of(photo)
    found: list[Found] = []
    for group in pipeline.patches_by_cell(pipeline.find_patches(photo, count=_BLIND_PATCHES)):
        try:
            cells = pipeline.estimate_cell(
                photo, group, settings=settings, photo_id="bench", size=size, channels=("g",)
            )
        except LensModelError:
            continue
        found += [
            (c.sample.position, "g", c.sample.kernel, 1.0 if c.sample.error is None else c.sample.error)
            for c in cells
        ]
    return found


def _compared(bench: Bench, kind: str, found: Sequence[Found], size: int, seconds: float) -> WayResult:
    truth = bench.truth()
    errors: dict[str, list[float]] = {}
    expected, right = [], []
    for position, channel, kernel, said in found:
        seen = distance(kernel, resized(truth.kernel_at(position, channel, size), size)).rel_l2
        errors.setdefault(channel, []).append(seen)
        if channel == "g":
            expected.append(said)
        right.append(1.0 / _NEAR <= said / max(seen, 1e-9) <= _NEAR)
    green = errors.get("g", [1.0])
    return WayResult(
        lens=bench.name,
        family=bench.family,
        kind=kind,
        places=len(green),
        error={channel: round(float(np.median(values)), 4) for channel, values in errors.items()},
        worst=round(float(np.quantile(green, 0.9)), 4),
        expected=round(float(np.median(expected)), 4) if expected else 1.0,
        right=round(float(np.mean(right)), 3),
        seconds=round(seconds, 1),
    )


def table(rows: Sequence[WayResult]) -> str:
    """Write the rows as a Markdown table, all ways against each other."""
    head = ("lens", "way", "places", "error g", "r", "b", "9 in 10", "expected", "right", "CPU s")
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in rows:
        if row.refused:
            cells = [row.lens, row.kind, "refused: " + row.refused, *[""] * (len(head) - 3)]
        else:
            channels = [f"{row.error[c]:.3f}" if c in row.error else "-" for c in ("g", "r", "b")]
            figures = (f"{row.worst:.3f}", f"{row.expected:.3f}", f"{row.right:.0%}", f"{row.seconds:.0f}")
            cells = [row.lens, row.kind, str(row.places), *channels, *figures]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
