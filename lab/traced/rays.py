"""Bundles of rays through one copy of a design.

A point at infinity sends a plane wave along d. Its rays start on a plane across d through the first
vertex, where their phase is equal. On the sensor's plane a ray of direction cosines (L, M) arrives at
(x, y) after the optical path P; referred to the point (x0, y0), the plane wave that it belongs to has
the path::

    W(L, M) = P + L (x0 - x) + M (y0 - y)                 x - x0 = -dW/dL,  y - y0 = -dW/dM

which is Hamilton's mixed characteristic: exact at any aperture and angle, no reference sphere taken.
A plane dz farther on adds dz sqrt(1 - L^2 - M^2). Source: M. Born and E. Wolf, "Principles of
Optics", 7th ed., 1999, sec. 4.1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lab.traced.prescription import Design, Optic, optic_of
from lensmodel.core.errors import InvalidInputError

Array = NDArray[np.float64]

AIM_UM: Final = 0.54
"""Wavelength for which rays are aimed at the stop."""

_OVERFILL: Final = 1.06  # of the stop: its edge must lie inside the data, not at their end
_AIMING_STEPS: Final = 2  # steps from a start beside, twice as many without (chosen)


@dataclass(frozen=True, slots=True)
class Fault:
    """One element of a copy that is not where it belongs."""

    element: int  # number of the element or cemented group from the front; negative from the back
    shift_um: tuple[float, float] = (0.0, 0.0)  # across the axis, (right, up), micrometres
    # about the right and the up axis through its front vertex, degrees
    tilt_deg: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Bundle:
    """Rays of one object point and wavelength that reach the sensor's plane."""

    cosines: Array  # (2, n), L (right) and M (up)
    path_um: Array  # (n,), w, micrometres, less its mean
    stop: Array  # (2, n), where they cross the stop, millimetres
    rims: Array  # (rims, 2, n), where they cross the rims that vignette, millimetres
    entrance: Array  # (2, n), where they start, millimetres across d
    landing_mm: tuple[float, float]  # (x0, y0), the point that W refers to


