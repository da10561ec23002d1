"""The blind method that the paper compares with, made anew: what it makes of the same photos."""

from lab.rivals.basis import BasisField, RadialBasis, load_basis, principal
from lab.rivals.schuler import Rival, Schuler
from lensmodel.core.registry import Registry

rivals: Registry[Rival] = Registry("rival", {"schuler": Schuler})

__all__ = [
    "BasisField",
    "RadialBasis",
    "Rival",
    "Schuler",
    "load_basis",
    "principal",
    "rivals",
]
