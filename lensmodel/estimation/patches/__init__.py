"""Find the regions of a photo that are informative about the PSF."""

from lensmodel.estimation.patches.enough import LEAST_PARTS, LEAST_PATCHES, require_enough
from lensmodel.estimation.patches.rmap import r_map
from lensmodel.estimation.patches.select import RMapSelector, Selector, select, selectors
from lensmodel.estimation.patches.selector import REASONS, Patch, Reason, Rejection, Selection

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
