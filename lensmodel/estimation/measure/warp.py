"""Where a reference lies in a photo: a homography, and what the lens bends beyond it.

    place in the reference = H(pixel) + sum_ij c_ij X^i Y^j,   i + j <= degree

with X, Y the pixel over half the diagonal of the frame, from its middle. The polynomial takes what a
plane seen through a perfect lens does not have: distortion, and the small turns of a tripod.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.geometry import Frame

Places = tuple[NDArray[np.float64], NDArray[np.float64]]

DEGREE: Final = 5
"""Radial distortion up to the fifth power of the radius: two coefficients and a decentred middle."""

_FEWEST: Final = 6  # points, twice as many as a polynomial of first order needs (chosen)
_TRUSTED_PX: Final = 1.0
"""Matches that lie so far from the smooth field of all others are wrong, those within a tenth pass in any
case: less would drop good ones where nearly all are (chosen)."""


@dataclass(frozen=True, slots=True, eq=False)
class Warp:
    """Pixels of a photo to places of a reference.

    Parameters
    ----------
    homography : ndarray, shape (3, 3)
        Of (row, col, 1) to the reference's (row, col, 1).
    bend : ndarray, shape (terms, 2)
        Polynomial in reference units.
    frame : Frame
        Of the photo.
    """

    homography: NDArray[np.float64]
    bend: NDArray[np.float64]
    frame: Frame

    @classmethod
    def plain(cls, homography: NDArray[np.float64], frame: Frame) -> Warp:
        """Return a warp without a bend."""
        return cls(homography, np.zeros((len(_powers(DEGREE)), 2)), frame)

    def __call__(self, rows: NDArray[np.floating], cols: NDArray[np.floating]) -> Places:
        """Places of the reference that the pixels show."""
        r, c = np.asarray(rows, dtype=np.float64), np.asarray(cols, dtype=np.float64)
        h = self.homography
        below = h[2, 0] * r + h[2, 1] * c + h[2, 2]
        out = [(h[i, 0] * r + h[i, 1] * c + h[i, 2]) / below for i in range(2)]
        if self.bend.any():
            for value, terms in zip(self._basis(r, c), self.bend, strict=True):
                out = [axis + term * value for axis, term in zip(out, terms, strict=True)]
        return out[0], out[1]

    def _basis(self, rows: NDArray[np.float64], cols: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
        """X^i Y^j for each of `_powers(DEGREE)`, one after the other."""
        middle, unit = self.frame.center, self.frame.half_diagonal
        x, y = ((place - m) / unit for place, m in zip((rows, cols), middle, strict=True))
        raised: list[list[NDArray[np.float64]]] = [[np.ones_like(axis)] for axis in (x, y)]
        for axis, powers in zip((x, y), raised, strict=True):
            for _ in range(DEGREE):
                powers.append(powers[-1] * axis)  # several times as fast as axis**k
        return (raised[0][i] * raised[1][j] for i, j in _powers(DEGREE))

    def scale(self, row: float, col: float) -> float:
        """How many units of the reference a pixel takes, along the axis where it takes most."""
        return float(np.linalg.norm(self.jacobian(row, col), 2))

    def jacobian(self, row: float, col: float) -> NDArray[np.float64]:
        """Derivative of the place by the pixel, (2, 2)."""
        r, c = self(np.array([row + 0.5, row - 0.5, row, row]), np.array([col, col, col + 0.5, col - 0.5]))
        return np.array([[r[0] - r[1], r[2] - r[3]], [c[0] - c[1], c[2] - c[3]]])

    def moved(self, pixels: NDArray[np.float64], shifts: NDArray[np.float64], degree: int) -> Warp:
        """Bend the warp so that the reference shows up `shifts` further in the photo at `pixels`.

        Parameters
        ----------
        pixels, shifts : ndarray, shape (n, 2)
            (row, col) of the photo; how far the photo's picture lies beyond what the warp predicts.
        degree : int
            Highest power; lower where there are few matches.

        Raises
        ------
        NotEnoughEvidenceError
            If fewer than six matches agree.
        """
        wanted = np.stack(self(*(pixels - shifts).T), axis=-1) - np.stack(self(*pixels.T), axis=-1)
        powers = _powers(DEGREE)
        used = [i for i, power in enumerate(powers) if sum(power) <= degree]
        basis = np.stack(list(self._basis(*pixels.T)), axis=-1)[:, used]
        unit = self.scale(*self.frame.center)
        good = np.ones(len(pixels), dtype=bool)
        terms = np.zeros((len(used), 2))
        for _ in range(6):
            if good.sum() < max(_FEWEST, len(used)):
                raise NotEnoughEvidenceError(
                    f"only {int(good.sum())} places of the photo match the reference; photograph it flat, "
                    "in focus and without anything before it"
                )
            terms = np.asarray(np.linalg.lstsq(basis[good], wanted[good], rcond=None)[0])
            left = np.hypot(*(wanted - basis @ terms).T) / unit
            limit = max(3.0 * float(np.median(left[good])), 0.1 * _TRUSTED_PX)
            after = left <= limit
            if (after == good).all():
                break
            good = after
        bend = self.bend.copy()
        bend[used] += terms
        return replace(self, bend=bend)


def _powers(degree: int) -> list[tuple[int, int]]:
    return [(i, n - i) for n in range(degree + 1) for i in range(n + 1)]


def homography_of(from_: NDArray[np.float64], to: NDArray[np.float64]) -> NDArray[np.float64]:
    """Homography through four or more pairs of points `(n, 2)`, by the direct linear transform."""
    scale = np.abs(from_).max(), np.abs(to).max()
    rows = []
    for (r, c), (y, x) in zip(from_ / scale[0], to / scale[1], strict=True):
        rows.append([r, c, 1, 0, 0, 0, -y * r, -y * c, -y])
        rows.append([0, 0, 0, r, c, 1, -x * r, -x * c, -x])
    h = np.linalg.svd(np.asarray(rows))[2][-1].reshape(3, 3)
    h = np.diag([scale[1], scale[1], 1.0]) @ h @ np.diag([1 / scale[0], 1 / scale[0], 1.0])
    return np.asarray(h / h[2, 2])


@dataclass(frozen=True, slots=True)
class Match:
    """Where one picture lies in another: the shift (row, col) and how far its peak stands out."""

    shift: tuple[float, float]
    clarity: float


def match(photo: NDArray[np.floating], reference: NDArray[np.floating]) -> Match:
    """Find how far the picture of `photo` lies beyond that of `reference`, in pixels.

    The cross power spectrum is divided by the reference's own amplitude, not by both: blur that
    differs between the two turns then no noise into signal. The peak is refined by a parabola.
    """
    window = np.outer(*(np.hanning(n + 2)[1:-1] for n in photo.shape))
    a = fft.rfft2((photo - photo.mean()) * window)
    b = fft.rfft2((reference - reference.mean()) * window)
    amplitude = np.abs(b)
    cross = a * np.conj(b) / np.maximum(amplitude, 0.1 * float(np.median(amplitude)) + 1e-12)
    surface = fft.irfft2(cross, s=photo.shape)
    peak = np.unravel_index(int(surface.argmax()), surface.shape)
    shift = []
    for axis, at in enumerate(peak):
        length = surface.shape[axis]
        index = list(peak)
        values = []
        for step in (-1, 0, 1):
            index[axis] = (at + step) % length
            values.append(float(surface[tuple(index)]))
        below = values[0] - 2.0 * values[1] + values[2]
        part = 0.0 if below >= 0 else 0.5 * (values[0] - values[2]) / below
        shift.append((at + length // 2) % length - length // 2 + part)
    clarity = float(surface.max()) / max(float(surface.std()), 1e-12)
    return Match((shift[0], shift[1]), clarity)


Render = Callable[[Warp, tuple[int, int], tuple[int, int]], NDArray[np.floating]]
"""`render(warp, corner, shape)`: what a window of the photo shows, without blur."""


def matched(
    warp: Warp,
    render: Render,
    plane: NDArray[np.floating],
    corners: list[tuple[int, int]],
    side: int,
    *,
    least_clarity: float,
    degree: int,
) -> tuple[Warp, int]:
    """Bend a warp to the matches of all windows that are clear.

    Returns
    -------
    warp : Warp
    clear : int
        How many windows matched.
    """
    pixels, shifts = [], []
    for row, col in corners:
        shown = render(warp, (row, col), (side, side))
        matching = match(plane[row : row + side, col : col + side], shown)
        if matching.clarity >= least_clarity:
            pixels.append((row + (side - 1) / 2.0, col + (side - 1) / 2.0))
            shifts.append(matching.shift)
    if len(pixels) < _FEWEST:
        raise NotEnoughEvidenceError(
            f"only {len(pixels)} of {len(corners)} windows of the photo match the reference; photograph it "
            "flat, in focus and without anything before it"
        )
    most = max(d for d in range(degree + 1) if len(_powers(d)) * 2 <= max(len(pixels), 2))
    return warp.moved(np.array(pixels), np.array(shifts), most), len(pixels)
