"""PSFs measured on photos made for it, instead of estimated from ordinary ones: photos in, samples out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.registry import Registry
from lensmodel.measured.edges import SlantedEdges
from lensmodel.measured.measurer import Measurer
from lensmodel.measured.pair import AperturePair
from lensmodel.measured.points import Points
from lensmodel.measured.target import DETAILS, PAPERS, Target, TargetPage, print_target
from lensmodel.photo import inspect

methods: Final[Registry[Measurer]] = Registry(
    "way of measuring", {"target": Target, "pair": AperturePair, "points": Points, "edges": SlantedEdges}
)

__all__ = ["DETAILS", "PAPERS", "Measurer", "TargetPage", "measurements_of", "methods", "print_target"]


def measurements_of(kind: str, paths: Sequence[Path]) -> list[tuple[Path, ...]]:
    """Group photos into measurements: each for itself, or in twos, the wider aperture first."""
    count = methods.create(kind).photos
    if not paths or len(paths) % count:
        remedy = "; give the open photo and the closed one, two different files" if kind == "pair" else ""
        raise InvalidInputError(
            f"measuring by {kind} takes {count} photo{'s' * (count > 1)} at a time, got {len(paths)}{remedy}"
        )
    groups = [tuple(paths[i : i + count]) for i in range(0, len(paths), count)]
    return [_by_aperture(group) if count > 1 else group for group in groups]


def _by_aperture(group: tuple[Path, ...]) -> tuple[Path, ...]:
    """Widest aperture first; in the order given where a photo does not say its own."""
    known = [aperture for path in group if (aperture := inspect(path).metadata.aperture) is not None]
    if len(known) < len(group):
        return group
    if len(set(known)) < len(group):
        raise InvalidInputError(
            f"{' and '.join(path.name for path in group)} are both at f/{known[0]:g}; a pair is one photo "
            "wide open and one closed to about f/8"
        )
    return tuple(path for _, path in sorted(zip(known, group, strict=True)))
