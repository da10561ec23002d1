"""The blind methods that the paper compares with, made anew: what they make of the same photos."""

from lensmodel.bench.rivals.base import Rival
from lensmodel.bench.rivals.basis import BasisField, RadialBasis, load_basis, principal
from lensmodel.bench.rivals.kee import GaussianField, Kee
from lensmodel.bench.rivals.schuler import Schuler
from lensmodel.registry import Registry

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
