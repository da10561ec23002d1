"""One wavefront for the whole lens: few numbers of aberration theory, fitted to all samples at once.

With the field vector h = (x, y) (right, up), r = |h|, and the terms of `pupil`, blur in pixels at the
widest aperture N0 is linear in the unknowns::

    |p|^4        a0 + a1 r^2                                        spherical
    p |p|^2      C h + k + C5 r^2 h                                 coma, with that of a decentred copy
    |p|^2        d0 + d.h + d2 r^2 + d4 r^4 + c1 t + c2 t^2         focus, tilt, field curvature, colour
    astigmatism  w h^2 + L h + K + w4 r^2 h^2  (complex)            two nodes, where the copy is decentred

Stopping down to N scales the blur of a term of degree n by (N0 / N)^(n - 1). Besides: q0, the width of
diffraction, and the cat's eye, a second circle that moves over the pupil with h. The unknowns of a zoom
follow straight lines over the logarithm of the focal length.

Sources: W. T. Welford, "Aberrations of Optical Systems", 1986, ch. 7 and 8; K. P. Thompson,
"Description of the third-order optical aberrations of near-circular pupil optical systems without
symmetry", JOSA A 22, 2005.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import as_kernel, centroid, resized
from lensmodel.core.types import WAVELENGTH_NM, FieldPosition, Kernel, LensSettings
from lensmodel.optics.pupil import PupilGrid, largest_side

NAMES: Final = (
    *("spherical", "spherical r2"),
    *("coma", "uniform coma x", "uniform coma y", "coma r3"),
    *("focus", "tilt x", "tilt y", "field curvature", "field curvature r4", "colour 1", "colour 2"),
    *("astigmatism", "linear astigmatism 1", "linear astigmatism 2"),
    *("uniform astigmatism 1", "uniform astigmatism 2", "astigmatism r4"),
)
"""The linear unknowns, in pixels of blur at the widest aperture."""

_LARGEST_LOG_Q = 20.0  # far beyond all pixels and apertures
_STEPS = 4  # of Newton at most, each squaring what is left (chosen)
_MOVES = 8  # at most: a centre of mass may go to and fro between two places (chosen)
# Half the distance between the outer wavelengths of one channel (chosen: half a filter's width)
_BAND_NM = 35.0
_CENTRED_PX = 1e-3  # pixels: a thousandth moves no figure that is reported
_SPARE = 1
"""Pixels around a kernel by which it may be moved without being rendered anew: Newton ends within one
(chosen)."""


def design(position: FieldPosition, settings: LensSettings) -> NDArray[np.float64]:
    """Blur of the first six terms of `pupil` per unknown, at the widest aperture.

    Parameters
    ----------
    position : FieldPosition
    settings : LensSettings
        Only the channel counts; see `stopped` for the aperture.

    Returns
    -------
    ndarray of float64, shape (6, 19)
        The equations above, row by row; times `Wavefront.terms` it is blur in pixels.
    """
    x, y = position.r * math.cos(position.phi), position.r * math.sin(position.phi)
    r2, t = position.r**2, (WAVELENGTH_NM[settings.channel] - WAVELENGTH_NM["g"]) / 100.0
    xx, xy = x * x - y * y, 2.0 * x * y
    rows = np.zeros((6, len(NAMES)))
    rows[0, :2] = 1.0, r2
    rows[1, 2:6] = x, 1.0, 0.0, r2 * x
    rows[2, 2:6] = y, 0.0, 1.0, r2 * y
    rows[3, 6:13] = 1.0, x, y, r2, r2 * r2, t, t * t
    rows[4, 13:] = xx, x, -y, 1.0, 0.0, r2 * xx
    rows[5, 13:] = xy, y, x, 0.0, 1.0, r2 * xy
    return rows


@dataclass(frozen=True, slots=True, eq=False)
class Wavefront:
    """The aberrations of one copy of a lens, at one focal length or at all of a zoom.

    Parameters
    ----------
    terms : ndarray, shape (19,)
        Values of `NAMES`, pixels.
    log_q : float
        Logarithm of wavelength x f-number / pixel pitch at 540 nm and the widest aperture.
    eye : tuple of float
        Radius of the second circle of the pupil, and its shift per unit of field.
    f_number : float
        The widest aperture.
    size : int
        Odd side in pixels of the kernels that it was fitted to.
    error : float
        Median relative L2 of the samples against it.
    slopes : ndarray, shape (19,), or None
        Of a zoom: change of the terms by octave of focal length.
    focal_octaves : float
        Of a zoom: log2 of the focal length, in mm, that `terms` belong to.
    """

    terms: NDArray[np.float64]
    log_q: float
    eye: tuple[float, float]
    f_number: float
    size: int
    error: float = 1.0
    slopes: NDArray[np.float64] | None = None
    focal_octaves: float = 0.0

    def __post_init__(self) -> None:
        scalars = (self.log_q, *self.eye, self.f_number, self.error, self.focal_octaves)
        if not np.isfinite(scalars).all() or abs(self.log_q) > _LARGEST_LOG_Q:
            raise InvalidInputError(f"a wavefront must be finite and its log q moderate, got {scalars}")
        if not (
            self.eye[0] > 0 and self.f_number > 0 and self.error >= 0 and self.size > 0 and self.size % 2
        ):
            raise InvalidInputError(
                f"a wavefront needs a pupil, an f-number and an odd side, got {scalars} and {self.size}"
            )

    def kernel(self, position: FieldPosition, settings: LensSettings, size: int) -> Kernel:
        """Kernel at a place, the mean of three wavelengths of the channel.

        Parameters
        ----------
        position : FieldPosition
        settings : LensSettings
            An unknown aperture counts as the widest, an unknown focal length as `focal_octaves`.
        size : int
            Odd side, pixels; zeros lie beyond one period of the pupil (`pupil.largest_side`).

        Returns
        -------
        Kernel, shape (size, size)
            In the image frame, of sum 1, centred.
        """
        shortest = (WAVELENGTH_NM[settings.channel] - _BAND_NM) / WAVELENGTH_NM["g"]
        q = math.exp(self.log_q) * shortest / self.stop(settings)
        side = min(size, largest_side(q))
        light = np.zeros((side, side))
        tilt = np.zeros(2)
        for shift, weight in ((0.0, 0.5), (-_BAND_NM, 0.25), (_BAND_NM, 0.25)):
            part, tilt = self._centred(position, settings, tilt, shift, side)
            light += weight * part
        return resized(as_kernel(light), size)

    def stop(self, settings: LensSettings) -> float:
        """N0 / N; an unknown aperture counts as the widest."""
        return 1.0 if settings.aperture is None else min(self.f_number / settings.aperture, 1.0)

    def blur(self, position: FieldPosition, settings: LensSettings) -> NDArray[np.float64]:
        """Blur of the terms of `pupil` in pixels, tilts zero, shape (8,)."""
        blur = np.zeros(8)
        terms = self.terms
        if self.slopes is not None:
            terms = terms + self.slopes * self.octaves(settings)
        blur[:6] = stopped(design(position, settings), self.stop(settings)) @ terms
        return blur

    def octaves(self, settings: LensSettings) -> float:
        """Focal length from `focal_octaves` on; an unknown one counts as that."""
        return 0.0 if settings.focal_mm is None else math.log2(settings.focal_mm) - self.focal_octaves

    def grid(self, settings: LensSettings, shift_nm: float = 0.0, size: int | None = None) -> PupilGrid:
        """Pupil and transform of a channel at an aperture; layouts are remembered.

        Parameters
        ----------
        settings : LensSettings
        shift_nm : float
            Added to the channel's wavelength.
        size : int, optional
            Odd side of the kernels in pixels; `size` of the wavefront without it.
        """
        colour = (WAVELENGTH_NM[settings.channel] + shift_nm) / WAVELENGTH_NM["g"]
        return _grid(round(math.exp(self.log_q) * colour / self.stop(settings), 4), size or self.size)

    def amplitude(
        self, grid: PupilGrid, position: FieldPosition, settings: LensSettings, eye: tuple[float, float]
    ) -> NDArray[np.float32]:
        """Transmission of the pupil at a place, float32 of the grid's shape (m, m).

        `eye` is a cat's eye as of the wavefront, whose own need not be asked for.
        """
        s = self.stop(settings)
        move = eye[1] * position.r / s
        return grid.amplitude(eye[0] / s, (move * math.cos(position.phi), move * math.sin(position.phi)))

    def _centred(
        self,
        position: FieldPosition,
        settings: LensSettings,
        tilt: NDArray[np.float64],
        shift_nm: float,
        size: int,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        grid = self.grid(settings, shift_nm, size + 2 * _SPARE)
        amplitude = self.amplitude(grid, position, settings, self.eye)
        g, still = self.blur(position, settings), np.zeros(2)
        if tilt.any():  # the outer wavelengths stay where the middle one puts them
            g[6:] = tilt
            light = grid.binned(grid.fine_light(g, amplitude), size, still)
            return light / light.sum(), tilt
        g[6:] = -np.array(grid.centre(g, amplitude))
        light = np.empty(0)
        for _ in range(_STEPS):
            fine, away, gap = grid.fine_light(g, amplitude), still, math.inf
            for _ in range(_MOVES):
                # where light is narrower than the fine grid, a cubic between its samples dips below zero
                light = np.maximum(grid.binned(fine, size, away), 0.0)
                offset = np.array(centroid(light))
                gap, away = math.hypot(*offset), away + offset
                if gap < _CENTRED_PX or np.abs(away).max() > _SPARE:
                    break
            g[6:] += -away[1], away[0]
            if gap < _CENTRED_PX:
                break
        return light / light.sum(), g[6:].copy()


@lru_cache(maxsize=24)
def _grid(q: float, size: int) -> PupilGrid:
    return PupilGrid.of(q, size)


def stopped(blur: NDArray[np.float64], s: float) -> NDArray[np.float64]:
    """Blur of the first six terms of `pupil` when the stop is narrowed: of degree n in p, times s^(n - 1).

    Parameters
    ----------
    blur : ndarray of float64, shape (6, n)
        At the widest aperture.
    s : float
        N0 / N, in 0..1.

    Returns
    -------
    ndarray of float64, shape (6, n)
    """
    return blur * np.array([s**3, s**2, s**2, s, s, s])[:, None]
