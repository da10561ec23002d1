"""Names of the files that workers and their tasks exchange."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

KERNELS: Final = "kernels.npy"
"""Kernels, one a row: `(n, k, k)`."""

SAMPLES: Final = "samples.json"
"""Position, settings, weight and origin of each kernel."""

ENCODED: Final = "encoded.npy"
"""What patches say without a kernel, one a row."""

CLEANED: Final = "cleaned"
"""The file of a photo without the place where it was taken."""

REPORT: Final = "report.json"
"""The report of a lens test."""

R_MAP: Final = "r-map.png"
"""Where the edges of a developed photo tell about the blur, by `app.blobs.small_pictures`."""

THUMBNAIL: Final = "glance.jpg"
"""Small picture of a photo before it is developed, by `app.blobs.small_pictures`; stored ones too."""

SHOWN: Final = "shown.tiles"
"""The developed photo in full size, by `app.blobs.tiles`."""

SIDES: Final[Mapping[str, str]] = {"before": "before.tiles", "after": "after.tiles"}
"""A whole photo before and after its correction, by `app.blobs.tiles`."""

LAYER_FILES: Final[Mapping[str, str]] = {
    "before": "before.png",
    "after": "after.png",
    "smooth": "smooth.png",
    "clean": "clean.png",
}
"""A part of a photo before and after its correction; for sliders also without texture or grain."""

SUFFIX: Final[Mapping[str, str]] = {
    "tiff16": ".tif",
    "png16": ".png",
    "png8": ".png",
    "jpeg": ".jpg",
    "dng": ".dng",
}
"""Ending of a corrected file, by its format."""
