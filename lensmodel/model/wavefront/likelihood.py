"""How likely patches are behind a lens that was learned without them.

The power spectrum of a patch is that of its scene times |OTF|^2 (`scene_view`). With the scene's few
unknowns fitted to each patch, the better kernel leaves the smaller rest. No kernel that was estimated from
the patch takes part, so that a model is not judged by the mistakes that it shares with the estimator.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import PsfSample
from lensmodel.core.spectrum import SECTORS, bin_frequencies
from lensmodel.core.types import Kernel
from lensmodel.model.wavefront.from_spectra import PATCH_TAILS
from lensmodel.model.wavefront.scene_fit import fit_scene
from lensmodel.model.wavefront.scene_view import SceneView
from lensmodel.optics.transfer import BINS

_FLOOR = (-6.5, 3.0)  # logarithm of what is added to |OTF|^2: whoever sees none may have none (chosen)
_INSIDE = (-1.0 / 3.0, 0.0, 1.0 / 3.0)  # where a bin is sampled, in parts of its width: middles of its thirds


def surprise(sample: PsfSample, kernel: Kernel, share: float = 1.0) -> float:
    """Negative logarithm of the likelihood of a patch with a spectrum behind a kernel, up to a constant.

    `share` narrows the kernel to that part of its width.
    """
    assert sample.spectrum is not None
    view = SceneView.of({sample.settings.channel: sample.spectrum}).with_floor(*_FLOOR)
    nu = PATCH_TAILS * BINS
    return nu * math.log1p(fit_scene(view, _power(kernel, share)[:, None]).cost / nu)


def _power(kernel: Kernel, share: float) -> NDArray[np.float64]:
    """Mean of |OTF|^2 in each bin, shape (BINS,), of a kernel narrowed to a share of its width."""
    rows, cols = _waves(kernel.shape[0], share)
    power = np.abs(((rows @ kernel) * cols).sum(axis=1)) ** 2
    return np.asarray(power.reshape(-1, BINS).mean(axis=0))


@lru_cache(maxsize=8)
def _waves(side: int, share: float) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Waves of nine frequencies in each bin along rows and columns, shape (9 BINS, side)."""
    middle, angle = bin_frequencies()
    wide = float(np.unique(middle)[1] / np.unique(middle)[0])
    t = np.arange(side) - side // 2
    rows, cols = [], []
    for out in _INSIDE:
        for along in _INSIDE:
            modulus, turned = share * middle * wide**out, angle + along * math.pi / SECTORS
            rows.append(np.exp(-2j * np.pi * np.outer(modulus * np.sin(turned), t)))
            cols.append(np.exp(-2j * np.pi * np.outer(modulus * np.cos(turned), t)))
    return np.concatenate(rows), np.concatenate(cols)
