"""The blind methods that the paper compares with, made anew: what they make of the same photos."""

from lab.rivals.basis import BasisField, RadialBasis, load_basis, principal
from lab.rivals.kee import GaussianField, Kee
from lab.rivals.rival import Rival
from lab.rivals.schuler import Schuler
from lensmodel.core.registry import Registry

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
