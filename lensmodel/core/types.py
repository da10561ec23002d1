"""Values that every layer shares: arrays by name, places in the field, settings of the lens, sensor noise.

Pixels are `(row, col)` with integers at pixel centres and rows growing downwards. The field
position is `(r, phi)`, with phi counter-clockwise from the right, so that +pi/2 points towards
row 0. The local frame has `u` radially outwards and `v` turned +90 degrees from it in the
sense of phi.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, Literal, TypeAlias, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError

Plane: TypeAlias = NDArray[np.float32]
"""One colour plane `(row, col)`, linear light, black 0.0, sensor saturation 1.0."""

Planes: TypeAlias = NDArray[np.float32]
"""Colour planes `(channel, row, col)` in the order of `CHANNELS`, C-contiguous, else as `Plane`."""

Kernel: TypeAlias = NDArray[np.float64]
"""Square PSF with an odd side, non-negative, sum 1, centre of mass on the middle pixel."""

Channel: TypeAlias = Literal["r", "g", "b"]
CHANNELS: Final[tuple[Channel, ...]] = get_args(Channel)
WAVELENGTH_NM: Final[dict[Channel, float]] = {"r": 610.0, "g": 540.0, "b": 465.0}
"""Effective wavelength of each colour channel of a typical sensor, in nanometres."""

Direction: TypeAlias = Literal["tangential", "sagittal", "oblique"]
Zone: TypeAlias = Literal["center", "mid", "corner"]
ZONES: Final[tuple[Zone, ...]] = get_args(Zone)

BayerPattern: TypeAlias = tuple[tuple[int, int], tuple[int, int]]
"""Channel (0 r, 1 g, 2 b) that each pixel of the top left 2 x 2 measured; it repeats over the frame."""

StepHook: TypeAlias = Callable[[int, int], None]
"""Called as `on_step(done, total)`; it may raise `CancelledError` to stop the work."""


def ignore_step(done: int, total: int) -> None:
    """Do nothing: the default `StepHook`."""


@dataclass(frozen=True, slots=True)
class FieldPosition:
    """A place in the image field, in sensor orientation: (r, phi) of the PSF function.

    Source: M. Hirsch, B. Schölkopf, "Self-Calibration of Optical Lenses", ICCV 2015, section 6.

    Parameters
    ----------
    r : float
        Distance to the image centre over the half diagonal: 0 centre, 1 corner; `InvalidInputError` outside.
    phi : float
        Angle in radians, counter-clockwise from the right: 0 right, +pi/2 towards row 0.
        Stored wrapped into (-pi, pi].
    """

    r: float
    phi: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.r) and 0.0 <= self.r <= 1.0):
            raise InvalidInputError(f"r must lie in 0..1 (0 centre, 1 corner), got {self.r}")
        if not math.isfinite(self.phi):
            raise InvalidInputError(f"phi must be a finite angle in radians, got {self.phi}")
        wrapped = math.pi - (math.pi - self.phi) % (2.0 * math.pi)
        object.__setattr__(self, "phi", wrapped)

    @property
    def xy(self) -> tuple[float, float]:
        """The place as half diagonals to the right and up."""
        return self.r * math.cos(self.phi), self.r * math.sin(self.phi)


@dataclass(frozen=True, slots=True)
class LensSettings:
    """How the lens was set: the variables Φ of the PSF function f(u, v, r, phi, Φ).

    `None` means unknown, which is not zero: an unknown variable takes no part in distances. Other values out
    of their range raise `InvalidInputError`.

    Parameters
    ----------
    aperture : float or None
        The f-number N, 0.5 to 128.
    focal_mm : float or None
        Focal length in millimetres, 0.1 to 20000.
    focus_m : float or None
        Focus distance in metres, above 0; infinity is allowed.
    channel : {"r", "g", "b"}
        Color channel.
    """

    aperture: float | None = None
    focal_mm: float | None = None
    focus_m: float | None = None
    channel: Channel = "g"

    def __post_init__(self) -> None:
        if self.aperture is not None and not 0.5 <= self.aperture <= 128.0:
            raise InvalidInputError(f"aperture must be an f-number in 0.5..128, got {self.aperture}")
        if self.focal_mm is not None and not 0.1 <= self.focal_mm <= 20000.0:
            raise InvalidInputError(f"focal length must lie in 0.1..20000 mm, got {self.focal_mm}")
        if self.focus_m is not None and not self.focus_m > 0.0:
            raise InvalidInputError(f"focus distance must be positive metres, got {self.focus_m}")
        if self.channel not in CHANNELS:
            raise InvalidInputError(f"channel must be one of {', '.join(CHANNELS)}, got {self.channel!r}")

    @property
    def stops(self) -> float | None:
        """Aperture in stops, 2 log2 N: the unit of distances and bandwidths."""
        return None if self.aperture is None else 2.0 * math.log2(self.aperture)

    def with_channel(self, channel: Channel) -> LensSettings:
        """Return the same settings for another color channel."""
        return replace(self, channel=channel)


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Variance of one plane's noise as a function of its level, var(y) = shot * y + read.

    Both are in linear units where saturation is 1; `InvalidInputError` if one is negative or not finite.
    Source: A. Foi et al., "Practical Poissonian-Gaussian noise modeling and fitting", IEEE TIP 17, 2008.

    Parameters
    ----------
    shot : float
        One over the full-well count in electrons.
    read : float
        Squared standard deviation of the read noise.
    """

    shot: float
    read: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.shot) and math.isfinite(self.read)) or min(self.shot, self.read) < 0:
            raise InvalidInputError(
                f"noise terms must be finite and not negative, got shot={self.shot}, read={self.read}"
            )

    def variance(self, level: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the variance at each level of linear light; levels below 0 count as 0."""
        return self.shot * np.maximum(np.asarray(level, dtype=np.float64), 0.0) + self.read

    def sigma_at(self, level: float) -> float:
        """Return the standard deviation at one level of linear light; a level below 0 counts as 0."""
        return math.sqrt(self.shot * max(level, 0.0) + self.read)

    @classmethod
    def white(cls, sigma: float) -> NoiseModel:
        """Make noise of a standard deviation that does not depend on the level."""
        return cls(shot=0.0, read=sigma * sigma)


_Number = TypeVar("_Number", bound=np.floating)
CENTER_ZONE_R = 0.3  # zone "center" lies below this r
CORNER_ZONE_R = 0.75  # zone "corner" lies above this r


def zone_of(r: float) -> Zone:
    """Name the zone of the field that `r` lies in: centre r < 0.3, corner r > 0.75, else mid."""
    if r < CENTER_ZONE_R:
        return "center"
    return "corner" if r > CORNER_ZONE_R else "mid"


def block_means(plane: NDArray[_Number], side: int) -> NDArray[_Number]:
    """Means over squares of `side` pixels; what is left over at the end of an axis is left out."""
    rows, cols = (length // side for length in plane.shape)
    return plane[: rows * side, : cols * side].reshape(rows, side, cols, side).mean(axis=(1, 3))


@dataclass(frozen=True, slots=True)
class Frame:
    """The sensor frame of a photo, in sensor orientation."""

    height: int  # pixels
    width: int
    circle_px: float | None = None  # half diagonal of a larger frame of which this is the middle: unit of r

    def __post_init__(self) -> None:
        if self.height < 1 or self.width < 1:
            raise InvalidInputError(f"a frame needs at least one pixel, got {self.height} x {self.width}")
        if self.circle_px is not None and not self.circle_px >= math.hypot(self.height, self.width) / 2.0:
            raise InvalidInputError(
                f"{self.height} x {self.width} pixels do not lie in a half diagonal of {self.circle_px}"
            )

    @property
    def center(self) -> tuple[float, float]:
        """The image centre as `(row, col)`; between pixels where a side is even."""
        return (self.height - 1) / 2.0, (self.width - 1) / 2.0

    @property
    def half_diagonal(self) -> float:
        """Distance in pixels from the centre to the outer corner of the corner pixel, of the whole frame."""
        return self.circle_px or math.hypot(self.height, self.width) / 2.0

    def position(self, row: float, col: float) -> FieldPosition:
        """Field position of a pixel; places outside the frame are drawn in to r = 1."""
        row_c, col_c = self.center
        up, right = row_c - row, col - col_c
        return FieldPosition(min(math.hypot(up, right) / self.half_diagonal, 1.0), math.atan2(up, right))

    def pixel(self, position: FieldPosition) -> tuple[float, float]:
        """Pixel `(row, col)` of a field position, real-valued; the inverse of `position`."""
        row_c, col_c = self.center
        distance = position.r * self.half_diagonal
        return row_c - distance * math.sin(position.phi), col_c + distance * math.cos(position.phi)

    def polar(
        self, rows: NDArray[np.floating], cols: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Arrays `r`, `phi` for arrays of rows and columns that broadcast together."""
        row_c, col_c = self.center
        up = row_c - np.asarray(rows, dtype=np.float64)
        right = np.asarray(cols, dtype=np.float64) - col_c
        return np.hypot(up, right) / self.half_diagonal, np.arctan2(up, right)


def field_grid(
    rows: int, cols: int, *, aspect: float = 1.5
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the field positions of the centres of equal cells of a picture, `aspect` its width over height.

    Returns
    -------
    r, phi : ndarray of float64, shape (rows, cols)
        Half diagonals, and radians; row 0 is the top in sensor orientation.
    """
    if rows < 1 or cols < 1 or not aspect > 0.0:
        raise InvalidInputError(f"a grid needs cells and an aspect, got {rows} x {cols}, aspect {aspect}")
    half = np.hypot(aspect, 1.0)
    up = (1.0 - (2.0 * np.arange(rows) + 1.0) / rows)[:, None] / half
    right = ((2.0 * np.arange(cols) + 1.0) / cols - 1.0)[None, :] * aspect / half
    return np.hypot(up, right), np.arctan2(up + 0.0 * right, right + 0.0 * up)
