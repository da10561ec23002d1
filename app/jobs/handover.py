"""How workers and their tasks hand things to each other: names of files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

KERNELS: Final = "kernels.npy"
"""Kernels, one a row: `(n, k, k)`."""

SAMPLES: Final = "samples.json"
"""What else belongs to each of the kernels."""

EVIDENCE: Final = "evidence-{}.npz"
"""The normal equations of the sample of that number; not there where it has none, or none are wanted."""

FAMILY: Final = "family"
"""Folder of the samples of other copies that the model leans on; not there without any."""

LEARNED: Final = "learned.npz"
"""What a model has learned from the samples."""

PREVIEW: Final = "preview.jpg"
R_MAP: Final = "r-map.png"
"""What `app.previews` makes of a developed photo."""

BEFORE: Final = "before.jpg"
"""What a corrected file shows, as it was before; none for DNG, which is no picture yet."""

SUFFIX: Final[Mapping[str, str]] = {
    "tiff16": ".tif",
    "png16": ".png",
    "png8": ".png",
    "jpeg": ".jpg",
    "dng": ".dng",
}
"""Ending of a corrected file, by its format."""
