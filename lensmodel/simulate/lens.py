"""A lens whose PSF is known exactly, everywhere in the field and at every aperture.

`Aberrations` of one copy make a wavefront W, and Fourier optics with exact sampling a PSF of it. The field
behind the exit pupil is transformed, its intensity is integrated over square pixels::

    E(x) = sum_p A(p) exp(2 pi i W(p)) exp(-2 pi i p . x / (2 lambda N)),   |p| <= 1
    k(pixel) = integral over the pixel of sum_lambda s(lambda) |E(x)|^2

A ray through p lands at x = 2 lambda N grad W: a positive gradient outwards throws light outwards.

|E|^2 is sampled finely enough to carry its band, 1 / (lambda N), the pixel is its exact spectrum
sinc(fx) sinc(fy), and a matrix Fourier transform evaluates the result wherever the kernel is to be centred:
nothing is interpolated. The wavefront is that of third-order theory with the faults of a single copy added.
With the pupil p (right, up; |p| <= 1), the field h (right, up; |h| = r), and h' = h - decentring::

    W = W040 |p|^4 + W131 (h'.p) |p|^2 + W222 (h'.p)^2 + W220 |h'|^2 |p|^2
        + (W020 + tilt.h + c1 t + c2 t^2) |p|^2                    t = (lambda - 540 nm) / 100 nm
        + (coma.p) |p|^2 + a (px^2 - py^2) + 2 b px py

in waves of 540 nm at the open aperture N0. Stopping down to N shrinks the pupil by s = N0 / N, so that a term
of degree n in p shrinks by s^n.

Sources: J. W. Goodman, "Introduction to Fourier Optics", 3rd ed., 2005, ch. 5 and 6; R. Soummer et al., "Fast
computation of Lyot-style coronagraph propagation", Optics Express 15, 2007, eq. 1 (the matrix Fourier
transform); W. T. Welford, "Aberrations of Optical Systems", 1986, ch. 7 and 8; the faults of a copy after
K. P. Thompson, JOSA A 22, 2005.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from functools import lru_cache
from typing import Any, Final, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import as_kernel, centroid
from lensmodel.core.types import WAVELENGTH_NM, Channel, FieldPosition, Kernel, LensSettings
from lensmodel.photo.values import LensIdentity

DEFAULT_PITCH_UM: Final = 4.5  # micrometres: a full-frame sensor of 42 megapixels
DEFAULT_SIZE: Final = 55  # pixels: the largest kernel that the paper estimates
SMALLEST_F: Final = 32.0  # largest f-number that any simulated lens can be set to
REFERENCE_UM: Final = 0.54  # wavelength in micrometres in which wavefront errors are counted
_BAND_UM: Final = 0.035  # half the distance between the outer wavelengths of one colour channel
_MIN_SAMPLES: Final = 96  # across the pupil, to draw its edge well
_MAX_SAMPLES: Final = 640  # across the transform: memory (chosen)
_WRAP_MARGIN: Final = 1.2  # period of the discrete transform over the extent of the light
_CENTRED_PX: Final = 5e-4  # pixels: far below what any test asks
_DETAILED_CUTOFF: Final = 3.5  # cycles/pixel

_IDENTITY: Final = LensIdentity("Simulated Optics", "Simulated 50mm f/2", "SIM0000001", "exif")

Vector: TypeAlias = tuple[float, float]
"""Of the field or pupil `(right, up)`, or in pixels `(row, col)`; also two coefficients that go together."""


class CameraLens(Hashable, Protocol):
    """What a simulated camera needs to know of the lens in front of it; kernels are remembered by lens."""

    @property
    def focal_mm(self) -> tuple[float, ...]:
        """Ascending focal lengths; one for a prime lens."""

    @property
    def identity(self) -> LensIdentity:
        """As written into the metadata of its photos."""

    def f_number(self, settings: LensSettings) -> float:
        """Working f-number of the settings; unknown means wide open, at the shortest focal length."""

    def kernel_at_field(
        self, h: Vector, settings: LensSettings, size: int, *, pitch_um: float, offset: Vector
    ) -> Kernel:
        """Kernel at field vector `h` (right, up), its centre of mass at `offset` (row, col) pixels."""

    def lateral_shift(self, r: float, channel: Channel, focal_mm: float | None = None) -> float:
        """Displacement of a channel's image against green at radius `r`, outwards, in half diagonals."""