class Tracer:
    """One copy of a design in millimetres, ready to trace.

    Parameters
    ----------
    design : Design
        In millimetres.
    faults : tuple of Fault
    rims : tuple of int
        Surfaces whose crossing is recorded.
    """

    def __init__(self, design: Design, faults: tuple[Fault, ...] = (), rims: tuple[int, ...] = ()) -> None:
        self.design = design
        self.rims = rims
        self._system: Optic = optic_of(design)
        paraxial = self._system.paraxial
        self._pupil_z = float(paraxial.EPL())
        self._pupil_radius = float(paraxial.EPD()) / 2.0
        self._reach = 4.0 * self._pupil_radius + abs(self._pupil_z)
        for fault in faults:
            self._move(fault)

    def _move(self, fault: Fault) -> None:
        elements = self.design.elements()
        if not -len(elements) <= fault.element < len(elements):
            raise InvalidInputError(f"{self.design.name} has {len(elements)} elements, not {fault.element}")
        about_x, about_y = (math.radians(t) for t in fault.tilt_deg)
        behind = 0.0
        for i in elements[fault.element]:
            system = self._system.surfaces[i + 1].geometry.cs
            system.x = system.x + fault.shift_um[0] / 1000.0 + behind * math.sin(about_y)
            system.y = system.y + fault.shift_um[1] / 1000.0 - behind * math.sin(about_x)
            system.rx, system.ry = system.rx + about_x, system.ry + about_y
            behind += self.design.surfaces[i].thickness

    def launch(
        self, direction: tuple[float, float], entrance: Array, wavelengths_um: Array
    ) -> tuple[Array, Array, Array, Array, Array]:
        """Trace rays of one object point.

        Parameters
        ----------
        direction : tuple of float
            L and M of the incident light.
        entrance : ndarray, shape (2, n)
            Where they start, millimetres across the direction.
        wavelengths_um : ndarray, shape (n,)

        Returns
        -------
        place, cosines, path, stop, rims : ndarray
            On the sensor's plane: (2, n) mm, (2, n), (n,) mm; (2, n) and (rims, 2, n) mm. NaN for rays
            that do not arrive.
        """
        from optiland.rays import RealRays

        d, across = _frame(direction)
        start = across.T @ entrance - self._reach * d[:, None]
        ones = np.ones(entrance.shape[1])
        rays = RealRays(*start, *(d[:, None] * ones), ones, wavelengths_um)
        with np.errstate(invalid="ignore", divide="ignore"):
            self._system.surfaces.trace(rays)
        crossed = self._system.surfaces
        stop = crossed[self.design.stop + 1]
        rims = np.array([[crossed[i + 1].x, crossed[i + 1].y] for i in self.rims])
        return (
            np.array([rays.x, rays.y]),
            np.array([rays.L, rays.M]),
            np.asarray(rays.opd, dtype=np.float64),
            np.array([stop.x, stop.y]),
            rims.reshape(len(self.rims), 2, entrance.shape[1]),
        )

    def aimed(
        self, direction: tuple[float, float], radius: float, targets: Array, start: Array | None = None
    ) -> Array:
        """Find where rays must start to cross the stop at `targets` times `radius` (mm).

        Parameters
        ----------
        targets : ndarray, shape (2, n)
        start : ndarray, shape (2, 3), optional
            Affine map from the stop to the start, from a neighbouring direction.

        Returns
        -------
        entrance : ndarray, shape (2, n)
        """
        _, across = _frame(direction)
        center = across @ np.array([0.0, 0.0, self._pupil_z])
        entrance = center[:, None] + self._pupil_radius * 0.5 * targets
        if start is not None:
            entrance = start[:, :2] @ (targets * radius) + start[:, 2:]
        waves = np.full(targets.shape[1], AIM_UM)
        wanted = np.vstack([targets * radius, np.ones(targets.shape[1])])
        for _ in range(_AIMING_STEPS if start is not None else 2 * _AIMING_STEPS):
            _, _, _, stop, _ = self.launch(direction, entrance, waves)
            seen = np.isfinite(stop).all(axis=0)
            if seen.sum() < 6:
                raise InvalidInputError(f"{self.design.name}: no light comes through from {direction}")
            basis = np.vstack([stop[:, seen], np.ones(seen.sum())])
            affine = np.linalg.lstsq(basis.T, entrance[:, seen].T, rcond=None)[0].T
            step = affine[:, :2] @ (wanted[:2] - stop)
            entrance = np.where(seen, entrance + step, affine @ wanted)
        return entrance

    def bundles(
        self,
        direction: tuple[float, float],
        radius: float,
        wavelengths_um: tuple[float, ...],
        limits: tuple[float, ...] = (),
        *,
        rays: int = 480,
        start: Array | None = None,
    ) -> list[Bundle]:
        """Trace the light that fills the stop, one bundle per wavelength, all with one reference point.

        Parameters
        ----------
        direction : tuple of float
            L and M of the incident light.
        radius : float
            Of the stop, millimetres.
        wavelengths_um : tuple of float
        limits : tuple of float
            Radii of the rims, millimetres: rays far outside them take no part.
        rays : int
            Per wavelength, before vignetting.
        start : ndarray, shape (2, 3), optional
            See `aimed`.
        """
        entrance = self.aimed(direction, radius, _sunflower(rays), start)
        many = len(wavelengths_um)
        place, cosines, path, stop, rims = self.launch(
            direction, np.tile(entrance, many), np.repeat(wavelengths_um, entrance.shape[1])
        )
        good = np.isfinite(path) & np.isfinite(cosines).all(axis=0)
        good &= np.hypot(*np.nan_to_num(stop)) <= 1.1 * radius
        for rim, limit in zip(rims, limits, strict=True):
            good &= np.hypot(*np.nan_to_num(rim)) <= 1.1 * limit
        n = entrance.shape[1]
        inside = good & (np.hypot(*np.nan_to_num(stop)) <= radius)
        middle = slice((many // 2) * n, (many // 2 + 1) * n)
        if inside[middle].sum() < 8:
            raise InvalidInputError(f"{self.design.name}: hardly any light comes through from {direction}")
        x0, y0 = (float(v) for v in place[:, middle][:, inside[middle]].mean(axis=1))
        found = []
        for k in range(many):
            part = np.flatnonzero(good[k * n : (k + 1) * n]) + k * n
            L, M = cosines[:, part]
            W = path[part] + L * (x0 - place[0, part]) + M * (y0 - place[1, part])
            found.append(
                Bundle(
                    cosines[:, part],
                    1000.0 * (W - W.mean()),
                    stop[:, part],
                    rims[:, :, part],
                    entrance[:, part - k * n],
                    (x0, y0),
                )
            )
        return found

    def affine(self, direction: tuple[float, float], radius: float, start: Array | None) -> Array:
        """Affine map `(2, 3)` from a point of the stop (mm) to where its ray starts."""
        targets = 0.7 * _sunflower(40)
        entrance = self.aimed(direction, radius, targets, start)
        _, _, _, stop, _ = self.launch(direction, entrance, np.full(entrance.shape[1], AIM_UM))
        seen = np.isfinite(stop).all(axis=0)
        basis = np.vstack([stop[:, seen], np.ones(seen.sum())])
        return np.asarray(np.linalg.lstsq(basis.T, entrance[:, seen].T, rcond=None)[0].T)

    def marginal(self, f_number: float) -> Array:
        """Heights (mm) at which the axial ray of cosine 1 / (2 N) crosses the stop and the rims."""
        heights = np.linspace(0.0, 3.0 * self._pupil_radius * max(self.design.f_number / f_number, 1.0), 600)
        entrance = np.vstack([np.zeros_like(heights), heights])
        _, cosines, _, stop, rims = self.launch((0.0, 0.0), entrance, np.full(heights.size, AIM_UM))
        sine = np.abs(cosines[1])
        wanted = 0.5 / f_number
        beyond = np.flatnonzero(sine >= wanted)
        if not beyond.size or not np.isfinite(sine[: beyond[0] + 1]).all():
            raise InvalidInputError(f"{self.design.name} does not open to f/{f_number:g}")
        last = beyond[0]
        share = (wanted - sine[last - 1]) / (sine[last] - sine[last - 1])
        crossing = np.abs(np.vstack([stop[1][None], rims[:, 1]]))
        return np.asarray(crossing[:, last - 1] + share * (crossing[:, last] - crossing[:, last - 1]))


def _frame(direction: tuple[float, float]) -> tuple[Array, Array]:
    """Unit vector of the light and two across it, `(2, 3)`, that turn into x and y on the axis."""
    L, M = direction
    d = np.array([L, M, math.sqrt(1.0 - L * L - M * M)])
    first = np.array([1.0, 0.0, 0.0]) - d[0] * d
    first /= np.linalg.norm(first)
    return d, np.array([first, np.cross(d, first)])


def _sunflower(count: int) -> Array:
    """Points `(2, count)` that fill the overfilled unit disc evenly, a sixth of them on its edge."""
    edge = count // 6
    inner = np.sqrt((np.arange(count - edge) + 0.5) / (count - edge))
    radius = np.concatenate([inner, np.ones(edge)])
    golden = math.pi * (3.0 - math.sqrt(5.0))
    angle = np.concatenate([golden * np.arange(count - edge), 2.0 * math.pi * np.arange(edge) / max(edge, 1)])
    return _OVERFILL * radius * np.vstack([np.cos(angle), np.sin(angle)])
