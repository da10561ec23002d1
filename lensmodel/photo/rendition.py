"""White balance as the camera applied it, out of its own JPEG of the photo.

Some cameras (the EOS D30 with automatic white balance) write no multipliers into their RAW files. What
they chose stands in the JPEG that the same file holds.
"""

from __future__ import annotations

import io
from typing import Final

import numpy as np
import rawpy
from numpy.typing import NDArray
from PIL import Image

from lensmodel.photo.colour import Matrix, srgb_to_linear
from lensmodel.photo.mosaic import Mosaic
from lensmodel.photo.raster import UNDECODABLE, unwarned

Grid = NDArray[np.float64]
"""Means over blocks, `(row, col, colour)`."""

_BLOCKS: Final = 96
"""Blocks along the longer side: a few pixels of misplacement do not matter then, and 6,000 are enough."""

_SMALLEST_JPEG: Final = 2 * _BLOCKS  # pixels; the shorter side may have half, one to a block (chosen)
_MOST_JPEG_PIXELS: Final = 64_000_000  # against files made to fill the memory: so many take 200 MB (chosen)
_ASPECT: Final = 0.03
"""How much the shapes of the two may differ: JPEGs lack the rim that demosaicing needs."""

_LIKENESS: Final = 0.8
"""Least correlation of the lightness of both; a JPEG of something else stays far below."""

_MIDTONES: Final = (0.15, 0.8)
"""Numbers of the JPEG, full is 1, in which a camera's tone curve is nearest to sRGB."""

_UNCLIPPED: Final = 0.5  # largest mean of a block, full is 1 (chosen): leaves brighter pixels room
_NEUTRAL: Final = 1.6
"""Largest over smallest of the linear colours: curves and saturation settings change strong colours more."""

_LEAST_BLOCKS: Final = 24
"""Fewer near-neutral blocks than this may all be of one object that is not grey."""


def balance_of_rendition(
    raw: rawpy.RawPy, mosaic: Mosaic | None, to_srgb: Matrix | None
) -> tuple[float, float] | None:
    """Estimate the white balance from the JPEG that the camera put beside its RAW data.

    With J the JPEG in linear light, C the matrix from balanced camera colours to sRGB, and s the means of
    the sensor over the same block, the multipliers of red and blue relative to green are::

        m_k = median over near-neutral blocks of (C^-1 J)_k s_g / ((C^-1 J)_g s_k)
    """
    if mosaic is None or not mosaic.is_bayer or (picture := _jpeg_of(raw)) is None:
        return None
    sites = mosaic.sites(mosaic.white)
    if len(sites) != 3:
        return None
    height, width = sites[0].shape
    rows, cols = round(_BLOCKS * height / max(height, width)), round(_BLOCKS * width / max(height, width))
    if min(rows, cols) < 8 or min(height, width) < _SMALLEST_JPEG // 2:
        return None
    if abs(np.log(picture.width * height / (picture.height * width))) > _ASPECT:
        return None
    numbers = np.asarray(picture.resize((4 * cols, 4 * rows), Image.Resampling.BOX), dtype=np.float64) / 255.0
    sensor = np.stack([_block_means(site[:, :, None], rows, cols)[..., 0] for site in sites], axis=-1)
    shown = _block_means(srgb_to_linear(numbers), rows, cols)
    return _balance(_block_means(numbers, rows, cols), shown, sensor, to_srgb)


def _balance(numbers: Grid, shown: Grid, sensor: Grid, to_srgb: Matrix | None) -> tuple[float, float] | None:
    picture, values = (np.sqrt(np.maximum(grid[..., 1], 0.0)).ravel() for grid in (shown, sensor))
    if min(float(picture.std()), float(values.std())) < 1e-6:
        return None
    if float(np.corrcoef(picture, values)[0, 1]) < _LIKENESS:
        return None
    most = numbers.max(axis=-1)
    used = (most > _MIDTONES[0]) & (most < _MIDTONES[1]) & (sensor.max(axis=-1) < _UNCLIPPED)
    used &= (shown.max(axis=-1) < _NEUTRAL * shown.min(axis=-1)) & (sensor.min(axis=-1) > 0.0)
    balanced = shown[used] if to_srgb is None else shown[used] @ np.linalg.inv(to_srgb).T
    part = sensor[used][balanced.min(axis=-1) > 0.0]
    balanced = balanced[balanced.min(axis=-1) > 0.0]
    if len(part) < _LEAST_BLOCKS:
        return None
    red, green, blue = (balanced / part).T
    return float(np.median(red / green)), float(np.median(blue / green))


def _jpeg_of(raw: rawpy.RawPy) -> Image.Image | None:
    """Decode the embedded JPEG, scaled down where it is large; `None` without a sound one."""
    try:
        thumb = raw.extract_thumb()
        if thumb.format != rawpy.ThumbFormat.JPEG or not isinstance(thumb.data, bytes):
            return None
        with unwarned():
            picture = Image.open(io.BytesIO(thumb.data), formats=("JPEG",))
            if picture.width * picture.height > _MOST_JPEG_PIXELS or min(picture.size) < _SMALLEST_JPEG // 2:
                return None
            picture.draft("RGB", (4 * _BLOCKS, 4 * _BLOCKS))
            return picture.convert("RGB") if picture.mode in {"RGB", "L"} else None
    except (rawpy.LibRawError, *UNDECODABLE):
        return None


def _block_means(values: NDArray[np.floating], rows: int, cols: int) -> Grid:
    """Means over `rows` x `cols` blocks that cover the whole, none of them empty."""
    height, width = values.shape[:2]
    tops, lefts = np.arange(rows) * height // rows, np.arange(cols) * width // cols
    sums = np.add.reduceat(np.add.reduceat(values.astype(np.float64), tops, axis=0), lefts, axis=1)
    counts = np.diff(np.append(tops, height))[:, None] * np.diff(np.append(lefts, width))[None, :]
    return np.asarray(sums / counts[:, :, None])
