"""Step 1, where: the regions of a photo that tell about the PSF, by `rmap`, `good_regions` or `spread`."""

from lensmodel.patches.checks import LEAST_PARTS, LEAST_PATCHES, require_enough
from lensmodel.patches.rmap import r_map
from lensmodel.patches.select import SMALLEST_PATCH, Selector, select, selectors
from lensmodel.patches.windows import Patch, Reason, Selection

__all__ = [
    "LEAST_PARTS",
    "LEAST_PATCHES",
    "SMALLEST_PATCH",
    "Patch",
    "Reason",
    "Selection",
    "Selector",
    "r_map",
    "require_enough",
    "select",
    "selectors",
]
