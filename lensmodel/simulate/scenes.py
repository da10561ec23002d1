"""Scenes for the simulated camera: photographs that come with the source tree, or any other.

Every scene is `Planes` in white-balanced linear light. Charts are in `charts`.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from lensmodel.core.errors import InvalidInputError, NotAnImageError
from lensmodel.core.types import Planes

DEMO_SCENES: Final = ("city", "colosseum", "lake", "spices", "tea-gardens")
"""Names of the photographs that come with the library, see lensmodel/demo_data/README.md."""


def srgb_to_linear(values: NDArray[np.floating]) -> NDArray[np.float32]:
    """Undo the sRGB curve (IEC 61966-2-1) on values in 0..1."""
    v = np.asarray(values, dtype=np.float32)
    high = ((np.maximum(v, 0.04045) + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    return np.where(v <= 0.04045, v / np.float32(12.92), high).astype(np.float32)


def load_scene(path: str | Path) -> Planes:
    """Load an sRGB photograph (PNG, JPEG, TIFF of 8 bits) as linear light."""
    try:
        with Image.open(path) as image:
            coded = np.asarray(image.convert("RGB"), dtype=np.uint8)
    except UnidentifiedImageError as error:
        raise NotAnImageError(f"{Path(path).name} is no image that can serve as a scene") from error
    table = srgb_to_linear(np.arange(256) / 255.0)
    return np.ascontiguousarray(table[coded].transpose(2, 0, 1))


def demo_data_path(name: str) -> Path:
    """Path of a file of `lensmodel/demo_data`; see its README for origin and licences."""
    folder = resources.files("lensmodel") / "demo_data"
    known = sorted(entry.name for entry in folder.iterdir()) if folder.is_dir() else []
    if not set(known) - {"README.md"}:
        raise InvalidInputError(
            f"the demo photograph {name!r} is not part of an installed package; get the source tree and run "
            "`make demo` there"
        )
    if name not in known:
        raise InvalidInputError(f"no demo file {name!r}; known: {', '.join(known)}")
    return Path(str(folder / name))


def demo_scene(name: str) -> Planes:
    """Photograph of `DEMO_SCENES` as linear light, `(3, H, W)`."""
    if name not in DEMO_SCENES:
        raise InvalidInputError(f"no demo scene {name!r}; known: {', '.join(DEMO_SCENES)}")
    return load_scene(demo_data_path(f"{name}.jpg"))