@dataclass(frozen=True, slots=True)
class SimulatedLens:
    """One copy of a lens; every photo is taken at the distance of best focus."""

    # one for every entry of `focal_mm`; between them a zoom interpolates in log focal length
    optics: tuple[Aberrations, ...]
    focal_mm: tuple[float, ...] = (50.0,)  # ascending focal lengths; one for a prime lens
    identity: LensIdentity = _IDENTITY

    def __post_init__(self) -> None:
        ascending = [0.0, *self.focal_mm] == sorted({0.0, *self.focal_mm})
        if not (ascending and 0 < len(self.optics) == len(self.focal_mm)):
            raise InvalidInputError(f"give optics, one for each ascending focal length of {self.focal_mm}")

    def at_focal(self, focal_mm: float | None = None) -> Aberrations:
        """Optics at a focal length; None means the shortest."""
        first, last = self.focal_mm[0], self.focal_mm[-1]
        focal_mm = first if focal_mm is None else focal_mm
        if not first * 0.999 <= focal_mm <= last * 1.001:
            raise InvalidInputError(f"the lens covers {first:g} to {last:g} mm, got {focal_mm:g}")
        places = np.arange(len(self.focal_mm))
        share, below = math.modf(np.interp(math.log(focal_mm), np.log(self.focal_mm), places))
        lower = self.optics[int(below)]
        return lower.mixed(self.optics[int(below) + 1], share) if share else lower

    def f_number(self, settings: LensSettings) -> float:
        """Working f-number of the settings; unknown means wide open, at the shortest focal length."""
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
    ) -> Kernel:
        """Exact kernel at a place of the field, integrated over square pixels, centred."""
        return self.kernel_at_field(position.xy, settings or LensSettings(), size, pitch_um=pitch_um)

    def kernel_at_field(
        self,
        h: Vector,
        settings: LensSettings,
        size: int,
        *,
        pitch_um: float = DEFAULT_PITCH_UM,
        offset: Vector = (0.0, 0.0),
    ) -> Kernel:
        """Kernel at field vector `h` (right, up), also outside the frame; see `CameraLens`."""
        if not 0.5 <= pitch_um <= 50.0:
            raise InvalidInputError(f"pixel pitch must lie in 0.5..50 um, got {pitch_um}")
        n, middle = self.f_number(settings), WAVELENGTH_NM[settings.channel] / 1000.0
        waves = (middle - _BAND_UM, 0.25), (middle, 0.5), (middle + _BAND_UM, 0.25)  # with their weights
        pupil = Pupil.of(self.at_focal(settings.focal_mm), h, n)
        (col, row), spread = pupil.ray_spot(middle, n)
        response = pixel_otf(pupil, waves, size=size, pitch_um=pitch_um, f_number=n, spread_um=spread)
        return response.centred(size, (-row / pitch_um, col / pitch_um), offset)

    def field(self, settings: LensSettings | None = None) -> SimulatedField:
        """The exact PSF of every place and channel at these settings, remembering what was asked."""
        return SimulatedField(self, settings or LensSettings())

    def lateral_shift(self, r: float, channel: Channel, focal_mm: float | None = None) -> float:
        """Displacement of a channel's image against green at radius `r`, outwards, in half diagonals."""
        optics = self.at_focal(focal_mm)
        c1, c3 = {"r": optics.lateral_red, "g": (0.0, 0.0), "b": optics.lateral_blue}[channel]
        return c1 * r + c3 * r**3


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedField:
    """The PSF field of a simulated lens at one setting: the truth, in the shape of a `PsfField`."""

    lens: SimulatedLens
    settings: LensSettings

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the exact kernel of odd side `size`; see `SimulatedLens.kernel`."""
        return _kernel(self.lens, position, self.settings.with_channel(channel), size)


_kernel = lru_cache(maxsize=2048)(SimulatedLens.kernel)  # 50 MB at most


def coordinates(samples: int, step: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Pupil coordinates px `(1, samples)` to the right and py `(samples, 1)` upwards."""
    p = ((np.arange(samples) - (samples - 1) / 2.0) * step).astype(np.float32)
    return p[None, :], -p[:, None]


