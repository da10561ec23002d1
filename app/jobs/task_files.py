"""How workers and their tasks hand things to each other: names of files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

KERNELS: Final = "kernels.npy"
"""Kernels, one a row: `(n, k, k)`."""

SAMPLES: Final = "samples.json"
"""What else belongs to each of the kernels."""

FAMILY: Final = "family"
"""Folder of the samples of other copies that the model leans on; not there without any."""

LEARNED: Final = "learned.npz"
"""What a model has learned from the samples."""

REPORT: Final = "report.json"
"""What a lens test found of a model."""

PREVIEW: Final = "preview.jpg"
R_MAP: Final = "r-map.png"
"""What `app.blobs.previews` makes of a developed photo."""

GLANCE: Final = "glance.jpg"
"""What `app.blobs.glances` makes of a photo that is not developed yet."""

SHOWN: Final = "shown.jpg"
"""The developed photo in full size, as a screen shows it, in sensor orientation."""

BEFORE: Final = "before.jpg"
AFTER: Final = "after.jpg"
"""What a corrected file shows, as it was before and as it is, for the screen, in sensor orientation."""

LAYERS: Final = ("smooth.png", "clean.png")
"""A part of a photo corrected without its faint texture, and without its grain: what sliders mix."""

SUFFIX: Final[Mapping[str, str]] = {
    "tiff16": ".tif",
    "png16": ".png",
    "png8": ".png",
    "jpeg": ".jpg",
    "dng": ".dng",
}
"""Ending of a corrected file, by its format."""
