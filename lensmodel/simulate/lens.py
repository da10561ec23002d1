"""A lens whose PSF is known exactly, everywhere in the field and at every aperture."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import WAVELENGTH_NM, Channel, FieldPosition, Kernel, LensSettings
from lensmodel.simulate import pupil
from lensmodel.simulate.aberrations import SMALLEST_F, Aberrations, CatsEye, WaveError, ray_statistics

DEFAULT_PITCH_UM: Final = 4.5  # micrometres: a full-frame sensor of 42 megapixels
DEFAULT_SIZE: Final = 55  # pixels: the largest kernel that the paper estimates

_BAND_UM: Final = 0.035  # half the distance between the outer wavelengths of one colour channel


def spectrum(channel: Channel) -> tuple[tuple[float, float], ...]:
    """Wavelengths in micrometres of a colour channel, with their weights."""
    middle = WAVELENGTH_NM[channel] / 1000.0
    return (middle - _BAND_UM, 0.25), (middle, 0.5), (middle + _BAND_UM, 0.25)


class CameraLens(Protocol):
    """What a simulated camera needs to know of the lens in front of it; hashable.

    Methods are as those of `SimulatedLens`.
    """

    @property
    def focal_mm(self) -> tuple[float, ...]:
        """Ascending focal lengths; one for a prime lens."""

    @property
    def maker(self) -> str:
        """As written into the metadata of its photos."""

    @property
    def model(self) -> str:
        """As written into the metadata of its photos."""

    @property
    def serial(self) -> str:
        """As written into the metadata of its photos."""

    def __hash__(self) -> int:
        """Kernels are remembered by lens."""

    def widest(self, focal_mm: float | None = None) -> float:
        """Widest aperture at a focal length; None means the shortest."""

    def f_number(self, settings: LensSettings) -> float:
        """Working f-number of the settings; unknown means wide open."""

    def kernel_at_field(
        self,
        h: tuple[float, float],
        settings: LensSettings,
        size: int,
        *,
        pitch_um: float,
        defocus: float,
        offset: tuple[float, float],
    ) -> Kernel:
        """Kernel at field vector `h` (right, up), its centre of mass at `offset` (row, col) pixels."""

    def transmission(self, h: tuple[float, float], settings: LensSettings) -> float:
        """Light that arrives at field vector `h`, over that of the full pupil."""

    def lateral_shift(self, r: float, channel: Channel, focal_mm: float | None = None) -> float:
        """Displacement of a channel's image against green at radius `r`, outwards, in half diagonals."""


