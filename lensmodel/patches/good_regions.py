"""Good regions to deblur, after Hu and Yang: windows scored by boosted trees."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.patches.windows import Details, Windows

MODEL: Final = Path(__file__).parent / "data" / "good_regions.npz"

FEATURES: Final = 34  # columns that `features_of` makes


def features_of(windows: Windows, looked: Details) -> NDArray[np.float64]:
    """What a window looks like, in numbers, `(n, FEATURES)`, always finite.

    Directions are sorted by energy, so that a turned window has the same features. Energies and
    powers are decimal logarithms over noise.
    """

    def log(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.log10(np.maximum(values, 1e-3))

    share = windows.directions / np.maximum(windows.directions.sum(axis=1, keepdims=True), 1e-9)
    entropy = -(share * np.log(np.maximum(share, 1e-9))).sum(axis=1)
    bands = looked.information / np.log(10.0)
    means = bands.mean(axis=2)
    by_band = np.stack([means, bands.min(axis=2), bands.max(axis=2), bands.std(axis=2)], axis=2)
    columns = [
        log(np.sort(windows.directions, axis=1)).T,
        entropy,
        log(windows.eigenvalues).T,
        windows.eigenvalues[:, 0] / np.maximum(windows.eigenvalues[:, 1], 1e-9),
        log(windows.contrast),
        windows.level,
        log(windows.level / windows.sigma),
        windows.r_mean,
        windows.r_kept,
        windows.clipped,
        windows.dark,
        by_band.reshape(len(windows), -1).T,
        np.diff(means, axis=1).T,
        log(looked.blob.astype(np.float64)),
    ]
    return np.vstack(columns).T


@dataclass(frozen=True, slots=True, eq=False)
class TreeEnsemble:
    """Sum of regression trees, as plain arrays."""

    start: float  # value before the first tree
    feature: NDArray[np.int16]  # (trees, nodes), column that an inner node asks for; -1 at a leaf
    threshold: NDArray[np.float32]  # (trees, nodes), values up to it go left
    left: NDArray[np.int16]  # (trees, nodes), numbers of the children; a leaf points to itself
    right: NDArray[np.int16]
    value: NDArray[np.float32]  # (trees, nodes), what a leaf adds, the learning rate included

    @classmethod
    @cache
    def load(cls, path: Path = MODEL) -> TreeEnsemble:
        """Read arrays of these names from an .npz file, once a process; nothing is unpickled."""
        with np.load(path, allow_pickle=False) as stored:
            parts = {name: stored[name] for name in ("feature", "threshold", "left", "right", "value")}
            return cls(start=float(stored["start"]), **parts)

    def predict(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """Evaluate at rows of features, `(n,)`; all trees of all rows go down one step at a time."""
        n, trees = len(features), np.arange(len(self.feature))
        values = features.astype(np.float32)
        node = np.zeros((n, len(trees)), dtype=np.intp)
        rows = np.arange(n)[:, None]
        while True:
            column = self.feature[trees, node]
            inner = column >= 0
            if not inner.any():
                return self.start + self.value[trees, node].sum(axis=1, dtype=np.float64)
            goes_left = values[rows, np.maximum(column, 0)] <= self.threshold[trees, node]
            node = np.where(goes_left, self.left[trees, node], self.right[trees, node]).astype(np.intp)


@dataclass(frozen=True, slots=True)
class GoodRegionsSelector:
    """Predicts from the window's features how similar an estimated kernel will be to the truth.

    With S the normalised cross-correlation of an estimated and the true kernel at the best shift, the
    ensemble predicts ln(1 - S); the score is S. In the spirit of Z. Hu and M.-H. Yang, "Good regions to
    deblur", ECCV 2012, with differences: windows instead of pixels under a conditional random field, lens
    blur instead of camera shake, boosted trees on the statistics that the r-map selector also uses.
    """

    def score(self, windows: Windows, looked: Details) -> NDArray[np.float64]:
        """Return one score a window; see `Selector`."""
        return np.clip(1.0 - np.exp(TreeEnsemble.load().predict(features_of(windows, looked))), 0.0, 1.0)
