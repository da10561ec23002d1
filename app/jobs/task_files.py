"""Names of the files that workers and their tasks exchange."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

KERNELS: Final = "kernels.npy"  # kernels, one a row: `(n, k, k)`
SAMPLES: Final = "samples.json"  # position, settings, weight and origin of each kernel
ENCODED: Final = "encoded.npy"  # what patches say without a kernel, one a row
CLEANED: Final = "cleaned"  # the file of a photo without the place where it was taken
REPORT: Final = "report.json"  # the report of a lens test
# Small picture of a photo before it is developed, by `app.blobs.small_pictures`; stored ones too
THUMBNAIL: Final = "glance.jpg"
SHOWN: Final = "shown.tiles"  # the developed photo in full size, by `app.blobs.tiles`
# A whole photo before and after its correction, by `app.blobs.tiles`
SIDES: Final[Mapping[str, str]] = {"before": "before.tiles", "after": "after.tiles"}
# A part of a photo before and after its correction; for sliders also without texture or grain
LAYER_FILES: Final[Mapping[str, str]] = {
    "before": "before.png",
    "after": "after.png",
    "smooth": "smooth.png",
    "clean": "clean.png",
}
# Ending of a corrected file, by its format
SUFFIX: Final[Mapping[str, str]] = {
    "tiff16": ".tif",
    "png16": ".png",
    "png8": ".png",
    "jpeg": ".jpg",
    "dng": ".dng",
}
