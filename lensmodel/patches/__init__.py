"""Find the regions of a photo that tell about the PSF."""

from lensmodel.patches.base import REASONS, Patch, Reason, Rejection, Selection
from lensmodel.patches.rmap import r_map
from lensmodel.patches.select import RMapSelector, Selector, select, selectors

__all__ = [
    "REASONS",
    "Patch",
    "RMapSelector",
    "Reason",
    "Rejection",
    "Selection",
    "Selector",
    "r_map",
    "select",
    "selectors",
]
