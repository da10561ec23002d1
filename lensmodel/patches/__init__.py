"""Step 1, where: the regions of a photo that tell about the PSF, by the r-map or by learned good regions."""

from lensmodel.patches.rmap import r_map
from lensmodel.patches.select import Patch, Selection, Selector, select, selectors

__all__ = ["Patch", "Selection", "Selector", "r_map", "select", "selectors"]
