"""A solved kernel without its specks, and the estimate that it is."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.blind.estimator import PsfEstimate, finished
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import as_kernel
from lensmodel.core.types import Kernel

_EIGHT_NEIGHBOURS = np.ones((3, 3), dtype=np.int_)  # pixels that touch at a corner belong together


def cleaned(kernel: NDArray[np.float64], threshold: float, least_mass: float = 0.0) -> Kernel:
    """Drop values below `threshold` times the peak and islands below `least_mass` of the sum.

    Not centred. The largest island always stays.
    """
    kept = np.maximum(kernel, 0.0)
    if not kept.max() > 0:
        raise NotEnoughEvidenceError("the kernel vanished; the patches hold no detail beyond the noise")
    kept = np.where(kept >= threshold * kept.max(), kept, 0.0)
    if least_mass > 0.0:
        label, count = ndimage.label(kept > 0, _EIGHT_NEIGHBOURS)
        mass = np.bincount(label.ravel(), weights=kept.ravel(), minlength=count + 1)
        mass[0] = 0.0
        heavy = mass >= min(least_mass * float(mass.sum()), float(mass.max()))
        heavy[0] = False
        kept = np.where(heavy[label], kept, 0.0)
    return as_kernel(kept)


def unsure(kernel: Kernel, size: int) -> PsfEstimate:
    """An estimate of odd side `size` whose method does not say how far it is off."""
    return finished(kernel, size=size, error=math.nan, diagnostics={})
