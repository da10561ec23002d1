"""Whole ways from photos to corrected photos, by name: which estimator, which model, which deconvolution."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from lensmodel.core.errors import UnknownMethodError
from lensmodel.model import LensModel
from lensmodel.model.answer import DEFAULT, PAPER


@dataclass(frozen=True, slots=True)
class Way:
    """What is taken where nobody asks for something else.

    Parameters
    ----------
    name : str
        What users call it.
    estimator : str
        Of `estimators`.
    kernel_size : int
        Largest odd side of the estimated kernels in pixels.
    patches : int
        Parts of a photo that are looked at.
    mode : str
        Of `answer.MODES`.
    method : str
        Of `deconvolvers`.
    """

    name: str
    estimator: str
    kernel_size: int
    patches: int
    mode: str
    method: str


KERNEL_PATCHES: Final = 24
"""Patches that an estimator of kernels looks at: enough for every ring and octant of the field to get one,
while each costs a second."""

WAYS: Final[Mapping[str, Way]] = MappingProxyType(
    {
        "default": Way("default", "default", 55, 96, DEFAULT, "standard"),
        "paper": Way("paper", "michaeli-irani", 55, KERNEL_PATCHES, PAPER, "paper"),
    }
)
"""`default` encodes patches of whole photos and attends to them. `paper` is that of M. Hirsch and
B. Schölkopf, "Self-Calibration of Optical Lenses", ICCV 2015, sections 4 to 7, to be compared with: kernels
by T. Michaeli and M. Irani, their Nadaraya-Watson regression, and Richardson-Lucy deconvolution, without
what guards photos from errors of any of them."""


def way_named(name: str) -> Way:
    """Return a way."""
    if name not in WAYS:
        raise UnknownMethodError(f"no model {name!r}; known: {', '.join(WAYS)}")
    return WAYS[name]


def way_of(model: LensModel) -> Way:
    """Return the way that a lens was learned."""
    return WAYS["paper" if model.settings.mode == PAPER else "default"]


def chosen_way(name: str | None, model: LensModel | None) -> Way:
    """Return the way to learn a lens: as asked for, else that of its model, else the usual one."""
    return way_of(model) if name is None and model is not None else way_named(name or "default")
