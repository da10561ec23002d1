"""The numbers of the sensor before demosaicing: where it clips, its noise, and whether they are a picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import rawpy
from numpy.typing import NDArray

from lensmodel.core.errors import RawDecodeError, TruncatedImageError, UnsupportedFormatError
from lensmodel.core.types import BayerPattern, Plane
from lensmodel.photo.containers import require_known_mosaic
from lensmodel.photo.defects import Neighbours, defects, replace_defects
from lensmodel.photo.noise import estimate_noise
from lensmodel.photo.values import PlaneNoise

_XTRANS_SIDE: Final = 512  # pixels: LibRaw demosaics no smaller X-Trans (its xtrans_interpolate)
_GREEN: Final = 1  # the number of green among the colours of a mosaic
_BAND: Final = 16  # rows that are judged together by `Mosaic.of`

_CLUSTER: Final = 0.005  # width of the pile of saturated pixels in the range: full wells differ a little
_STRAYS: Final = 0.02  # share of a pile that may lie above it: hot pixels; more is a part of the picture
_EDGE: Final = 0.02  # share of a pile below its lower end: 0 would take the darkest stray (chosen)
_LOWEST_PILE: Final = 0.8  # lowest level, relative to the stated one, at which sensors were seen to clip


@dataclass(frozen=True, slots=True, eq=False)
class Mosaic:
    """A colour filter array without its margins."""

    values: NDArray[np.uint16]  # (height, width), raw numbers
    colours: NDArray[np.uint8]  # 0 red, 1 green, 2 blue, 3 second green
    black: tuple[float, ...]  # black level of each of the four
    white: int  # level that the file states for saturation
    is_bayer: bool  # the pattern repeats every 2 x 2 pixels; false for X-Trans

    @classmethod
    def of(cls, raw: rawpy.RawPy) -> Mosaic | None:
        """Take the mosaic of an opened file, refuse a damaged one; `None` where pixels have all colours."""
        if raw.raw_type != rawpy.RawType.Flat or raw.raw_pattern is None:
            return None
        letters = raw.color_desc.decode("ascii", "replace")
        require_known_mosaic(["".join(letters[colour] for colour in row) for row in raw.raw_pattern])
        black = tuple(float(level) for level in raw.black_level_per_channel)
        mosaic = cls(
            raw.raw_image_visible,
            raw.raw_colors_visible,
            black,
            int(raw.white_level),
            raw.raw_pattern.shape == (2, 2),
        )
        mosaic._check()
        return mosaic

    def _check(self) -> None:
        """Refuse numbers that no sensor gives, although the decoder was content."""
        height, width = self.values.shape
        if not self.is_bayer and min(height, width) < _XTRANS_SIDE:
            raise UnsupportedFormatError(
                f"{width} x {height} pixels of an X-Trans mosaic are too few to be demosaiced: give the "
                f"whole frame, at least {_XTRANS_SIDE} pixels high"
            )
        low, high = self.values.min(axis=1), self.values.max(axis=1)
        if low.min() == high.max():
            raise RawDecodeError(f"every pixel of the RAW data is {int(low[0])}; the file holds no picture")
        # A row in which all is saturated is a bright sky, and no damage.
        dead = float(np.mean((low == high) & (low < 0.9 * self.white)))
        if dead > 0.02:
            raise TruncatedImageError(
                f"{dead:.0%} of the rows of the RAW data are empty; the file was cut off"
            )
        random = self._random_share()
        if random > 0.25:
            raise RawDecodeError(
                f"{random:.0%} of the RAW data are random numbers; the file is damaged or wrongly decoded"
            )

    def _random_share(self) -> float:
        """Share of the bands of rows that have high contrast, but no likeness of neighbouring pixels.

        Independent values differ by 2 / sqrt(pi) = 1.13 standard deviations on average; in
        photographs of that contrast it is below 0.5. Of X-Trans, greens that touch are compared.
        """
        starts = range(0, len(self.values), _BAND)
        scale = max(self.white - min(self.black), 1.0)
        random = 0
        for row in starts:
            band = self.values[row : row + _BAND].astype(np.float32)
            if self.is_bayer:
                deviation, steps = float(band.std()), band[:, 2:] - band[:, :-2]
            else:
                colours = self.colours[row : row + _BAND]
                deviation = float(band[colours == _GREEN].std())
                steps = np.diff(band, axis=1)[colours[:, 1:] == colours[:, :-1]]
            step = float(np.abs(steps).mean()) if steps.size else 0.0
            random += deviation > 0.15 * scale and step > 0.9 * deviation
        return random / len(starts)

    def repair(self) -> int:
        """Replace defective pixels in LibRaw's own memory, before it demosaics; return how many."""
        near = Neighbours(self.colours, 2 if self.is_bayer else 6)
        return replace_defects(self.values, defects(self.values, near), near)

    def saturation(self) -> tuple[int, tuple[float, float, float]]:
        """Level at which the sensor clips, and that of each colour relative to it.

        The level that a file states is often too high, and the colours of some sensors clip at
        different ones. Where a photo has clipped pixels they pile up, and the pile is the truth.
        """
        piles = {k: self._pile(k) for k in range(4) if self.is_bayer or k < 3}
        ends = [pile[1] for pile in piles.values() if pile is not None]
        white = min(max(ends), self.white) if ends else self.white
        clip = [1.0, 1.0, 1.0]
        for k, pile in piles.items():
            if pile is not None:
                channel = 1 if k == 3 else k
                level = (pile[0] - self.black[k]) / max(white - self.black[k], 1.0)
                clip[channel] = min(clip[channel], level)
        return white, (clip[0], clip[1], clip[2])

    def _pile(self, colour: int) -> tuple[int, int] | None:
        """Lower and upper end of the pile of saturated pixels of one colour; `None` without one.

        Full wells differ from pixel to pixel, by a hundredth on old sensors; hot pixels shine beyond them.
        """
        counts = np.bincount(self.values[self.colours == colour])
        scale = self.white - self.black[colour]
        first = max(int(self.black[colour] + _LOWEST_PILE * scale), 0)
        width = max(2, round(_CLUSTER * scale))
        if len(counts) <= first + 1:
            return None
        sums = np.concatenate([[0], counts.cumsum()])

        def within(low: int, high: int) -> int:
            low, high = (min(max(level, 0), len(counts)) for level in (low, high))
            return int(sums[high] - sums[low])

        at = np.arange(first, len(counts))
        middle = int(at[np.argmax(sums[np.minimum(at + width, len(counts))] - sums[at])]) + width // 2
        low, high = max(middle - 2 * width, 0), middle + 2 * width
        pile, below, above = (within(low, high), within(2 * low - high, low), within(high, len(counts)))
        # More than half of a colour in one pile is an even area of a drawing, not a clipped light.
        if not max(50, 2e-5 * sums[-1]) < pile < 0.5 * sums[-1] or pile < 5 * below or above > _STRAYS * pile:
            return None
        # what of the picture lies under the pile as it does below it does not belong to it
        inside = np.cumsum(counts[low:] - below / (high - low))
        first = int(np.argmax(inside >= _EDGE * pile))
        last = np.searchsorted(np.cumsum(counts[low:]), (1.0 - _STRAYS / 2.0) * (pile + above))
        return low + first, low + int(last)

    def noise(self, white: int) -> PlaneNoise | None:
        """Measure the noise of the sensor in each colour, `white` being 1; `None` for X-Trans."""
        if not self.is_bayer:
            return None
        step = 1.0 / max(white - min(self.black), 1.0)
        r, g, b = (estimate_noise(site, step=step) for site in self.sites(white))
        return r, g, b

    def bayer_pattern(self) -> BayerPattern | None:
        """Channel of each pixel of the top left 2 x 2; `None` for X-Trans."""
        if not self.is_bayer:
            return None
        cell = self.colours[:2, :2]
        (a, b), (c, d) = np.where(cell == 3, 1, cell).tolist()
        return ((a, b), (c, d))

    def sites(self, white: int) -> list[Plane]:
        """Red, green and blue at half the size, without interpolation; black 0, `white` 1."""
        planes: dict[int, Plane] = {}
        for row, col in np.ndindex(2, 2):
            colour = int(self.colours[row, col])
            black = np.float32(self.black[colour])
            values = self.values[row::2, col::2].astype(np.float32)
            planes.setdefault(1 if colour == 3 else colour, (values - black) / (np.float32(white) - black))
        return [planes[k] for k in sorted(planes)]
