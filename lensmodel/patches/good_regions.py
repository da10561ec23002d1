"""Good regions in the spirit of Hu and Yang: how well a window's kernel will be estimated, learned."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.patches.windows import Windows

MODEL: Final = Path(__file__).parent / "data" / "good_regions.npz"

FEATURES: Final = 27  # columns that `features_of` makes


def features_of(windows: Windows) -> NDArray[np.float64]:
    """Numbers of windows, `(n, FEATURES)`, finite: decimal logarithms over noise, the same if turned."""

    def log(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.log10(np.maximum(values, 1e-3))

    bands = windows.information / np.log(10.0)
    by_band = np.stack([bands.mean(axis=2), bands.min(axis=2), bands.max(axis=2), bands.std(axis=2)], axis=2)
    columns = [
        log(np.sort(windows.directions, axis=1)).T,
        log(windows.eigenvalues).T,
        log(windows.contrast),
        windows.level,
        log(windows.level / windows.sigma),
        windows.r_mean,
        windows.r_kept,
        by_band.reshape(len(windows), -1).T,
    ]
    return np.vstack(columns).T


@cache
def learned() -> tuple[NDArray[np.float64], float]:
    """Weights of the features, `(FEATURES,)`, and the offset."""
    with np.load(MODEL, allow_pickle=False) as stored:
        return stored["weights"], float(stored["offset"])


@dataclass(frozen=True, slots=True)
class GoodRegionsSelector:
    """Predicts from the window's features how similar an estimated kernel will be to the truth.

    With S the normalised cross-correlation of an estimated and the true kernel at the best shift, ln(1 - S)
    is a linear function of the features; the score is S. In the spirit of Z. Hu and M.-H. Yang, "Good regions
    to deblur", ECCV 2012, with differences: windows instead of pixels under a conditional random field, lens
    blur instead of camera shake, the statistics that the r-map selector also uses.
    """

    def score(self, windows: Windows) -> NDArray[np.float64]:
        """Return one score a window; see `Selector`."""
        weights, offset = learned()
        return np.clip(1.0 - np.exp(features_of(windows) @ weights + offset), 0.0, 1.0)