@dataclass(frozen=True, slots=True)
class PixelOtf:
    """Transfer function of lens and pixel together, for light of one colour channel."""

    # (q, q // 2 + 1), on an `rfft2` grid; at zero frequency 1 less the light that diffraction throws beyond
    # the period
    values: NDArray[np.complex64]
    period: float  # period in pixels of the image that it describes: frequencies are multiples of 1 / period

    def kernel(self, size: int, shift: Vector = (0.0, 0.0)) -> NDArray[np.float64]:
        """Share of the light in `(size, size)` pixels, the image moved by `shift` (row, col) pixels."""
        rows, half = self.values.shape
        x = np.arange(size) - size // 2
        row_f = fft.fftfreq(rows, 1.0 / rows) / self.period
        col_f = np.arange(half) / self.period
        along_rows = np.exp(2j * np.pi * np.outer(x - shift[0], row_f)).astype(np.complex64)
        along_cols = np.exp(2j * np.pi * np.outer(col_f, x - shift[1])).astype(np.complex64)
        along_cols[1:] *= 2.0  # the other half plane is the conjugate
        light = ((along_rows @ self.values) @ along_cols).real.astype(np.float64)
        return light / self.period**2

    def centred(self, size: int, guess: Vector, offset: Vector) -> Kernel:
        """Kernel whose centre of mass, unshifted near `guess`, is at `offset` (row, col) from the middle."""
        shift = (offset[0] - guess[0], offset[1] - guess[1])
        light = np.empty(0)
        for _ in range(8):
            light = np.maximum(self.kernel(size, shift), 0.0)
            row, col = centroid(light)
            error = (row - offset[0], col - offset[1])
            if math.hypot(*error) < _CENTRED_PX:
                break
            shift = (shift[0] - error[0], shift[1] - error[1])
        return as_kernel(light)


