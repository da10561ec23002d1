"""Limit a correction to what a JPEG can hold: coarse finest detail, chroma often at half resolution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.numerics import jit
from lensmodel.core.types import CHANNELS, Planes
from lensmodel.photo import LinearPhoto
from lensmodel.photo.colour import curves_of, inverse

_LUMA: Final = np.array([0.299, 0.587, 0.114], dtype=np.float32)
"""Weights of r, g, b in luma: ITU-R BT.601, as JFIF 1.02 requires."""

_PAIRED: Final = np.array([1.0, 4.0, 6.0, 4.0, 1.0], dtype=np.float32) / np.float32(16.0)
"""Response to one pixel when pairs of pixels are stored as their mean and interpolated linearly: the mean
over the two places that it can have in its pair."""

_FINEST: Final = np.array([1.0, -6.0, 15.0, 44.0, 15.0, -6.0, 1.0], dtype=np.float32) / np.float32(64.0)
"""1 - sin^6(pi f) along an axis: 0.88 of a correction stays at 0.25 cycles/pixel, 0.50 at 0.35, none at 0.5.

The highest coefficients of a block are rounded to about twice the steps of the middle ones, a camera's
denoising takes what is left of them, and a blur's transfer function is smallest there: of a period of two
pixels a correction makes the rounding of one coefficient, seen as a comb."""


Tables = tuple[NDArray[np.float32], ...]


@dataclass(frozen=True, slots=True, eq=False)
class StoredColour:
    """How a file stores colour."""

    step: tuple[int, int]  # rows and columns of pixels that share one value of chroma; powers of two
    curves: Tables  # linear light of 65536 evenly spaced file values, by channel
    tables: Tables  # the inverses, of `photo.colour.inverse`

    @classmethod
    def of(cls, step: tuple[int, int], curves: Sequence[NDArray[np.float32]]) -> StoredColour:
        """Make one from the curves of a file."""
        if len(curves) != len(CHANNELS) or any(size < 1 or size & (size - 1) for size in step):
            raise InvalidInputError(
                f"chroma needs three curves and steps that are powers of two, got {len(curves)} and {step}"
            )
        return cls(step, tuple(curves), tuple(inverse(curve) for curve in curves))

    @classmethod
    def of_photo(cls, photo: LinearPhoto) -> StoredColour | None:
        """How the file of a photo stores colour; `None` for a file that is not a JPEG."""
        if photo.info.kind != "jpeg":
            return None
        return cls.of(photo.chroma_step, curves_of(photo.encoding.transfer, photo.encoding.icc))

    def held(self, photo: Planes, restored: Planes) -> Planes:
        """Keep of a correction what the file can show of luma and of chroma.

        With Y and C luma and chroma of file values, F what is kept of the finest detail, and H what the
        file's resolution leaves of chroma::

            Y = Y(photo) + F ( Y(restored) - Y(photo) ),   C = C(photo) + H F ( C(restored) - C(photo) )

        A correction assumes that each colour was measured at every pixel. In a JPEG that holds for luma
        alone: the finest detail of red and blue is that of luma, and colour that a correction adds to it
        comes from rounding and from errors of the kernels, and shows as coloured pixels.
        """
        before, change = np.empty(photo.shape, np.float32), np.empty(photo.shape, np.float32)
        _values(photo, self.tables, before)
        _values(restored, self.tables, change)
        change -= before
        for axis in (-2, -1):
            change = ndimage.convolve1d(change, _FINEST, axis=axis, mode="nearest")
        luma = np.tensordot(_LUMA, change, axes=1)
        # the same linear filter on all three differences: their weighted sum stays zero, and luma what it is
        chroma = self.shown(change - luma)
        _light(before, luma, chroma, self.curves)
        return before

    def shown(self, chroma: NDArray[np.float32]) -> NDArray[np.float32]:
        """Chroma `(..., rows, cols)` as finely as the file shows it."""
        for axis, size in zip((-2, -1), self.step, strict=True):
            for _ in range(size.bit_length() - 1):
                chroma = ndimage.convolve1d(chroma, _PAIRED, axis=axis, mode="nearest")
        return chroma


@jit
def _values(planes: Planes, tables: Tables, out: Planes) -> None:
    """File values of linear light, as `photo.colour.encode` finds them."""
    for c in range(planes.shape[0]):
        table = tables[c]
        last = np.float32(table.size - 1)
        for i in range(planes.shape[1]):
            for j in range(planes.shape[2]):
                light = min(max(planes[c, i, j], np.float32(0.0)), np.float32(1.0))
                out[c, i, j] = table[np.int32(np.sqrt(light) * last + np.float32(0.5))]


@jit
def _light(values: Planes, luma: NDArray[np.float32], chroma: Planes, curves: Tables) -> None:
    """Linear light of file values and their changes, between the codes of the curves, in place."""
    for c in range(values.shape[0]):
        curve = curves[c]
        last = np.float32(curve.size - 1)
        for i in range(values.shape[1]):
            for j in range(values.shape[2]):
                value = values[c, i, j] + luma[i, j] + chroma[c, i, j]
                at = min(max(value, np.float32(0.0)), np.float32(1.0)) * last
                k = min(np.int32(at), np.int32(curve.size - 2))
                values[c, i, j] = curve[k] + (at - np.float32(k)) * (curve[k + 1] - curve[k])
