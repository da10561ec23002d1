"""Aberrations of one copy of a lens, and the wavefront that they make.

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
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.simulate import pupil

SMALLEST_F: Final = 32.0
"""Largest f-number that any simulated lens can be set to."""


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
        if not 0.7 <= self.f_number <= SMALLEST_F:
            raise InvalidInputError(f"open aperture must lie in f/0.7..f/{SMALLEST_F:g}, got {self.f_number}")
        for each in fields(self):
            if not np.isfinite(getattr(self, each.name)).all():
                raise InvalidInputError(f"{each.name} must be finite, got {getattr(self, each.name)}")

    def mixed(self, other: Aberrations, share: float) -> Aberrations:
        """Optics between two focal lengths: every term linear in `share` of `other`.

        Parameters
        ----------
        other : Aberrations
        share : float
            0 gives these, 1 gives `other`.

        Returns
        -------
        Aberrations
        """
        values: dict[str, Any] = {}
        for each in fields(self):
            a, b = np.asarray(getattr(self, each.name)), np.asarray(getattr(other, each.name))
            mixed = (a + share * (b - a)).tolist()
            values[each.name] = tuple(mixed) if isinstance(mixed, list) else mixed
        return Aberrations(**values)


@dataclass(frozen=True, slots=True)
class WaveError:
    """W(p) of one place, aperture and wavelength-dependent focus, as coefficients of a polynomial."""

    quartic: float  # |p|^4
    cubic: tuple[float, float]  # (c.p) |p|^2
    quadratic: tuple[float, float, float]  # px^2, px py, py^2
    colour: tuple[float, float]  # c1 t + c2 t^2 on |p|^2
    stop: float  # s = N0 / N

    @classmethod
    def of(cls, optics: Aberrations, h: tuple[float, float], f_number: float, defocus: float) -> WaveError:
        """Collect the terms at field vector `h`, aperture `f_number` and a focus error."""
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
        """W in reference waves at pupil coordinates that broadcast together."""
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
class CatsEye:
    """Transmission of the pupil: the stop, cut by a second circle far from the centre (cat's eye)."""

    radius: float  # of the second circle, in units of the stop; 0 = none
    center: tuple[float, float]

    @classmethod
    def of(cls, optics: Aberrations, h: tuple[float, float], f_number: float) -> CatsEye:
        """Second circle at field vector `h`, in units of the stop at `f_number`."""
        s = optics.f_number / f_number
        radius, shift = optics.vignetting
        x, y = h[0] - optics.decentring[0], h[1] - optics.decentring[1]
        return cls(radius / s, (shift * x / s, shift * y / s))

    def __call__(self, px: NDArray[np.float32], py: NDArray[np.float32], step: float) -> NDArray[np.float32]:
        """Amplitude 0..1 at pupil coordinates that broadcast together, `step` apart."""
        stop = pupil.disc(px, py, step)
        reach = 1.0 + math.hypot(*self.center) + step
        if self.radius <= 0.0 or self.radius >= reach:
            return stop
        return stop * pupil.disc(px, py, step, radius=self.radius, center=self.center)


def ray_statistics(
    wavefront: WaveError, aperture: CatsEye, wavelength_um: float, f_number: float
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
