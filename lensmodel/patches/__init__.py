"""Find the regions of a photo that tell about the PSF."""

from lensmodel.patches.base import REASONS, Patch, Reason, Rejection, Selection
from lensmodel.patches.enough import LEAST_PARTS, LEAST_PATCHES, require_enough
from lensmodel.patches.rmap import r_map
from lensmodel.patches.select import RMapSelector, Selector, select, selectors

__all__ = [
    "LEAST_PARTS",
    "LEAST_PATCHES",
    "REASONS",
    "Patch",
    "RMapSelector",
    "Reason",
    "Rejection",
    "Selection",
    "Selector",
    "r_map",
    "require_enough",
    "select",
    "selectors",
]
