"""Points of light in a photo: by SEP or photutils where installed, else by our own search.

All three only say where lights may be; which of them are isolated, unsaturated and single is decided here,
alike for all, and places are refined when the PSF is solved for.
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.errors import InvalidInputError

logger = logging.getLogger(__name__)

DETECTORS: Final = ("auto", "sep", "photutils", "own")
REMEDY: Final = "pip install 'lensmodel[stars]' finds faint and crowded lights better"

_SIGMAS: Final = 8.0  # of the sky's scatter, that a light stands out by: fainter ones add noise (chosen)
_NEIGHBOUR: Final = 0.1
"""Of its flux, that another light beside it may have: a fainter one is an error like those of noise
(chosen)."""
_SKY_CELL: Final = 64  # pixels of a cell in which the sky is one value, as SExtractor's default


@dataclass(frozen=True, slots=True)
class PointLight:
    """A point of light: middle `(row, col)` in pixels, and its peak above the sky."""

    row: float
    col: float
    peak: float


def sky_of(plane: NDArray[np.floating]) -> tuple[NDArray[np.float64], float]:
    """Smooth background of a plane, and how much its pixels scatter (1.48 times the median deviation)."""
    rows, cols = (max(n // _SKY_CELL, 1) for n in plane.shape)
    cells = np.empty((rows, cols))
    for i in range(rows):
        for j in range(cols):
            part = plane[
                i * plane.shape[0] // rows : (i + 1) * plane.shape[0] // rows,
                j * plane.shape[1] // cols : (j + 1) * plane.shape[1] // cols,
            ]
            cells[i, j] = np.median(part)
    cells = ndimage.median_filter(cells, 3, mode="nearest")
    zoom = plane.shape[0] / rows, plane.shape[1] / cols
    grid = np.meshgrid(
        (np.arange(plane.shape[0]) + 0.5) / zoom[0] - 0.5,
        (np.arange(plane.shape[1]) + 0.5) / zoom[1] - 0.5,
        indexing="ij",
    )
    sky = ndimage.map_coordinates(cells, grid, order=1, mode="nearest")
    left = plane - sky
    scatter = 1.4826 * float(np.median(np.abs(left - np.median(left))))
    return sky, max(scatter, 1e-7)


def find_lights(plane: NDArray[np.floating], detector: str = "auto") -> list[PointLight]:
    """Find points of light, brightest first.

    Parameters
    ----------
    plane : ndarray, shape (H, W)
        Linear light.
    detector : {"auto", "sep", "photutils", "own"}
        "auto" takes the first that is installed.

    Raises
    ------
    InvalidInputError
        For an unknown detector, or one that is not installed.
    """
    if detector not in DETECTORS:
        raise InvalidInputError(f"no detector {detector!r}; known: {', '.join(DETECTORS)}")
    sky, scatter = sky_of(plane)
    clean = np.ascontiguousarray(plane - sky, dtype=np.float64)
    ways: dict[str, tuple[str, Callable[[Any, NDArray[np.float64], float], list[PointLight]]]] = {
        "sep": ("sep", _by_sep),
        "photutils": ("photutils.detection", _by_photutils),
    }
    for name, (module, way) in ways.items():
        if detector not in {"auto", name}:
            continue
        try:
            lights = way(importlib.import_module(module), clean, scatter)
        except ImportError as error:
            if detector == name:
                raise InvalidInputError(f"{name} is not installed; {REMEDY}") from error
            continue
        return sorted(lights, key=lambda light: -light.peak)
    if detector == "auto":
        logger.info("lights are found by our own search; %s", REMEDY)
    return sorted(_by_maxima(clean, scatter), key=lambda light: -light.peak)


def isolated_lights(lights: list[PointLight], reach: float) -> list[PointLight]:
    """Lights that have no other beside them that would disturb, within `reach` pixels."""
    places = np.array([(light.row, light.col) for light in lights]).reshape(-1, 2)
    peaks = np.array([light.peak for light in lights])
    kept = []
    for number, light in enumerate(lights):
        away = np.abs(places - places[number]).max(axis=1)
        near = (away < reach) & (peaks > _NEIGHBOUR * light.peak)
        if near.sum() == 1:
            kept.append(light)
    return kept


def _by_sep(sep: Any, clean: NDArray[np.float64], scatter: float) -> list[PointLight]:  # noqa: ANN401 - an extra
    rows = sep.extract(clean, _SIGMAS / 2, err=scatter, minarea=4)
    return [PointLight(float(r["y"]), float(r["x"]), float(r["peak"])) for r in rows]


def _by_photutils(
    detection: Any,  # noqa: ANN401 - an extra
    clean: NDArray[np.float64],
    scatter: float,
) -> list[PointLight]:
    rows = detection.DAOStarFinder(threshold=_SIGMAS * scatter, fwhm=3.0)(clean)
    if rows is None:
        return []
    names = ("y_centroid", "x_centroid") if "y_centroid" in rows.colnames else ("ycentroid", "xcentroid")
    return [PointLight(float(r[names[0]]), float(r[names[1]]), float(r["peak"])) for r in rows]


def _by_maxima(clean: NDArray[np.float64], scatter: float) -> list[PointLight]:
    """Highest of their 5 x 5 neighbours after a little smoothing, with the centroid of 5 x 5 pixels."""
    smooth = ndimage.gaussian_filter(clean, 1.0)
    # smoothing by sigma 1 leaves 1 / (2 sqrt(pi)) of the scatter of white noise
    peaks = (smooth == ndimage.maximum_filter(smooth, 5)) & (
        smooth > _SIGMAS * scatter / (2 * np.sqrt(np.pi))
    )
    peaks[:2] = peaks[-2:] = False
    peaks[:, :2] = peaks[:, -2:] = False
    lights = []
    t = np.arange(-2, 3)
    for row, col in np.argwhere(peaks):
        part = np.maximum(smooth[row - 2 : row + 3, col - 2 : col + 3], 0.0)
        total = float(part.sum())
        lights.append(
            PointLight(
                row + float((part.sum(axis=1) * t).sum()) / total,
                col + float((part.sum(axis=0) * t).sum()) / total,
                float(clean[row - 1 : row + 2, col - 1 : col + 2].max()),
            )
        )
    return lights
