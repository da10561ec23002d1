"""Lateral colour found in photographs that were given a known one, beside Hugin's tca_correct.

    LENSMODEL_TEST_DATA=... python -m lensmodel.lab.correction.lateral_colour

Prints, for red and blue, the shift in pixels at two radii: true, ours, and Hugin's where tca_correct is
installed (Debian: hugin-tools).
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.geometry import Frame
from lensmodel.core.types import Channel
from lensmodel.photo.lateral import estimate_lateral
from lensmodel.quality.images import to_srgb
from lensmodel.simulate import load_scene

TRUE: dict[Channel, tuple[float, float, float]] = {"r": (0.0004, 0.0, 1.0006), "b": (-0.0003, 0.0, 0.9992)}
"""b, c and v of r (v + c r + b r²), r in halves of the shorter side, as Hugin has them."""
PHOTOS = ("s10", "s05", "s17")
RADII = (0.5, 0.9)  # of the field (chosen): half way, and near the corner


def shift(terms: tuple[float, ...], r: float, frame: Frame) -> float:
    """Pixels by which r (v + c r + b r² + a r³) moves a point at field radius r outwards."""
    half, short = frame.half_diagonal, min(frame.height, frame.width) / 2
    at = r * half / short
    return (sum(term * at**power for power, term in enumerate(reversed(terms))) - 1.0) * r * half


def warped(plane: NDArray[np.float32], terms: tuple[float, ...]) -> NDArray[np.float32]:
    """Sample a plane at r (v + c r + b r²)."""
    height, width = plane.shape
    rows, cols = np.mgrid[:height, :width]
    middle = (height - 1) / 2, (width - 1) / 2
    r = np.hypot(rows - middle[0], cols - middle[1]) / (min(height, width) / 2)
    factor = terms[2] + terms[1] * r + terms[0] * r * r
    places = [middle[0] + (rows - middle[0]) * factor, middle[1] + (cols - middle[1]) * factor]
    return ndimage.map_coordinates(plane, places, order=3, mode="nearest").astype(np.float32)


def hugin(planes: NDArray[np.float32]) -> dict[str, tuple[float, ...]] | None:
    """What tca_correct finds: a, b, c and v of red and blue."""
    if shutil.which("tca_correct") is None:
        return None
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "photo.tif"
        encoded = np.round(np.moveaxis(to_srgb(planes), 0, -1) * 65535).astype(np.uint16)
        tifffile.imwrite(path, encoded, photometric="rgb")
        done = subprocess.run(
            ["tca_correct", "-o", "abcv", path], check=False, capture_output=True, text=True, cwd=name
        )
    found = re.search(r"-r (\S+):(\S+):(\S+):(\S+) -b (\S+):(\S+):(\S+):(\S+)", done.stdout)
    if found is None:
        return None
    numbers = [float(word) for word in found.groups()]
    return {"r": tuple(numbers[:4]), "b": tuple(numbers[4:])}


def main() -> None:
    """Measure and print."""
    folder = Path(os.environ["LENSMODEL_TEST_DATA"]) / "sharp"
    print("| photo | channel | r | true | ours | Hugin |\n|---|---|---|---|---|---|")
    for name in PHOTOS:
        planes = load_scene(next(folder.glob(f"{name}_*"))).copy()
        frame = Frame(planes.shape[1], planes.shape[2])
        planes[0], planes[2] = warped(planes[0], TRUE["r"]), warped(planes[2], TRUE["b"])
        grain = 0.002 * np.random.default_rng(1).standard_normal(planes.shape)
        planes = np.clip(planes + grain, 0.0, 1.0).astype(np.float32)
        ours, theirs = estimate_lateral(planes, frame), hugin(planes)
        for channel, terms in TRUE.items():
            for r in RADII:
                other = "-" if theirs is None else f"{shift(theirs[channel], r, frame):+.2f}"
                print(
                    f"| {name} | {channel} | {r} | {-shift(terms, r, frame):+.2f} "
                    f"| {ours.displacement(r, channel):+.2f} | {other} |"
                )


if __name__ == "__main__":
    main()
