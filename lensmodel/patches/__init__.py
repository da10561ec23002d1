"""Step 1, where: the regions of a photo that tell about the PSF, by `rmap` or `good_regions`."""

from lensmodel.patches.rmap import r_map
from lensmodel.patches.select import (
    LEAST_PARTS,
    LEAST_PATCHES,
    SMALLEST_PATCH,
    Patch,
    Reason,
    Selection,
    Selector,
    require_enough,
    select,
    selectors,
)

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
