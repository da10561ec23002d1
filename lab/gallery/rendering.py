"""Pictures as a viewer sees them: written and read back as files, so that nothing else is judged."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray

from lensmodel.core.types import Planes
from lensmodel.photo import Encoding, write_image

Rendered = NDArray[np.uint16]
"""A picture `(row, col, 3)`, sRGB, 0 to 65535, in sensor orientation."""


def rendered(planes: Planes, encoding: Encoding) -> Rendered:
    """Render linear planes as the program writes them for a viewer: an sRGB TIFF of 16 bits."""
    with tempfile.TemporaryDirectory(prefix="lensmodel-gallery-") as name:
        path = Path(name) / "picture.tif"
        write_image(path, planes, encoding, format="tiff16", color_space="srgb")
        return read_rendered(path)


def read_rendered(path: Path) -> Rendered:
    """Read a TIFF of 16 bits a channel."""
    picture: Rendered = tifffile.imread(path)[..., :3].astype(np.uint16, copy=False)
    return picture
