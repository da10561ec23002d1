"""Learn which local spectra occur in sharp photographs: the second scene prior of the estimator `default`.

    python -m lensmodel.lab.training.make_local_spectra PHOTOS

PHOTOS is a folder of sharp photographs, of which those of the development half are taken. Writes
lensmodel/estimation/data/local_spectra.npz; about a minute.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lensmodel import estimation
from lensmodel.core.types import Plane
from lensmodel.estimation.spectra.local_spectra import COUPLED, SpectrumMixture, periodograms
from lensmodel.lab.cases import list_photos, photo_half, scene_of

COMPONENTS, ROUNDS = 128, 25  # and rounds of expectation maximisation (chosen)
_PATCH, _STRIDE = 256, 24  # pixels of a window, and between its tiles (chosen)
_TILES = 40_000  # of all photographs: some 300 a component (chosen)
_FLAT = 0.02  # standard deviation of a window that no selection takes
_SPREAD = 0.3  # of ln gain
_KEPT = 2.0  # tiles by which a component stays what it was
_LEAST = 1e-9  # added to powers: its logarithm stays finite


def tiles_of(photo: Path, rng: np.random.Generator) -> list[Plane]:
    """Windows of a photograph, each turned by some quarters and of unit variance."""
    green = scene_of(photo)[1]
    found = []
    for row in range(0, green.shape[0] - _PATCH + 1, _PATCH // 2):
        for col in range(0, green.shape[1] - _PATCH + 1, _PATCH // 2):
            window = green[row : row + _PATCH, col : col + _PATCH]
            spread = float(window.std())
            if spread > _FLAT:
                turned = np.rot90(window, int(rng.integers(4)))
                found.append((turned[:, ::-1] if rng.random() < 0.5 else turned) / np.float32(spread))
    return found


def learned(photos: Sequence[Path], seed: int = 0) -> SpectrumMixture:
    """Fit the mixture to photographs by expectation maximisation."""
    rng = np.random.default_rng(seed)
    drawn = []
    for photo in photos:
        seen = np.concatenate([periodograms(tile, _STRIDE) for tile in tiles_of(photo, rng)])
        drawn.append(seen[rng.permutation(len(seen))[: _TILES // len(photos)]])
    tiles = np.concatenate(drawn) + _LEAST
    tiles *= np.exp(rng.normal(0.0, _SPREAD, (len(tiles), 1)))
    usual = np.log(tiles.mean(axis=0))
    first = np.log(tiles[rng.choice(len(tiles), COMPONENTS, replace=False)])
    level = first.mean(axis=1, keepdims=True) - usual.mean()
    power = np.exp(0.3 * first + 0.7 * (usual + level))
    share = np.full(COMPONENTS, 1.0 / COMPONENTS)
    for _ in range(ROUNDS):
        scores = np.log(share) - COUPLED * (tiles @ (1.0 / power).T + np.log(power).sum(axis=1))
        own = np.exp(scores - scores.max(axis=1, keepdims=True))
        own /= own.sum(axis=1, keepdims=True)
        count = own.sum(axis=0)
        power = (own.T @ tiles + _KEPT * power) / (count[:, None] + _KEPT)
        share = (count + 0.1) / (count + 0.1).sum()
    return SpectrumMixture(power.astype(np.float32), share.astype(np.float32))


def main() -> None:
    """Learn and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("photos", type=Path)
    parser.add_argument(
        "--output", type=Path, default=Path(estimation.__file__).parent / "data" / "local_spectra.npz"
    )
    asked = parser.parse_args()
    mixture = learned([p for p in list_photos(asked.photos) if photo_half(p.stem) == "dev"])
    np.savez_compressed(asked.output, log_power=np.log(mixture.power).astype(np.float16), share=mixture.share)


if __name__ == "__main__":
    main()
