"""PSFs from a photo of the known target: found, registered, its light and its tones fitted, solved.

1. The four discs give a homography for each of the four ways to turn the page, and for each number of
   samples that pages have; that whose noise is in the photo is the one.
2. Windows all over the page are matched with it, and a polynomial takes what the lens bends.
3. In each window, the light that falls on the page is a smooth function of the place, and the print has
   tones: light = E(p) * (t1 R + t2 R² + t3 R³), where R is the page's reflectance.
4. The kernel between that picture and the pixels that were measured: `solve`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.types import CHANNELS, Channel, StepHook, ignore_step
from lensmodel.estimation.measure.marks import find_marks
from lensmodel.estimation.measure.measurer import MeasuredPsf, require_photos
from lensmodel.estimation.measure.page import DETAILS, TargetPage
from lensmodel.estimation.measure.placed_page import PlacedPage, SolvedWindow, solve_window, tones_of
from lensmodel.estimation.measure.warp import Warp, homography_of, match, matched
from lensmodel.estimation.measure.windows import window_corners
from lensmodel.photo import LinearPhoto

FLOOR: Final = 0.02
"""Error that no window shows of itself: what the smooth models of light, tones and place leave out
(chosen)."""

EXPLAINED: Final = 1.15
"""Residuals over the noise above which a kernel changes too much for a window: noise that is stated a tenth
too low is no reason to cut it (chosen)."""

_CLEAR: Final = 8.0  # of the standard deviation: peaks of 10 000 lags of noise reach 4 to 5
# Pixels of a window: wide enough for the largest kernel, small enough for one blur (chosen)
_SIDE: Final = 144
_SURE: Final = 0.3  # error beyond which a measurement is not worth having
_SMALLER: Final = (2 / 3, 1 / 2)
"""Shares of the side, tried where whole windows do not fit: a change of the kernel falls with the side
(chosen)."""
_LEAST_PIXELS: Final = 2.0  # for each of the kernel: fewer leave it to the prior (chosen)
_TONE_WINDOWS: Final = 6
"""In the middle of the frame, where the lens is sharpest: more lie further out (chosen)."""
_TRIED: Final = 6  # windows looked at along each axis for one that is measured: the page may end anywhere


@dataclass(frozen=True, slots=True)
class Target:
    """Non-blind PSFs from one photo of the printed target.

    Parameters
    ----------
    across, down : int
        Places along the sides of the frame; fewer where windows would overlap by more than a quarter.
    side : int
        Side of a window in pixels.
    details : tuple of int
        Pages that it may be, by the samples along their long side.
    """

    across: int = 9
    down: int = 6
    side: int = _SIDE
    details: tuple[int, ...] = DETAILS

    name: ClassVar[str] = "target"
    version: ClassVar[int] = 1
    photos: ClassVar[int] = 1

    def measure(
        self,
        photos: Sequence[LinearPhoto],
        *,
        size: int,
        channels: Sequence[Channel] = CHANNELS,
        on_step: StepHook = ignore_step,
    ) -> list[MeasuredPsf]:
        """Measure the PSF all over the page; see `Measurer`."""
        require_photos(self, photos)
        photo = photos[0]
        placed = self.find(photo)
        height, width = photo.planes.shape[1:]
        down = min(self.down, max(height // (3 * self.side // 4), 2))
        across = min(self.across, max(width // (3 * self.side // 4), 2))
        held = [
            corner
            for corner in window_corners((height, width), self.side, _TRIED * across, _TRIED * down, 0)
            if placed.holds(*corner, self.side, size // 2)
        ]
        corners = _spread(held, across, down)
        if not corners:
            raise NotEnoughEvidenceError(
                "the page is too small in the photo; go nearer until it nearly fills the frame"
            )
        middle = sorted(corners, key=lambda c: np.hypot(*(np.add(c, self.side / 2) - photo.frame.center)))
        placed = replace(placed, tones=tones_of(photo, placed, middle[:_TONE_WINDOWS], self.side))
        psfs = []
        for done, corner in enumerate(corners, start=1):
            psfs += self._window(photo, placed, corner, size, channels)
            on_step(done, len(corners))
        if not psfs:
            raise NotEnoughEvidenceError("no window of the page determines a PSF; is the photo in focus?")
        return psfs

    def find(self, photo: LinearPhoto) -> PlacedPage:
        """Find the page in a photo and register it to a fraction of a pixel.

        Raises
        ------
        NotEnoughEvidenceError
            If there is no target, or it does not match the photo.
        """
        plane = np.asarray(photo.planes[1])
        marks = find_marks(plane)
        placed = _identified(photo, plane, marks, self.details)
        side = self.side
        corners = [
            corner for corner in window_corners(plane.shape, side, 12, 8, 0) if placed.holds(*corner, side, 0)
        ]
        warp = placed.warp
        for degree in (1, 3, 5, 5):
            warp, _ = matched(
                warp,
                partial(_light, placed.page),
                plane,
                corners,
                side,
                least_clarity=_CLEAR,
                degree=degree,
            )
        return replace(placed, warp=warp)

    def _window(
        self,
        photo: LinearPhoto,
        placed: PlacedPage,
        corner: tuple[int, int],
        size: int,
        channels: Iterable[Channel],
    ) -> list[MeasuredPsf]:
        psfs = []
        for channel in channels:
            try:
                at, window = self._explained(photo, placed, channel, corner, size)
            except NotEnoughEvidenceError:
                continue
            error = float(np.hypot(window.solved.error, FLOOR))
            if error < _SURE:
                pixel = at[0] + (window.side - 1) / 2.0, at[1] + (window.side - 1) / 2.0
                position = photo.frame.position(*pixel)
                psfs.append(MeasuredPsf(window.kernel, position, channel, error, pixel, window.side))
        return psfs

    def _explained(
        self, photo: LinearPhoto, placed: PlacedPage, channel: Channel, corner: tuple[int, int], size: int
    ) -> tuple[tuple[int, int], SolvedWindow]:
        """Solve a window, and smaller ones at its middle as long as the kernel changes too much within."""
        best = corner, solve_window(photo, placed, channel, corner, self.side, size)
        for part in _SMALLER:
            side = round(self.side * part)
            if best[1].solved.misfit <= EXPLAINED:
                break
            if _pixels(photo, channel, side) < _LEAST_PIXELS * size * size:
                break
            inner = corner[0] + (self.side - side) // 2, corner[1] + (self.side - side) // 2
            best = inner, solve_window(photo, placed, channel, inner, side, size)
        return best


def _pixels(photo: LinearPhoto, channel: Channel, side: int) -> float:
    """How many pixels of a window the sensor measures in a channel."""
    if photo.cfa is None:
        return float(side * side)
    sites = sum(row.count(CHANNELS.index(channel)) for row in photo.cfa)
    return side * side * sites / 4.0


def _light(
    page: TargetPage, warp: Warp, corner: tuple[int, int], shape: tuple[int, int]
) -> NDArray[np.float32]:
    return PlacedPage(page, warp).window(*corner, shape)


def _identified(
    photo: LinearPhoto, plane: NDArray[np.floating], marks: NDArray[np.float64], details: Sequence[int]
) -> PlacedPage:
    """Say which page it is and which way up, by the noise near the middle of the page."""
    best: tuple[float, PlacedPage] | None = None
    middle = marks.mean(axis=0)
    side = _SIDE
    corner = round(middle[0] - side / 2), round(middle[1] - side / 2)
    if min(corner) < 0 or corner[0] + side > plane.shape[0] or corner[1] + side > plane.shape[1]:
        raise NotEnoughEvidenceError("the page is too small in the photo; go nearer until it fills the frame")
    window = plane[corner[0] : corner[0] + side, corner[1] : corner[1] + side]
    for detail in details:
        page = TargetPage(detail)
        for turn in range(4):
            warp = Warp.plain(homography_of(np.roll(marks, -turn, axis=0), page.marks), photo.frame)
            if not 0.3 < warp.scale(*middle) < 3.0:
                break  # no turn makes noise visible that pixels do not resolve
            placed = PlacedPage(page, warp)
            matching = match(window, placed.window(*corner, (side, side)))
            if best is None or matching.clarity > best[0]:
                best = matching.clarity, placed
    if best is None or best[0] < _CLEAR:
        raise NotEnoughEvidenceError(
            "four discs are seen, but between them not the noise of a target that is known; print it with "
            "`lensmodel target`, unscaled in one direction, and photograph it in focus"
        )
    return best[1]


def _spread(held: Sequence[tuple[int, int]], across: int, down: int) -> list[tuple[int, int]]:
    """Choose of all windows that show noise those nearest to an even grid over them."""
    if not held:
        return []
    places = np.array(held)
    first, last = places.min(axis=0), places.max(axis=0)
    chosen = {
        held[int(np.argmin(np.hypot(*(places - first - (last - first) * np.array([i, j])).T)))]
        for i in _parts(down)
        for j in _parts(across)
    }
    return sorted(chosen)


def _parts(count: int) -> NDArray[np.float64]:
    """From one end to the other, or the middle alone."""
    return np.linspace(0.0, 1.0, count) if count > 1 else np.array([0.5])
