"""PSFs from an aperture pair: the same scene from a tripod, wide open and well closed.

The closed photo z is nearly sharp, and its own blur h is nearly known: diffraction and pixels. With the
scene x,  z = h * x + n  and  y = k * x + n', so that x = z deconvolved by h is the sharp picture that the
open photo y blurs, once it is laid under y to a part of a pixel. It keeps noise of its own, which makes
kernels a little too wide: both photos are taken at base ISO.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import centred
from lensmodel.core.types import CHANNELS, WAVELENGTH_NM, Channel, StepHook
from lensmodel.measured.measurer import Found, Latent, Measurer, Prepared, Window, window_corners, window_psf
from lensmodel.measured.registration import Warp, matched
from lensmodel.photo import LinearPhoto

USUAL_F_NUMBER: Final = 8.0  # of the closed photo where it does not say: the sharpest of most lenses
_USUAL_PITCH_UM: Final = 4.5  # where the photo does not say (chosen)
_SIDE: Final = 160  # pixels of a window: the kernel changes in a larger one, a smaller tells less (chosen)
_SPARE: Final = 24  # pixels around a window: deconvolution and interpolation spoil the rim
_DAMPING: Final = 0.004  # of the squared transfer function: noise is not raised more than eightfold
_STOPS_APART: Final = 2.0  # least: blur that both photos share is missing in the kernel (chosen)


@dataclass(frozen=True, slots=True)
class AperturePair(Measurer):
    """Non-blind PSFs of the first photo; the second is the same scene, closed by two stops or more."""

    across: int = 8  # cells of the frame, in each of which the window with most detail is taken
    down: int = 6
    side: int = _SIDE  # side of a window in pixels

    name: ClassVar[str] = "pair"
    photos: ClassVar[int] = 2
    floor: ClassVar[float] = 0.05  # of a lens at f/8 against diffraction (chosen)
    most: ClassVar[float] = 0.3
    shows: ClassVar[str] = "a flat scene with fine detail everywhere"

    def _prepare(self, photos: Sequence[LinearPhoto], size: int, on_step: StepHook) -> Prepared:
        """Lay the closed photo under the open one, and find windows with most detail."""
        opened, closed = photos
        if opened.frame != closed.frame:
            raise InvalidInputError("the photos of a pair must have one size")
        n, m = (photo.info.metadata.aperture for photo in photos)
        if n is not None and m is not None and 2.0 * np.log2(m / n) < _STOPS_APART:
            raise InvalidInputError(
                f"the second photo is at f/{m:g} and the first at f/{n:g}; close the lens by two stops or "
                "more for the second, best to f/8"
            )
        warp = self.register(opened, closed, on_step)
        corners = _detailed(opened, closed, self.side, self.across, self.down, size // 2 + _SPARE)

        def psf_in(corner: tuple[int, int], channel: Channel) -> Found:
            window = Window.of(opened, channel, corner, self.side)
            solved, _ = window_psf(window, _scene(closed, warp, window, channel, size), size)
            return Found(centred(solved.kernel), solved.error, window.middle)

        return corners, psf_in

    def register(self, opened: LinearPhoto, closed: LinearPhoto, on_step: StepHook) -> Warp:
        """Lay the closed photo under the open one."""
        plane, reference = (np.asarray(photo.planes[1]) for photo in (opened, closed))

        def shown(bent: Warp, corner: tuple[int, int], shape: tuple[int, int]) -> NDArray[np.floating]:
            pixels = (at + np.arange(float(n)) for at, n in zip(corner, shape, strict=True))
            places = bent(*np.meshgrid(*pixels, indexing="ij"))
            return np.asarray(ndimage.map_coordinates(reference, places, order=1, mode="mirror"))

        warp, half = Warp(np.eye(3), opened.frame), self.side // 2
        corners = window_corners(plane.shape, self.side, plane.shape[1] // half, plane.shape[0] // half, 8)
        for degree in (0, 1, 3):
            warp = matched(warp, shown, plane, corners, self.side, degree, on_step)
        return warp


def _scene(closed: LinearPhoto, warp: Warp, window: Window, channel: Channel, size: int) -> Latent:
    """Sharp picture around a window, on the pixels of the open photo."""
    known, index = closed.info.metadata, CHANNELS.index(channel)
    lens = known.aperture or USUAL_F_NUMBER, known.pixel_pitch_um or _USUAL_PITCH_UM

    def places(shift: tuple[float, float], margin: int) -> NDArray[np.float64]:
        t = np.arange(-margin, len(window.light) + margin)
        rows, cols = (at + t - by for at, by in zip(window.corner, shift, strict=True))
        return np.stack(warp(*np.meshgrid(rows, cols, indexing="ij")))

    around = places((0.0, 0.0), size // 2)
    first = np.maximum(around.min(axis=(1, 2)).astype(int) - _SPARE, 0)
    bottom, right = around.max(axis=(1, 2)).astype(int) + _SPARE + 1
    region = np.asarray(closed.planes[index, first[0] : bottom, first[1] : right], dtype=np.float64)
    down, along = (np.arange(n) / (2.0 * n) for n in region.shape)
    h = diffraction_otf(down[:, None], along, *lens, channel)
    inverse = (1.0 + _DAMPING) * h / (h * h + _DAMPING)  # Wiener's
    # as if the picture were mirrored at its rim, which suits a transfer function that is real and even
    sharp = fft.idctn(fft.dctn(region, norm="ortho") * inverse, norm="ortho")
    spline = ndimage.spline_filter(sharp, order=5, mode="mirror")

    def moved(shift: tuple[float, float], margin: int) -> NDArray[np.float64]:
        at = places(shift, margin) - first[:, None, None]
        return np.asarray(ndimage.map_coordinates(spline, at, order=5, prefilter=False, mode="mirror"))

    return moved


def _detailed(
    opened: LinearPhoto, closed: LinearPhoto, side: int, across: int, down: int, margin: int
) -> list[tuple[int, int]]:
    """Corners of the windows with most fine detail, one in each cell of the frame."""
    plane = np.asarray(closed.planes[1])
    fine = np.square(plane - ndimage.gaussian_filter(plane, 1.5))
    clipped = (plane >= closed.clip[1]) | (np.asarray(opened.planes[1]) >= opened.clip[1])
    fine[ndimage.maximum_filter(clipped, 5)] = 0.0
    energy = ndimage.uniform_filter(np.minimum(fine, 20.0 * float(fine.mean())), side, mode="constant")

    places = [np.arange(margin, length - side - margin + 1) for length in plane.shape]
    corners = []
    for rows, cols in product(np.array_split(places[0], down), np.array_split(places[1], across)):
        nearby = energy[np.ix_(rows + side // 2, cols + side // 2)]
        if nearby.size:
            k, l = np.unravel_index(int(nearby.argmax()), nearby.shape)
            corners.append((int(rows[k]), int(cols[l])))
    return corners


def diffraction_otf(
    rows: NDArray[np.floating], cols: NDArray[np.floating], f_number: float, pitch_um: float, channel: Channel
) -> NDArray[np.float64]:
    """Transfer function of a round pupil and a pixel's box.

    With v = f lambda N / p, f in cycles/pixel::

        OTF = 2 / pi (arccos v - v sqrt(1 - v²)) sinc(f_row) sinc(f_col)

    Source: J. W. Goodman, "Introduction to Fourier Optics", eq. 6-32 of the third edition.
    """
    v = np.hypot(rows, cols) * WAVELENGTH_NM[channel] / 1000.0 * f_number / pitch_um
    v = np.minimum(v, 1.0)
    round_pupil = 2.0 / np.pi * (np.arccos(v) - v * np.sqrt(1.0 - v * v))
    return np.asarray(round_pupil * np.sinc(rows) * np.sinc(cols), dtype=np.float64)
