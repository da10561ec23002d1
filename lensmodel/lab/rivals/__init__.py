"""The blind methods that the paper compares with, made anew: what they make of the same photos."""

from lensmodel.core.registry import Registry
from lensmodel.lab.rivals.basis import BasisField, RadialBasis, load_basis, principal
from lensmodel.lab.rivals.kee import GaussianField, Kee
from lensmodel.lab.rivals.rival import Rival
from lensmodel.lab.rivals.schuler import Schuler

rivals: Registry[Rival] = Registry("rival", {"kee": Kee, "schuler": Schuler})

__all__ = [
    "BasisField",
    "GaussianField",
    "Kee",
    "RadialBasis",
    "Rival",
    "Schuler",
    "load_basis",
    "principal",
    "rivals",
]
