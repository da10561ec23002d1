"""Sharpness: slanted edges and MTF."""

from lensmodel.quality.edge_finder import find_edges
from lensmodel.quality.mtf import (
    EdgeResponse,
    crossing,
    mtf50_from_kernel,
    mtf_from_kernel,
    slanted_edge,
    tangential_sagittal_mtf50,
)

__all__ = [
    "EdgeResponse",
    "crossing",
    "find_edges",
    "mtf50_from_kernel",
    "mtf_from_kernel",
    "slanted_edge",
    "tangential_sagittal_mtf50",
]
