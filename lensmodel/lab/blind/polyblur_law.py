"""Fit the law of slopes of `polyblur`: its `c` and `b` in lensmodel/estimation/data/fitted.json.

    python -m lensmodel.lab.blind.polyblur_law [PHOTOS] [--windows 4]

PHOTOS is a folder of sharp photographs, by default that of the library's own; those of the development half
are taken. Steep are the windows whose slopes, when sharp, are steepest in their weakest direction: so many of
each photograph, among those that the benchmark draws from. Each is seen behind round Gaussians of 0.4 to 3 px
with 1 percent noise. Printed are the median slopes over windows and directions, those of the law that fits
them, and those of the law in use.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, signal

from lensmodel.core.psf import gaussian
from lensmodel.core.types import Plane
from lensmodel.estimation.methods.polyblur import Polyblur, directional_slopes
from lensmodel.lab.cases import good_corners, list_photos, photo_half, scene_of

SIGMAS_PX: Final = (0.4, 0.6, 0.8, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0)
"""Widths of the Gaussians (chosen): from a blur that hardly shows to the widest of common lenses."""

_NOISE: Final = 0.01  # of full range: that of the benchmark
_PATCH: Final = 256  # pixels: that of the benchmark
_MARGIN: Final = 13  # pixels around a window: more than four times the widest Gaussian

Floats = NDArray[np.float64]


def steep_windows(photo: Path, count: int) -> list[Floats]:
    """Return the steepest windows of a photograph, shape (282, 282): sharp, with the margin of the blur.

    Parameters
    ----------
    photo : Path
    count : int
        How many; fewer where the photograph has fewer.
    """
    green = scene_of(photo)[1].astype(np.float64)
    steepness = {
        (row, col): directional_slopes(green[row : row + _PATCH, col : col + _PATCH]).min()
        for row, col in good_corners(photo, _PATCH, _MARGIN)
    }
    steepest = sorted(steepness, key=lambda corner: -steepness[corner])[:count]
    reach = _PATCH + _MARGIN
    return [green[row - _MARGIN : row + reach, col - _MARGIN : col + reach] for row, col in steepest]


def slopes_behind(windows: Sequence[Floats], sigma_px: float, rng: np.random.Generator) -> Floats:
    """Slopes that are left of windows behind a round Gaussian, with noise, shape (n, 6).

    Parameters
    ----------
    windows : sequence of ndarray, shape (H, W)
        Sharp, in linear light.
    sigma_px : float
        Standard deviation of the Gaussian in pixels.
    rng : Generator
        For the noise.
    """
    kernel = gaussian(2 * _MARGIN + 1, sigma_px**2 * np.eye(2))
    slopes = []
    for window in windows:
        blurred = signal.fftconvolve(window, kernel, mode="valid")
        seen: Plane = (blurred + rng.normal(0.0, _NOISE, blurred.shape)).astype(np.float32)
        slopes.append(directional_slopes(seen))
    return np.array(slopes)


def law_of(sigmas_px: Floats, slopes: Floats) -> tuple[float, float]:
    """Fit the law m = c / sqrt(s² + b²) in logarithms, by least squares.

    Parameters
    ----------
    sigmas_px, slopes : ndarray, shape (n,)
        s in pixels, and m per pixel.

    Returns
    -------
    c, b : float
        b in pixels.
    """

    def residuals(logs: Floats) -> Floats:
        return np.log(slopes) - logs[0] + 0.5 * np.log(sigmas_px**2 + np.exp(2.0 * logs[1]))

    c, b = np.exp(optimize.least_squares(residuals, np.zeros(2)).x)
    return float(c), float(b)


def main() -> None:
    """Measure, fit and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("photos", type=Path, nargs="?")
    parser.add_argument("--windows", type=int, default=4, help="of each photograph")
    asked = parser.parse_args()
    photos = [photo for photo in list_photos(asked.photos) if photo_half(photo.stem) == "dev"]
    windows = [window for photo in photos for window in steep_windows(photo, asked.windows)]
    rng = np.random.default_rng(0)
    sigmas = np.array(SIGMAS_PX)
    slopes = np.array([np.median(slopes_behind(windows, sigma, rng)) for sigma in SIGMAS_PX])
    c, b = law_of(sigmas, slopes)
    used = Polyblur()
    print(f"{len(windows)} windows of {len(photos)} photographs")
    print("| Gaussian, px | slope | of the fitted law | of the law in use |")
    print("|---|---|---|---|")
    for sigma, slope in zip(SIGMAS_PX, slopes, strict=True):
        fitted, usual = c / np.hypot(sigma, b), used.c / np.hypot(sigma, used.b)
        print(f"| {sigma:g} | {slope:.3f} | {fitted:.3f} | {usual:.3f} |")
    print(f'"polyblur": {{"c": {c:.3f}, "b": {b:.3f}}}; in use: {used.c}, {used.b}')


if __name__ == "__main__":
    main()
