"""The audit's map of a correction, where the library has an audit."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.photo import LinearPhoto
from lensmodel.types import Planes

AUDIT: Final = "lensmodel.audit"
_TILE: Final = 512
_CONTEXT: Final = 16


def audit_map(developed: LinearPhoto, corrected: Planes) -> NDArray[np.float32] | None:
    """Share of the correction that the audit would keep at each pixel, `(row, col)`; None without an audit.

    Parameters
    ----------
    developed : LinearPhoto
        The original.
    corrected : Planes, shape (3, row, col)
        Linear light.
    """
    if find_spec(AUDIT) is None:
        return None
    audit = import_module(AUDIT)
    evidence = audit.Evidence(noise=developed.noise, clip=developed.clip)
    _, height, width = corrected.shape
    keep = np.ones((height, width), dtype=np.float32)
    for row in range(0, height, _TILE):
        for col in range(0, width, _TILE):
            top, left = max(row - _CONTEXT, 0), max(col - _CONTEXT, 0)
            wide = (slice(None), slice(top, row + _TILE + _CONTEXT), slice(left, col + _TILE + _CONTEXT))
            inner = (
                slice(row - top, min(row + _TILE, height) - top),
                slice(col - left, min(col + _TILE, width) - left),
            )
            found = audit.audit_tile(developed.planes[wide], corrected[wide], evidence, inner=inner)
            keep[row : row + _TILE, col : col + _TILE] = found.keep
    return keep
