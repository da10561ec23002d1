"""Measure how the spectra of sharp windows spread: the scene prior of the blind estimator `default`.

    python -m lensmodel.lab.training.make_scene_spectra PHOTOS

PHOTOS is a folder of sharp photographs, of which those of the development half are taken; up to sixteen
windows of each, chosen as in the benchmark. Prints the entry `window` of lensmodel/scene/data/fitted.json.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.spectrum import RINGS, SECTORS, binned_spectrum
from lensmodel.core.types import NoiseModel
from lensmodel.lab.cases import good_corners, list_photos, photo_half, scene_of
from lensmodel.scene.prior import FIRST_WINDOW_RING, LEAST_POWER, WINDOW_SHAPES

_PATCH, _MARGIN, _WINDOWS = 256, 27, 16  # pixels, half a kernel, of each photo: as in the benchmark
_SILENT = NoiseModel.white(1e-6)  # noise of the photographs themselves: taken for none


def log_spectra(photos: Sequence[Path]) -> NDArray[np.float64]:
    """Log power of sharp windows and of their mirror images, shape (n, rings x SECTORS)."""
    found = []
    for photo in photos:
        green = scene_of(photo)[1]
        corners = good_corners(photo, _PATCH, _MARGIN)
        for at in np.random.default_rng(0).permutation(len(corners))[:_WINDOWS]:
            row, col = corners[int(at)]
            power, _ = binned_spectrum(green[row : row + _PATCH, col : col + _PATCH], _SILENT)
            seen = np.log(np.maximum(power[FIRST_WINDOW_RING:].astype(np.float64), LEAST_POWER))
            found += [seen.ravel(), seen[:, ::-1].ravel()]
    return np.array(found)


def measured(photos: Sequence[Path]) -> dict[str, NDArray[np.float64]]:
    """Return the arrays that `WindowPrior` is made of, by name."""
    seen = log_spectra(photos)
    fitted = np.linalg.lstsq(WINDOW_SHAPES, seen.T, rcond=None)[0].T
    usual, spread = np.median(fitted, axis=0), np.cov(fitted.T)
    usual[[4, 6, 8]] = 0.0  # scenes lean to neither side
    spread[0, :] = spread[:, 0] = 0.0
    left = (seen - fitted @ WINDOW_SHAPES.T).reshape(len(seen), RINGS - FIRST_WINDOW_RING, SECTORS)
    bias = np.median(left.mean(axis=2), axis=0)
    roughness = 1.4826 * np.median(np.abs(left - bias[:, None]), axis=(0, 2))
    return {"usual": usual, "spread": spread, "bias": bias, "roughness": roughness}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("photos", type=Path)
    asked = parser.parse_args()
    learned = measured([p for p in list_photos(asked.photos) if photo_half(p.stem) == "dev"])
    print(json.dumps({"window": {name: values.tolist() for name, values in learned.items()}}))


if __name__ == "__main__":
    main()
