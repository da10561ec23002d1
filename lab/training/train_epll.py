"""Fit the Gaussian mixture of the EPLL judge to sharp photographs.

Run as ``python -m lab.training.train_epll FOLDER OUT.npz NAME...`` with the stems of the photos
to use. The shipped mixture was fitted to development photos of the split only.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.simulate import load_scene

SIDE: Final = 8  # pixels of a window, as in the paper
WHITE: Final = 0.9  # level of the 99.5 percentile, as in `lab.cases`
_LEAST_PAST_THE_MIDDLE = 3  # arguments: a folder, a file, a photograph


def windows_of(photo: Path, count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Random windows of one photo's green plane, zero-mean, `(count, SIDE²)`.

    The plane is scaled like a benchmark scene: 99.5 percentile at 0.9. Half of the windows are
    drawn in proportion to their contrast, or flat sky would be most of the mixture.
    """
    plane = load_scene(photo)[1]
    plane = plane * np.float32(WHITE / max(float(np.percentile(plane, 99.5)), 1e-3))
    view = np.lib.stride_tricks.sliding_window_view(plane, (SIDE, SIDE))
    at = rng.integers(0, (view.shape[0], view.shape[1]), size=(4 * count, 2))
    windows = view[at[:, 0], at[:, 1]].reshape(-1, SIDE * SIDE).astype(np.float32)
    windows = windows[windows.max(axis=1) < 1.0]
    windows = windows - windows.mean(axis=1, keepdims=True)
    contrast = windows.std(axis=1) + 1e-4
    drawn = rng.choice(len(windows), count // 2, replace=False, p=contrast / contrast.sum())
    return np.concatenate([windows[: count - count // 2], windows[drawn]])


def train_epll(
    photos: Sequence[Path], out: Path, *, components: int = 40, windows: int = 30_000, seed: int = 0
) -> None:
    """Fit the mixture by expectation maximisation and write it."""
    if not photos:
        raise InvalidInputError("no photos to train on; name at least one sharp photograph")
    try:
        from sklearn.mixture import GaussianMixture  # noqa: PLC0415  # needed for training only
    except ImportError as error:
        raise InvalidInputError("training needs scikit-learn; pip install --group lab") from error
    rng = np.random.default_rng(seed)
    data = np.concatenate([windows_of(photo, windows // len(photos), rng) for photo in photos])
    model = GaussianMixture(
        components,
        means_init=np.zeros((components, SIDE * SIDE)),
        init_params="kmeans",
        reg_covar=1e-7,
        tol=2e-2,
        max_iter=12,
        random_state=seed,
    ).fit(data.astype(np.float64))
    # The windows have no mean of their own and neither have the components: it goes into the spread.
    covariances = model.covariances_ + np.einsum("mi,mj->mij", model.means_, model.means_)
    at = np.tril_indices(SIDE * SIDE)
    out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        out,
        weights=model.weights_.astype(np.float32),
        covariances=covariances[:, at[0], at[1]].astype(np.float32),
    )


def main(arguments: Sequence[str]) -> None:
    """Train from the command line: FOLDER OUT NAME..."""
    if len(arguments) < _LEAST_PAST_THE_MIDDLE:
        raise InvalidInputError("usage: train_epll FOLDER OUT.npz NAME...")
    folder, out, *names = arguments
    found = sorted(path for path in Path(folder).iterdir() if path.stem in names)
    train_epll(found, Path(out))


if __name__ == "__main__":
    main(sys.argv[1:])