@dataclass(frozen=True, slots=True)
class SimulatedLens:
    """One copy of a lens. Frozen and hashable; equal parameters give equal kernels.

    Parameters
    ----------
    optics : tuple of Aberrations
        One for every entry of `focal_mm`; between them a zoom interpolates in log focal length.
    focal_mm : tuple of float
        Ascending focal lengths; one for a prime lens.
    maker, model, serial : str
        As written into the metadata of its photos.

    Notes
    -----
    The focus distance takes no part: every photo is taken at the distance of best focus, give or
    take the `defocus` passed to `kernel`.
    """

    optics: tuple[Aberrations, ...]
    focal_mm: tuple[float, ...] = (50.0,)
    maker: str = "Simulated Optics"
    model: str = "Simulated 50mm f/2"
    serial: str = "SIM0000001"

    def __post_init__(self) -> None:
        if not self.optics or len(self.optics) != len(self.focal_mm):
            raise InvalidInputError(
                f"one Aberrations per focal length, got {len(self.optics)} for {len(self.focal_mm)}"
            )
        if sorted(set(self.focal_mm)) != list(self.focal_mm) or self.focal_mm[0] <= 0:
            raise InvalidInputError(f"focal lengths must be positive and ascending, got {self.focal_mm}")

    def at_focal(self, focal_mm: float | None = None) -> Aberrations:
        """Optics at a focal length; None means the shortest.

        Parameters
        ----------
        focal_mm : float, optional

        Returns
        -------
        Aberrations

        Raises
        ------
        InvalidInputError
            If the lens has no such focal length.
        """
        if focal_mm is None:
            return self.optics[0]
        first, last = self.focal_mm[0], self.focal_mm[-1]
        if not first * 0.999 <= focal_mm <= last * 1.001:
            raise InvalidInputError(f"the lens covers {first:g} to {last:g} mm, got {focal_mm:g}")
        upper = bisect_right(self.focal_mm, focal_mm)
        if upper in {0, len(self.focal_mm)}:
            return self.optics[0 if upper == 0 else -1]
        a, b = self.focal_mm[upper - 1], self.focal_mm[upper]
        share = math.log(focal_mm / a) / math.log(b / a)
        return self.optics[upper - 1].mixed(self.optics[upper], share)

    def widest(self, focal_mm: float | None = None) -> float:
        """Widest aperture at a focal length; None means the shortest."""
        return self.at_focal(focal_mm).f_number

    def f_number(self, settings: LensSettings) -> float:
        """Working f-number of the settings; unknown means wide open.

        Raises
        ------
        InvalidInputError
            If the lens does not open so far, or not close so far.
        """
        widest = self.at_focal(settings.focal_mm).f_number
        if settings.aperture is None:
            return widest
        if not widest * 0.995 <= settings.aperture <= SMALLEST_F:
            raise InvalidInputError(
                f"the lens works from f/{widest:.3g} to f/{SMALLEST_F:g}, got f/{settings.aperture:g}"
            )
        return max(settings.aperture, widest)

    def kernel(
        self,
        position: FieldPosition,
        settings: LensSettings | None = None,
        size: int = DEFAULT_SIZE,
        *,
        pitch_um: float = DEFAULT_PITCH_UM,
        defocus: float = 0.0,
    ) -> Kernel:
        """Exact kernel at a place of the field, integrated over square pixels, centred.

        Parameters
        ----------
        position : FieldPosition
            Place in the field.
        settings : LensSettings, optional
            Aperture, focal length and channel; the default is wide open, green.
        size : int
            Odd side in pixels.
        pitch_um : float
            Pixel pitch in micrometres.
        defocus : float
            Focus error of this photo: added to W020, waves at the open aperture.

        Returns
        -------
        Kernel, shape (size, size)

        Raises
        ------
        InvalidInputError
            If the size is even or the lens has no such setting.
        """
        h = (position.r * math.cos(position.phi), position.r * math.sin(position.phi))
        return self.kernel_at_field(h, settings or LensSettings(), size, pitch_um=pitch_um, defocus=defocus)

    def kernel_at_field(
        self,
        h: tuple[float, float],
        settings: LensSettings,
        size: int,
        *,
        pitch_um: float = DEFAULT_PITCH_UM,
        defocus: float = 0.0,
        offset: tuple[float, float] = (0.0, 0.0),
    ) -> Kernel:
        """Kernel at field vector `h` (right, up), also outside the frame; see `kernel`.

        `offset` is where its centre of mass shall lie, `(row, col)` in pixels.
        """
        if size < 3 or size % 2 == 0:
            raise InvalidInputError(f"size must be odd and at least 3, got {size}")
        if not 0.5 <= pitch_um <= 50.0:
            raise InvalidInputError(f"pixel pitch must lie in 0.5..50 um, got {pitch_um}")
        optics, n = self.at_focal(settings.focal_mm), self.f_number(settings)
        wavefront, aperture = WaveError.of(optics, h, n, defocus), CatsEye.of(optics, h, n)
        (col, row), spread = ray_statistics(wavefront, aperture, WAVELENGTH_NM[settings.channel] / 1000.0, n)
        response = pupil.pixel_otf(
            wavefront,
            aperture,
            spectrum(settings.channel),
            size=size,
            pitch_um=pitch_um,
            f_number=n,
            spread_um=spread,
        )
        return response.centred(size, (-row / pitch_um, col / pitch_um), offset)

    def field(
        self,
        settings: LensSettings | None = None,
        *,
        pitch_um: float = DEFAULT_PITCH_UM,
        defocus: float = 0.0,
    ) -> SimulatedField:
        """The exact PSF of every place and channel at these settings, remembering what was asked.

        Parameters
        ----------
        settings : LensSettings, optional
            Default: wide open.
        pitch_um : float
            Pixel pitch of the camera in micrometres.
        defocus : float
            As of `kernel`.

        Returns
        -------
        SimulatedField
        """
        return SimulatedField(self, settings or LensSettings(), pitch_um, defocus)

    def transmission(self, h: tuple[float, float], settings: LensSettings) -> float:
        """Light that the cat's eye lets through at field vector `h`, over that of the full pupil."""
        optics, n = self.at_focal(settings.focal_mm), self.f_number(settings)
        step = 2.0 / 128
        px, py = pupil.coordinates(130, step)
        cut = CatsEye.of(optics, h, n)(px, py, step).sum(dtype=np.float64)
        return float(cut / pupil.disc(px, py, step).sum(dtype=np.float64))

    def lateral_shift(self, r: float, channel: Channel, focal_mm: float | None = None) -> float:
        """Displacement of a channel's image against green at radius `r`, outwards, in half diagonals."""
        optics = self.at_focal(focal_mm)
        terms = {"r": optics.lateral_red, "g": (0.0, 0.0), "b": optics.lateral_blue}[channel]
        return terms[0] * r + terms[1] * r**3


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedField:
    """The PSF field of a simulated lens at one setting: the truth, in the shape of a `PsfField`.

    Parameters
    ----------
    lens : SimulatedLens
    settings : LensSettings
    pitch_um : float
        Pixel pitch of the camera in micrometres.
    defocus : float
        As of `SimulatedLens.kernel`.
    """

    lens: SimulatedLens
    settings: LensSettings
    pitch_um: float = DEFAULT_PITCH_UM
    defocus: float = 0.0
    _known: dict[tuple[float, float, Channel, int], Kernel] = field(default_factory=dict, repr=False)

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the exact kernel of odd side `size`; see `SimulatedLens.kernel`.

        Parameters
        ----------
        position : FieldPosition
        channel : {"r", "g", "b"}
        size : int
            Odd side in pixels.

        Returns
        -------
        Kernel, shape (size, size)
        """
        key = (position.r, position.phi, channel, size)
        if key not in self._known:
            self._known[key] = self.lens.kernel(
                position,
                self.settings.with_channel(channel),
                size,
                pitch_um=self.pitch_um,
                defocus=self.defocus,
            )
        return self._known[key]
