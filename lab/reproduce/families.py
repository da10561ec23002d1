"""The two families of lenses, and which of them anything was developed on."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import Final, Literal, TypeAlias

import lensmodel
from lab.traced import GridLens, grid

Family: TypeAlias = Literal["third order", "ray-traced"]

FAMILIES: Final[tuple[Family, ...]] = ("third order", "ray-traced")

FIRST_SEED: Final = 1000
"""Seeds of third-order lenses below are for development, and parameters are chosen on them."""

SEEDS: Final = (1008, *range(1001, 1008))
"""Of third-order lenses that are run, one of each kind; 1008 is the soft, fast one instead of 1000, so that
half of them are unseen."""

SEEDS_LOOKED_AT: Final = frozenset({1000, 1001, 1002, 1003, 1006})
"""Of those beyond: results of these were looked into during development, and two choices followed: the
share of the correction that compressed photos get (1001), and pairs of photos in the search (1002)."""

LOOKED_AT: Final = frozenset({"heliar", "reverse-telephoto", "tronnier", "retrofocus"})
"""Designs of ray-traced lenses that were looked at during development. Of the others it is known what they
have of each aberration, which went into what is expected of lenses; nothing was chosen on photos of them."""

# Seeds of ray-traced lenses (chosen): above those of drawn ones, so many that designs hardly share one.
_TRACED_FROM: Final = 2000
_TRACED: Final = 100_000


def repository_grids() -> tuple[Path, ...]:
    """Grids of ray-traced lenses that lie in the repository; none where it is not there."""
    folder = Path(lensmodel.__file__).parents[1] / "tests/lensmodel/data"
    return tuple(sorted(folder.glob("traced-*.npz")))


@lru_cache(maxsize=16)
def traced(path: Path) -> GridLens:
    """Read a ray-traced lens at the one aperture of a grid file.

    Raises
    ------
    InvalidInputError
        If the file has another form.
    """
    return GridLens.read(path)


def design(path: Path) -> str:
    """Name of the design of a grid."""
    return str(traced(path).grids[0].facts["design"])


def source(path: Path) -> str:
    """Where the design of a grid was published."""
    return str(traced(path).grids[0].facts["source"])


def number(path: Path) -> int:
    """Number that takes the place of a seed: of the design's name, whatever else is run."""
    return _TRACED_FROM + int(hashlib.sha256(design(path).encode()).hexdigest(), 16) % _TRACED


def content(path: Path) -> str:
    """Hash of a grid and of the code that answers between its nodes."""
    total = hashlib.sha256(path.read_bytes())
    total.update(Path(grid.__file__).read_bytes())
    return total.hexdigest()[:16]
