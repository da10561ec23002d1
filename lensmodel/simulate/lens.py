"""A lens whose PSF is known exactly, everywhere in the field and at every aperture.

The wavefront is that of third-order theory with the faults of a single copy added. With the
pupil p (right, up; |p| <= 1), the field h (right, up; |h| = r), and h' = h - decentring::

    W = W040 |p|^4 + W131 (h'.p) |p|^2 + W222 (h'.p)^2 + W220 |h'|^2 |p|^2
        + (W020 + tilt.h + c1 t + c2 t^2) |p|^2                    t = (lambda - 540 nm) / 100 nm
        + (coma.p) |p|^2 + a (px^2 - py^2) + 2 b px py

in waves of 540 nm at the open aperture N0. Stopping down to N shrinks the pupil by s = N0 / N, so
that a term of degree n in p shrinks by s^n. Source: W. T. Welford, "Aberrations of Optical
Systems", 1986, ch. 7 and 8; the faults of a copy after K. P. Thompson, JOSA A 22, 2005.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, field, fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.errors import InvalidInputError
from lensmodel.simulate import pupil
from lensmodel.types import WAVELENGTH_NM, Channel, FieldPosition, Kernel, LensSettings

DEFAULT_PITCH_UM: Final = 4.5
DEFAULT_SIZE: Final = 55

_BAND_UM: Final = 0.035  # half the distance between the outer wavelengths of one colour channel
_SMALLEST_F: Final = 32.0


@dataclass(frozen=True, slots=True)
class Aberrations:
    """The optics of one copy at one focal length; wavefront terms in waves of 540 nm at `f_number`.

    Parameters
    ----------
    f_number : float
        Open aperture N0.
    spherical, coma, astigmatism, field_curvature, defocus : float
        W040, W131, W222, W220 and W020.
    decentring : tuple of float
        Where the centre of symmetry lies, (right, up), in half diagonals.
    uniform_coma, uniform_astigmatism : tuple of float
        Faults that are the same all over the field: vector (right, up); (a, b).
    tilt : tuple of float
        Defocus per unit of field towards (right, up).
    colour_focus : tuple of float
        Longitudinal colour: c1, c2.
    vignetting : tuple of float
        Cat's eye: radius of the second circle over that of the pupil, and its shift per unit of
        field. A radius of 0 means none.
    lateral_red, lateral_blue : tuple of float
        Lateral colour against green: displacement outwards = c1 r + c3 r^3 in half diagonals.
    """

    f_number: float = 2.0
    spherical: float = 0.0
    coma: float = 0.0
    astigmatism: float = 0.0
    field_curvature: float = 0.0
    defocus: float = 0.0
    decentring: tuple[float, float] = (0.0, 0.0)
    uniform_coma: tuple[float, float] = (0.0, 0.0)
    uniform_astigmatism: tuple[float, float] = (0.0, 0.0)
    tilt: tuple[float, float] = (0.0, 0.0)
    colour_focus: tuple[float, float] = (0.0, 0.0)
    vignetting: tuple[float, float] = (0.0, 0.0)
    lateral_red: tuple[float, float] = (0.0, 0.0)
    lateral_blue: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not 0.7 <= self.f_number <= _SMALLEST_F:
            raise InvalidInputError(
                f"open aperture must lie in f/0.7..f/{_SMALLEST_F:g}, got {self.f_number}"
            )
        for each in fields(self):
            if not np.isfinite(getattr(self, each.name)).all():
                raise InvalidInputError(f"{each.name} must be finite, got {getattr(self, each.name)}")

    def mixed(self, other: Aberrations, share: float) -> Aberrations:
        """Optics between two focal lengths: every term linear in `share` of `other`."""
        values: dict[str, Any] = {}
        for each in fields(self):
            a, b = np.asarray(getattr(self, each.name)), np.asarray(getattr(other, each.name))
            mixed = (a + share * (b - a)).tolist()
            values[each.name] = tuple(mixed) if isinstance(mixed, list) else mixed
        return Aberrations(**values)


@dataclass(frozen=True, slots=True)
class _Wavefront:
    """W(p) of one place, aperture and wavelength-dependent focus, as coefficients of a polynomial."""

    quartic: float  # |p|^4
    cubic: tuple[float, float]  # (c.p) |p|^2
    quadratic: tuple[float, float, float]  # px^2, px py, py^2
    colour: tuple[float, float]  # c1 t + c2 t^2 on |p|^2
    stop: float  # s = N0 / N

    @classmethod
    def of(cls, optics: Aberrations, h: tuple[float, float], f_number: float, defocus: float) -> _Wavefront:
        s = optics.f_number / f_number
        x, y = h[0] - optics.decentring[0], h[1] - optics.decentring[1]
        focus = (
            optics.defocus
            + defocus
            + optics.tilt[0] * h[0]
            + optics.tilt[1] * h[1]
            + optics.field_curvature * (x * x + y * y)
        )
        a, b = optics.uniform_astigmatism
        w222, s2, s3 = optics.astigmatism, s * s, s * s * s
        return cls(
            quartic=optics.spherical * s2 * s2,
            cubic=(
                (optics.coma * x + optics.uniform_coma[0]) * s3,
                (optics.coma * y + optics.uniform_coma[1]) * s3,
            ),
            quadratic=(
                (focus + w222 * x * x + a) * s2,
                (2.0 * w222 * x * y + 2.0 * b) * s2,
                (focus + w222 * y * y - a) * s2,
            ),
            colour=(optics.colour_focus[0] * s2, optics.colour_focus[1] * s2),
            stop=s,
        )

    def _focus(self, wavelength_um: float) -> float:
        t = (wavelength_um - pupil.REFERENCE_UM) / 0.1
        return self.colour[0] * t + self.colour[1] * t * t

    def __call__(
        self, px: NDArray[np.float32], py: NDArray[np.float32], wavelength_um: float
    ) -> NDArray[np.float32]:
        focus = self._focus(wavelength_um)
        cx, cy = self.cubic
        xx, xy, yy = self.quadratic
        radius2 = px * px + py * py
        w = radius2 * (np.float32(self.quartic) * radius2 + np.float32(cx) * px + np.float32(cy) * py)
        return (
            w
            + np.float32(xx + focus) * px * px
            + np.float32(xy) * (px * py)
            + np.float32(yy + focus) * py * py
        )

    def gradient(
        self, px: NDArray[np.float32], py: NDArray[np.float32], wavelength_um: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(dW/dpx, dW/dpy): where the ray through p lands, over 2 lambda N."""
        focus = self._focus(wavelength_um)
        cx, cy = self.cubic
        xx, xy, yy = self.quadratic
        radius2, along = px * px + py * py, cx * px + cy * py
        gx = 4 * self.quartic * radius2 * px + cx * radius2 + 2 * px * along + 2 * (xx + focus) * px + xy * py
        gy = 4 * self.quartic * radius2 * py + cy * radius2 + 2 * py * along + 2 * (yy + focus) * py + xy * px
        return np.asarray(gx, dtype=np.float64), np.asarray(gy, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class _Pupil:
    """Transmission of the pupil: the stop, cut by a second circle far from the centre (cat's eye)."""

    radius: float  # of the second circle, in units of the stop; 0 = none
    center: tuple[float, float]

    @classmethod
    def of(cls, optics: Aberrations, h: tuple[float, float], f_number: float) -> _Pupil:
        s = optics.f_number / f_number
        radius, shift = optics.vignetting
        x, y = h[0] - optics.decentring[0], h[1] - optics.decentring[1]
        return cls(radius / s, (shift * x / s, shift * y / s))

    def __call__(self, px: NDArray[np.float32], py: NDArray[np.float32], step: float) -> NDArray[np.float32]:
        stop = pupil.disc(px, py, step)
        reach = 1.0 + math.hypot(*self.center) + step
        if self.radius <= 0.0 or self.radius >= reach:
            return stop
        return stop * pupil.disc(px, py, step, radius=self.radius, center=self.center)


def spectrum(channel: Channel) -> tuple[tuple[float, float], ...]:
    """Wavelengths in micrometres of a colour channel, with their weights."""
    middle = WAVELENGTH_NM[channel] / 1000.0
    return (middle - _BAND_UM, 0.25), (middle, 0.5), (middle + _BAND_UM, 0.25)


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
        if not widest * 0.995 <= settings.aperture <= _SMALLEST_F:
            raise InvalidInputError(
                f"the lens works from f/{widest:.3g} to f/{_SMALLEST_F:g}, got f/{settings.aperture:g}"
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
        wavefront, aperture = _Wavefront.of(optics, h, n, defocus), _Pupil.of(optics, h, n)
        (col, row), spread = _ray_statistics(wavefront, aperture, WAVELENGTH_NM[settings.channel] / 1000.0, n)
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
        """The exact PSF of every place and channel at these settings, remembering what was asked."""
        return SimulatedField(self, settings or LensSettings(), pitch_um, defocus)

    def transmission(self, h: tuple[float, float], settings: LensSettings) -> float:
        """Light that the cat's eye lets through at field vector `h`, over that of the full pupil."""
        optics, n = self.at_focal(settings.focal_mm), self.f_number(settings)
        step = 2.0 / 128
        px, py = pupil.coordinates(130, step)
        cut = _Pupil.of(optics, h, n)(px, py, step).sum(dtype=np.float64)
        return float(cut / pupil.disc(px, py, step).sum(dtype=np.float64))

    def lateral_shift(self, r: float, channel: Channel, focal_mm: float | None = None) -> float:
        """Displacement of a channel's image against green at radius `r`, outwards, in half diagonals."""
        optics = self.at_focal(focal_mm)
        terms = {"r": optics.lateral_red, "g": (0.0, 0.0), "b": optics.lateral_blue}[channel]
        return terms[0] * r + terms[1] * r**3


def _ray_statistics(
    wavefront: _Wavefront, aperture: _Pupil, wavelength_um: float, f_number: float
) -> tuple[tuple[float, float], float]:
    """Centre of the ray spot (right, up) and its largest radius, in micrometres."""
    step = 2.0 / 48
    px, py = pupil.coordinates(48, step)
    light = aperture(px, py, step).astype(np.float64) ** 2
    scale = 2.0 * pupil.REFERENCE_UM * f_number  # W counts reference waves
    gx, gy = wavefront.gradient(px, py, wavelength_um)
    total = light.sum()
    x, y = float((light * gx).sum() / total), float((light * gy).sum() / total)
    radius = float((np.hypot(gx - x, gy - y) * (light > 0)).max())
    return (scale * x, scale * y), scale * radius


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedField:
    """The PSF field of a simulated lens at one setting: the truth, in the shape of a `PsfField`."""

    lens: SimulatedLens
    settings: LensSettings
    pitch_um: float = DEFAULT_PITCH_UM
    defocus: float = 0.0
    _known: dict[tuple[float, float, Channel, int], Kernel] = field(default_factory=dict, repr=False)

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the exact kernel of odd side `size`; see `SimulatedLens.kernel`."""
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