def pixel_otf(
    pupil: Pupil,
    spectrum: Sequence[Vector],
    *,
    size: int,
    pitch_um: float,
    f_number: float,
    spread_um: float = 0.0,
) -> PixelOtf:
    """Transfer function of a pupil seen through square pixels, summed over wavelengths."""
    shortest = min(wave for wave, _ in spectrum)
    extent = max(size * pitch_um, size * pitch_um / 2.0 + spread_um) * _WRAP_MARGIN
    unit = shortest * f_number  # micrometres of period a pupil sample
    period_um = min(max(extent, _MIN_SAMPLES * unit), max(_MAX_SAMPLES * unit, size * pitch_um))
    cutoff = pitch_um / unit
    # at fast apertures the outermost quarter of the band aliases into what the pixel hardly passes
    factor = 2.0 if cutoff < _DETAILED_CUTOFF else 1.5
    grid = int(fft.next_fast_len(math.ceil(factor * (period_um / unit + 2.0)), real=True))
    image = np.zeros((grid, grid), dtype=np.float32)
    for wave, weight in spectrum:
        step = 2.0 * wave * f_number / period_um
        samples = math.ceil(2.0 / step) + 1
        px, py = coordinates(samples, step)
        angle = np.float32(2.0 * np.pi * REFERENCE_UM / wave) * pupil.wavefront(px, py, wave)
        transmitted = pupil.amplitude(px, py, step)
        light = np.empty(angle.shape, dtype=np.complex64)
        np.multiply(transmitted, np.cos(angle), out=light.real)
        np.multiply(transmitted, np.sin(angle), out=light.imag)
        # the rows beyond the pupil are empty: transform the others first
        field = fft.fft(fft.fft(light, n=grid, axis=1), n=grid, axis=0, overwrite_x=True)
        # Parseval: sum |E|^2 = grid^2 sum A^2; and sum A, not sum A^2, is the area of the pupil
        total = float(transmitted.sum(dtype=np.float64)) * grid**2
        image += np.float32(weight / total) * (np.square(field.real) + np.square(field.imag))
    otf = fft.rfft2(image, overwrite_x=True)
    if grid % 2 == 0:  # the highest frequency has no mirror image: shifted, it would break symmetry
        otf[grid // 2, :] = 0.0
        otf[:, grid // 2] = 0.0
    period = period_um / pitch_um
    row_f, col_f = fft.fftfreq(grid, 1.0 / grid) / period, np.arange(grid // 2 + 1) / period
    otf *= np.sinc(row_f).astype(np.float32)[:, None]
    otf *= np.sinc(col_f).astype(np.float32)[None, :]
    return PixelOtf(otf, period)


@dataclass(frozen=True, slots=True)
class Aberrations:
    """The optics of one copy at one focal length; wavefront terms in waves of 540 nm at `f_number`."""

    f_number: float = 2.0  # open aperture N0
    spherical: float = 0.0  # W040, W131, W222, W220 and W020
    coma: float = 0.0
    astigmatism: float = 0.0
    field_curvature: float = 0.0
    defocus: float = 0.0
    # where the centre of symmetry lies, (right, up), in half diagonals
    decentring: Vector = (0.0, 0.0)
    # faults that are the same all over the field: vector (right, up); (a, b)
    uniform_coma: Vector = (0.0, 0.0)
    uniform_astigmatism: Vector = (0.0, 0.0)
    tilt: Vector = (0.0, 0.0)  # defocus per unit of field towards (right, up)
    colour_focus: Vector = (0.0, 0.0)  # longitudinal colour: c1, c2
    # cat's eye: radius of the second circle over that of the pupil, 0 for none, and its shift a unit of field
    vignetting: Vector = (0.0, 0.0)
    # lateral colour against green: displacement outwards = c1 r + c3 r^3 in half diagonals
    lateral_red: Vector = (0.0, 0.0)
    lateral_blue: Vector = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not (0.7 <= self.f_number <= SMALLEST_F and np.isfinite(np.hstack(astuple(self))).all()):
            raise InvalidInputError(f"terms must be finite, f_number in 0.7..{SMALLEST_F:g}, got {self}")

    def mixed(self, other: Aberrations, share: float) -> Aberrations:
        """Optics between two focal lengths: every term linear in `share` of `other`."""
        pairs = zip(astuple(self), astuple(other), strict=True)
        mixed = [(np.asarray(a) + share * np.subtract(b, a)).tolist() for a, b in pairs]
        values: list[Any] = [tuple(value) if isinstance(value, list) else value for value in mixed]
        return Aberrations(*values)


@dataclass(frozen=True, slots=True)
class Pupil:
    """The pupil of one place and aperture: W(p) as a polynomial, and what it lets through (cat's eye)."""

    quartic: float  # |p|^4
    cubic: Vector  # (c.p) |p|^2
    quadratic: tuple[float, float, float]  # px^2, px py, py^2
    colour: Vector  # c1 t + c2 t^2 on |p|^2
    radius: float  # of the second circle and its centre, in units of the stop; 0 = none
    center: Vector

    @classmethod
    def of(cls, optics: Aberrations, h: Vector, f_number: float) -> Pupil:
        """Collect the terms at field vector `h` and aperture `f_number`."""
        s = optics.f_number / f_number
        x, y = h[0] - optics.decentring[0], h[1] - optics.decentring[1]
        tilt = optics.tilt[0] * h[0] + optics.tilt[1] * h[1]
        focus = optics.defocus + tilt + optics.field_curvature * (x * x + y * y)
        (a, b), w222 = optics.uniform_astigmatism, optics.astigmatism
        quadratic = focus + w222 * x * x + a, 2.0 * w222 * x * y + 2.0 * b, focus + w222 * y * y - a
        cubic = optics.coma * x + optics.uniform_coma[0], optics.coma * y + optics.uniform_coma[1]
        radius, shift = optics.vignetting
        s2, s3 = s * s, s * s * s
        return cls(
            quartic=optics.spherical * s2 * s2,
            cubic=(cubic[0] * s3, cubic[1] * s3),
            quadratic=(quadratic[0] * s2, quadratic[1] * s2, quadratic[2] * s2),
            colour=(optics.colour_focus[0] * s2, optics.colour_focus[1] * s2),
            radius=radius / s,
            center=(shift * x / s, shift * y / s),
        )

    def _quadratic(self, wavelength_um: float) -> tuple[float, float, float]:
        """Terms in px^2, px py, py^2 with those of the colour."""
        t = (wavelength_um - REFERENCE_UM) / 0.1
        focus = self.colour[0] * t + self.colour[1] * t * t
        xx, xy, yy = self.quadratic
        return xx + focus, xy, yy + focus

    def wavefront(
        self, px: NDArray[np.float32], py: NDArray[np.float32], wavelength_um: float
    ) -> NDArray[np.float32]:
        """W in reference waves at pupil coordinates that broadcast together."""
        cx, cy = (np.float32(c) for c in self.cubic)
        xx, xy, yy = (np.float32(c) for c in self._quadratic(wavelength_um))
        radius2 = px * px + py * py
        w = radius2 * (np.float32(self.quartic) * radius2 + cx * px + cy * py)
        return w + xx * px * px + xy * (px * py) + yy * py * py

    def gradient(
        self, px: NDArray[np.floating], py: NDArray[np.floating], wavelength_um: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(dW/dpx, dW/dpy): where the ray through p lands, over 2 lambda N."""
        cx, cy = self.cubic
        xx, xy, yy = self._quadratic(wavelength_um)
        radius2, along = px * px + py * py, cx * px + cy * py
        gx = 4 * self.quartic * radius2 * px + cx * radius2 + 2 * px * along + 2 * xx * px + xy * py
        gy = 4 * self.quartic * radius2 * py + cy * radius2 + 2 * py * along + 2 * yy * py + xy * px
        return np.asarray(gx, dtype=np.float64), np.asarray(gy, dtype=np.float64)

    def amplitude(self, px: NDArray[np.float32], py: NDArray[np.float32], step: float) -> NDArray[np.float32]:
        """Transmission 0..1 at pupil coordinates that broadcast together, `step` apart.

        Edges are one sample wide: the diffraction wings of hard ones would wrap around the transform.
        """

        def disc(radius: float, x: float, y: float) -> NDArray[np.float32]:
            dx, dy = px - np.float32(x), py - np.float32(y)
            rho = np.sqrt(dx * dx + dy * dy)
            return np.clip((np.float32(radius) - rho) / np.float32(step) + np.float32(0.5), 0.0, 1.0)

        stop = disc(1.0, 0.0, 0.0)
        if self.radius <= 0.0 or self.radius >= 1.0 + math.hypot(*self.center) + step:
            return stop
        return stop * disc(self.radius, *self.center)

    def ray_spot(self, wavelength_um: float, f_number: float) -> tuple[Vector, float]:
        """Centre of the ray spot (right, up) and its largest radius, in micrometres."""
        step = 2.0 / 48
        px, py = coordinates(48, step)
        light = self.amplitude(px, py, step).astype(np.float64) ** 2
        scale = 2.0 * REFERENCE_UM * f_number  # W counts reference waves
        gx, gy = self.gradient(px, py, wavelength_um)
        total = light.sum()
        x, y = float((light * gx).sum() / total), float((light * gy).sum() / total)
        radius = float((np.hypot(gx - x, gy - y) * (light > 0)).max())
        return (scale * x, scale * y), scale * radius


_USUAL: Final = {
    "spherical": 1.0,
    "coma": 1.0,
    "astigmatism": 1.0,
    "field_curvature": 1.0,
    "decentring": 0.05,
    "uniform_coma": 0.03,
    "uniform_astigmatism": 0.03,
    "tilt": 0.03,
}
"""Proportions of the aberrations of a lens; uniform faults and tilt as shares of the corner's blur."""

_FAST: Final = (1.8, 2.0, 2.8)
_SHARP: Final = (0.3, 0.7)
# Of each kind: its f-numbers; the r.m.s. widths of the ray spot at the centre and at r = 1 (mean over phi) in
# pixels of 4.5 um, from and to; and what is not as usual, a number, or from and to.
_KINDS: Final[Mapping[str, tuple[Sequence[float], Vector, Vector, Mapping[str, float | Vector]]]] = {
    "soft-fast": ((1.4, 1.6, 1.8), (0.9, 1.4), (2.2, 4.2), {"coma": 1.5}),
    "coma": ((1.8, 2.0, 2.4), _SHARP, (1.3, 3.0), {"coma": 3.0, "astigmatism": 0.4, "field_curvature": 0.3}),
    "astigmatism": (
        *((2.0, 2.4, 2.8), _SHARP, (1.2, 3.0)),
        {"coma": 0.4, "astigmatism": 3.0, "field_curvature": 0.2},
    ),
    "field-curvature": (_FAST, _SHARP, (1.2, 3.0), {"coma": 0.4, "astigmatism": 0.3, "field_curvature": 3.0}),
    "decentred": (_FAST, (0.4, 0.8), (1.2, 2.6), {"decentring": (0.2, 0.4), "uniform_coma": (0.15, 0.3)}),
    "tilted": (_FAST, _SHARP, (1.0, 2.2), {"tilt": (0.4, 0.7), "uniform_astigmatism": (0.05, 0.15)}),
    "nearly-perfect": ((2.8, 3.5, 4.0), (0.1, 0.25), (0.5, 0.8), {"tilt": 0.1}),
    "zoom": ((2.8, 3.5, 4.0), (0.4, 0.9), (1.2, 3.0), {"decentring": 0.12}),
}
_PRIME_MM: Final = (24.0, 35.0, 50.0, 85.0)
_ZOOM_MM: Final = ((18.0, 24.0, 28.0), (70.0, 85.0, 105.0))

LENS_KINDS: Final = tuple(_KINDS)  # kinds of lenses that `draw_lens` knows


def draw_lens(seed: int, kind: str | None = None) -> SimulatedLens:
    """Draw a copy of a lens, whose ray spot has a drawn r.m.s. width at the centre and one in the corner."""
    kind = LENS_KINDS[seed % len(LENS_KINDS)] if kind is None else kind
    if kind not in _KINDS:
        raise InvalidInputError(f"no kind of lens {kind!r}; known: {', '.join(LENS_KINDS)}")
    rng = np.random.default_rng([seed, LENS_KINDS.index(kind)])
    f_numbers, *widths, unusual = _KINDS[kind]
    choices = _ZOOM_MM if kind == "zoom" else (_PRIME_MM,)
    focals = tuple(float(rng.choice(several)) for several in choices)
    f_number = float(rng.choice(f_numbers))
    center, corner = (float(rng.uniform(*ends)) for ends in widths)
    proportions = dict(_USUAL)
    for name, value in unusual.items():
        proportions[name] = float(rng.uniform(*value)) if isinstance(value, tuple) else value
    optics = [_optics(proportions, f_number, center, corner, rng)]
    if kind == "zoom":
        corner *= float(rng.uniform(0.6, 1.1))
        tele = _optics(proportions, f_number, center, corner, rng)
        # a shifted element stays where it is when one zooms
        optics.append(replace(tele, decentring=optics[0].decentring, tilt=optics[0].tilt))
    name = f"Simulated {kind.title()} {'-'.join(f'{mm:.0f}' for mm in focals)}mm f/{f_number:g}"
    identity = LensIdentity("Simulated Optics", name, f"SIM{seed:07d}", "exif")
    return SimulatedLens(tuple(optics), focals, identity)


def _optics(
    proportions: Mapping[str, float],
    f_number: float,
    center_px: float,
    corner_px: float,
    rng: np.random.Generator,
) -> Aberrations:
    """Draw the optics at one focal length, of some blur at the centre and at the corner."""
    sign = rng.choice([-1.0, 1.0], size=4)
    spherical, coma, astigmatism, curvature = (
        proportions[name] * part
        for name, part in zip(_USUAL, rng.uniform(0.5, 1.0, size=4) * sign, strict=False)
    )
    angle = rng.uniform(0.0, 2.0 * math.pi, size=4)

    def vector(k: int, length: float) -> Vector:
        return length * math.cos(angle[k]), length * math.sin(angle[k])

    center = Aberrations(f_number=f_number, spherical=spherical, defocus=-1.1 * spherical)
    outer = Aberrations(
        f_number=f_number,
        coma=coma,
        astigmatism=astigmatism,
        field_curvature=curvature - astigmatism / 2.0,  # the flat compromise between the two foci
    )
    center_factor, outer_factor = center_px / _spot_px(center, 0.0), corner_px / _spot_px(outer, 1.0)
    # defocus in waves whose ray spot is as wide: a disc of radius 2 widths
    blur = 2.0 * corner_px * DEFAULT_PITCH_UM / (4.0 * REFERENCE_UM * f_number)
    side = rng.choice([-1.0, 1.0])
    colour = float(rng.uniform(0.1, 0.4)) * blur
    return Aberrations(
        f_number=f_number,
        spherical=center.spherical * center_factor,
        defocus=center.defocus * center_factor,
        coma=outer.coma * outer_factor,
        astigmatism=outer.astigmatism * outer_factor,
        field_curvature=outer.field_curvature * outer_factor,
        decentring=vector(0, proportions["decentring"] * float(rng.uniform(0.7, 1.3))),
        uniform_coma=vector(1, proportions["uniform_coma"] * blur),
        uniform_astigmatism=vector(2, proportions["uniform_astigmatism"] * blur),
        tilt=vector(3, proportions["tilt"] * blur),
        colour_focus=(side * colour * 0.3, colour * 0.6),
        vignetting=(1.15, float(rng.uniform(0.15, 0.4))),
        lateral_red=(float(rng.normal(0.0, 4e-4)), float(rng.normal(0.0, 3e-4))),
        lateral_blue=(float(rng.normal(0.0, 4e-4)), float(rng.normal(0.0, 3e-4))),
    )


def _spot_px(optics: Aberrations, r: float) -> float:
    """Root mean square width per axis of the ray spot on the axis phi = 0, pixels of 4.5 um."""
    p = (np.arange(64) + 0.5) / 32.0 - 1.0
    px, py = np.meshgrid(p, p)
    inside = px**2 + py**2 <= 1.0
    pupil = Pupil.of(optics, (r, 0.0), optics.f_number)
    gx, gy = pupil.gradient(px[inside], py[inside], REFERENCE_UM)
    scale = 2.0 * REFERENCE_UM * optics.f_number / DEFAULT_PITCH_UM
    return scale * math.sqrt((float(np.var(gx)) + float(np.var(gy))) / 2.0)
