"""Blind PSFs of real lenses against what was measured on the very photo: judges that nobody simulated.

    python -m lab.outside $LENSMODEL_TEST_DATA/psf/starfield_a.tiff --aperture 2.8

Stars are points: they are measured, and the lens is learned from the same photo as from any other. Cells
where stars seem far wider than elsewhere hold pairs or trails, and are left out.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from lab.kernels import distance
from lensmodel.blind import sampling
from lensmodel.core.psf import delta, rms_width
from lensmodel.core.types import LensSettings
from lensmodel.measured.points import Points
from lensmodel.model import LensModel
from lensmodel.photo import develop

SIZE: Final = 31
_WIDEST: Final = 2.5  # times the median width (chosen): wider cells hold no single stars


class Judged(NamedTuple):
    """A green PSF at one place of a photo: the stars of a cell against the blind model; relative L2."""

    r: float
    distance: float
    told: float  # what the model expects it to be
    error: float  # of the measurement, as it expects
    point: float  # of a lens without blur
    measured_px: float  # r.m.s. widths along one axis
    blind_px: float


def judged(path: Path, settings: LensSettings) -> Iterator[Judged]:
    """Measure the stars of a photo, learn its lens from it blindly, and compare cell by cell."""
    photo = develop(path)
    said = photo.info.metadata.settings(settings)
    stars = Points().measure([photo], size=SIZE, channels=("g",), settings=said)
    samples = sampling.samples_of_photo(path, sampling.configured("default", settings), workers=1)
    model, green = LensModel.fit(samples), settings.with_channel("g")
    widths = [rms_width(star.kernel) for star in stars]
    for star, width in zip(stars, widths, strict=True):
        if width > _WIDEST * np.median(widths):
            continue
        answer = model.query(star.position, green, SIZE)
        found, point = (distance(kernel, star.kernel).rel_l2 for kernel in (answer.kernel, delta(SIZE)))
        errors = (found, answer.predicted_error, star.error or 0.0, point)
        yield Judged(star.position.r, *errors, width, rms_width(answer.kernel))


def main() -> None:
    """Print a row for each cell with stars, and the medians."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("photos", type=Path, nargs="+", metavar="PHOTO")
    parser.add_argument("--aperture", type=float, help="where the photos do not say it")
    asked = parser.parse_args()
    print("| photo | r | relative L2 | told | of the stars | of a point | width of stars, px | blind |")
    print("|---|---|---|---|---|---|---|---|")
    for path in asked.photos:
        rows = sorted(judged(path, LensSettings(aperture=asked.aperture)))
        for row in rows:
            print(f"| {path.name} | " + " | ".join(f"{value:.2f}" for value in row) + " |")
        middle = float(np.median([row.distance for row in rows]))
        print(f"{path.name}: median {middle:.2f} of {len(rows)} places")


if __name__ == "__main__":
    main()
