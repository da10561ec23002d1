"""Exact ray trace of a system of conics and even aspheres, whole bundles of fields and colours at once.

Rays are arrays of shape (3, fields, wavelengths, rays). Each surface has a frame of its own, so that elements
may be shifted and tilted. Intersection and refraction: G. H. Spencer and M. V. R. K. Murty, "General
ray-tracing procedure", JOSA 52, 1962.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lab.population.prescriptions import Prescription, refractive_index
from lensmodel.core.errors import InvalidInputError

Array = NDArray[np.float64]

AIM_UM: Final = 0.54  # wavelength that rays are aimed at the stop in
_NEWTON: Final = 10  # steps towards an asphere; two to four are taken
_SAG_MM: Final = 1e-9  # that they stop at: 1e-6 um of path
_FIELDS: Final = 24  # principal rays between axis and the published field
_BEYOND: Final = 1.25  # times the published field: how far they are followed
_HEIGHTS: Final = 400  # axial rays from axis to rim
_WIDEST: Final = 2.6  # times the published aperture: where axial rays end


class Crossing(NamedTuple):
    """Rays at the image plane and on the way, in the system's unit; not finite where they do not arrive."""

    place: Array  # (2, p, w, r)
    path: Array  # (p, w, r)
    cosines: Array  # (3, p, w, r)
    stop: Array  # (2, p, w, r), where they cross it
    rims: Array  # (k, 2, p, w, r)


@dataclass(frozen=True, eq=False)
class System:
    """Surfaces with a place and a direction each."""

    curvature: Array  # (s,)
    conic: Array
    asphere: Array  # (s, k), coefficients of h^4, h^6, ..
    glass: Array  # (s, 3), see `Prescription`
    index_error: Array  # (s,), added to the index behind each surface
    origin: Array  # (s + 1, 3), vertices, the last one of the image plane
    turn: Array  # (s + 1, 3, 3), from the frame of the surface to that of the system
    stop: int
    rims: tuple[int, ...]  # surfaces whose crossing is recorded

    def trace(self, start: Array, direction: Array, index: Array) -> Crossing:
        """Trace rays from places (3, p, 1, r) in directions (3, p, 1, 1 or r); index (s, w) behind each."""
        p, w, r = start.shape[1], index.shape[1], start.shape[3]
        X = np.broadcast_to(start, (3, p, w, r)).copy()
        D = np.broadcast_to(direction, (3, p, w, r)).copy()
        path = np.zeros((p, w, r))
        before = np.ones(w)
        rims: dict[int, Array] = {}
        stop = np.zeros((2, p, w, r))
        turned, origin = np.eye(3), np.zeros(3)
        for i, after in enumerate(index):
            X, D = _into(X, D, turned, origin, self.turn[i], self.origin[i])
            turned, origin = self.turn[i], self.origin[i]
            t, normal = _meet(X, D, self.curvature[i], self.conic[i], self.asphere[i])
            X = X + t * D
            path += before[:, None] * t
            if i == self.stop:
                stop = X[:2]
            if i in self.rims:
                rims[i] = X[:2]
            if not np.array_equal(before, after):
                D = _refracted(D, normal, (before / after)[:, None])
            before = after
        X, D = _into(X, D, turned, origin, self.turn[-1], self.origin[-1])
        t = -X[2] / D[2]
        X = X + t * D
        path += before[:, None] * t
        return Crossing(X[:2], path, D, stop, np.array([rims[i] for i in self.rims]))

    def launch(
        self, directions: Array, entrance: Array, wavelengths_um: Array, distance: float = math.inf
    ) -> Crossing:
        """Trace from the plane across each direction (p, 2), the cosines L and M, through the first vertex.

        Rays cross that plane at `entrance` (p, 2, r). `distance` is that from the plane of the objects to the
        first vertex. Objects at a finite one lie where a ray of each direction through the first vertex comes
        from; paths are counted from there, less that ray's.
        """
        d, across = frames(directions)
        start = np.einsum("pak,par->kpr", across, entrance)[:, :, None, :]
        light, ahead = d.T[:, :, None, None], np.zeros(())
        if math.isfinite(distance):
            away = distance / light[2]
            rays = start + away * light
            length = np.sqrt((rays * rays).sum(axis=0))
            light, ahead = rays / length, length - away
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            seen = self.trace(start, light, self.index(wavelengths_um))
            return seen._replace(path=seen.path + ahead)

    def index(self, wavelengths_um: Array) -> Array:
        """Index behind each surface, `(s, w)`."""
        return refractive_index(self.glass, wavelengths_um) + self.index_error[:, None]


def frames(directions: Array) -> tuple[Array, Array]:
    """Unit vectors of the light `(p, 3)` and two across it `(p, 2, 3)` that are x and y on the axis."""
    L, M = directions.T
    d = np.stack([L, M, np.sqrt(1.0 - L * L - M * M)], axis=1)
    first = np.array([1.0, 0.0, 0.0]) - d[:, :1] * d
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return d, np.stack([first, np.cross(d, first)], axis=1)


def _into(
    X: Array, D: Array, turned: Array, origin: Array, turn: Array, new_origin: Array
) -> tuple[Array, Array]:
    """Express places and directions of one frame in another."""
    shift = turn.T @ (origin - new_origin)
    if np.array_equal(turned, turn):
        return X + shift[:, None, None, None], D
    change = turn.T @ turned
    return np.tensordot(change, X, 1) + shift[:, None, None, None], np.tensordot(change, D, 1)


def _meet(X: Array, D: Array, c: float, k: float, terms: Array) -> tuple[Array, Array]:
    """Distance along the rays to a surface, and its unit normal there."""
    x, y, z = X
    L, M, N = D
    b = N - c * (x * L + y * M + (1.0 + k) * z * N)
    q = c * (x * x + y * y + (1.0 + k) * z * z) - 2.0 * z
    t = q / (b + np.sqrt(b * b - c * (1.0 + k * N * N) * q))
    x, y, z = x + t * L, y + t * M, z + t * N
    if not terms.any():
        normal = np.stack([-c * x, -c * y, 1.0 - (1.0 + k) * c * z])
        if k != 0.0:
            normal /= np.sqrt((normal * normal).sum(axis=0))
        return t, normal
    for _ in range(_NEWTON):
        sag, slope = _asphere(x * x + y * y, c, k, terms)
        gx, gy = -2.0 * x * slope, -2.0 * y * slope
        miss = z - sag
        step = -miss / (gx * L + gy * M + N)
        t, x, y, z = t + step, x + step * L, y + step * M, z + step * N
        if np.nanmax(np.abs(step), initial=0.0) < _SAG_MM:
            break
    normal = np.stack([gx, gy, np.ones_like(gx)])
    normal /= np.sqrt((normal * normal).sum(axis=0))
    return np.where(np.abs(miss) < 1e3 * _SAG_MM, t, np.nan), normal


def _asphere(u: Array, c: float, k: float, terms: Array) -> tuple[Array, Array]:
    """Sag and its derivative after u = h^2."""
    root = np.sqrt(1.0 - (1.0 + k) * c * c * u)
    sag, slope = np.zeros_like(u), np.zeros_like(u)
    for i in range(terms.size - 1, -1, -1):
        slope = slope * u + (i + 2) * terms[i]
        sag = sag * u + terms[i]
    return c * u / (1.0 + root) + sag * u * u, 0.5 * c / root + slope * u


def _refracted(D: Array, normal: Array, ratio: Array) -> Array:
    """Directions behind a surface; not finite for rays that are totally reflected."""
    cosine = (D * normal).sum(axis=0)
    root = np.sqrt(1.0 - ratio * ratio * (1.0 - cosine * cosine))
    return ratio * D + (root - ratio * cosine) * normal


@dataclass(frozen=True, eq=False)
class Nominal:
    """A design as published: what every copy of it starts from, in the design's unit."""

    prescription: Prescription

    @cached_property
    def rims(self) -> tuple[int, ...]:
        """First and last curved surface: their clear apertures vignette."""
        curved = np.flatnonzero((self.prescription.curvature != 0) | self.prescription.asphere.any(axis=1))
        return (int(curved[0]), int(curved[-1]))

    @cached_property
    def system(self) -> System:
        """Without any fault."""
        one = self.prescription
        count = one.curvature.size
        origin = np.zeros((count + 1, 3))
        origin[1:, 2] = np.cumsum(one.thickness)
        turn = np.broadcast_to(np.eye(3), (count + 1, 3, 3))
        shapes = (one.curvature, one.conic, one.asphere, one.glass)
        return System(*shapes, np.zeros(count), origin, turn, one.stop, self.rims)

    def paraxial(self, wavelength_um: float) -> Array:
        """Heights and angles behind each surface, `(s, 2, 2)`, of the rays (y, u) = (1, 0) and (0, 1)."""
        one = self.prescription
        index = one.index(np.array([wavelength_um]))[:, 0]
        ray = np.eye(2)
        found = []
        before = 1.0
        for c, d, n in zip(one.curvature, one.thickness, index, strict=True):
            refraction = np.array([[1.0, 0.0], [-c * (n - before) / n, before / n]])
            ray = refraction @ ray
            found.append(ray)
            ray = np.array([[1.0, d], [0.0, 1.0]]) @ ray
            before = n
        return np.array(found)

    def focal(self, wavelength_um: float) -> float:
        """Paraxial focal length."""
        return float(-1.0 / self.paraxial(wavelength_um)[-1, 1, 0])

    def extension(self, distance: float) -> float:
        """How far behind the design's image plane objects at a distance are imaged, paraxial."""
        if not math.isfinite(distance):
            return 0.0
        (y, u), (per_y, per_u) = self.paraxial(AIM_UM)[-1].T
        slope = u + per_u / distance
        if distance <= 0.0 or slope * u <= 0.0:
            raise InvalidInputError(f"{self.prescription.name} forms no image of objects at {distance:g}")
        return float(y / u - (y + per_y / distance) / slope)

    def marginal(self, f_number: float) -> tuple[float, Array]:
        """Radius of the stop at an aperture, and heights `(k,)` of the axial rim ray at the rims."""
        sine, stop, rims = _axial(self, math.inf)
        wanted = 0.5 / f_number
        if wanted > sine[-1]:
            raise InvalidInputError(
                f"{self.prescription.name} opens to f/{0.5 / sine[-1]:.2f}, not to f/{f_number:.2f}"
            )
        return (
            float(np.interp(wanted, sine, stop)),
            np.array([np.interp(wanted, sine, column) for column in rims.T]),
        )

    def working(self, f_number: float, distance: float) -> float:
        """F-number of the light at the sensor with the stop of `f_number`, focused at a distance."""
        if not math.isfinite(distance):
            return f_number
        radius = self.marginal(f_number)[0]
        sine, stop, _ = _axial(self, distance)
        if radius > stop[-1]:
            raise InvalidInputError(f"{self.prescription.name}: the stop of f/{f_number:.2f} is not filled")
        return 0.5 / float(np.interp(radius, stop, sine))


class Principal(NamedTuple):
    """Principal rays of a design, from the axis outwards."""

    angles: Array  # (n,), of their objects in radians
    heights: Array  # (n,), on the design's image plane, along +x
    slopes: Array  # (n,), there
    maps: Array  # (n, 2, 3), from the stop to the entrance


@lru_cache(maxsize=512)
def _axial(nominal: Nominal, distance: float) -> tuple[Array, Array, Array]:
    """Sines `(h,)`, ascending, and heights at the stop `(h,)` and the rims `(h, k)` of axial rays."""
    reach = _WIDEST * 0.5 * abs(nominal.focal(AIM_UM)) / nominal.prescription.f_number
    heights = np.linspace(0.0, reach, _HEIGHTS)
    entrance = np.stack([np.zeros_like(heights), heights])[None]
    seen = nominal.system.launch(np.zeros((1, 2)), entrance, np.array([AIM_UM]), distance)
    sine = np.abs(seen.cosines[1, 0, 0])
    broken = np.flatnonzero(~np.isfinite(sine[1:]) | (np.diff(sine) <= 0.0))
    last = int(broken[0]) + 1 if broken.size else sine.size
    return sine[:last], np.abs(seen.stop[1, 0, 0, :last]), np.abs(seen.rims[:, 1, 0, 0, :last]).T


@lru_cache(maxsize=512)
def principal(nominal: Nominal, distance: float = math.inf) -> Principal:
    """Follow principal rays of objects at a distance, as far as light comes through."""
    one = nominal.prescription
    radius, _ = nominal.marginal(max(one.f_number, 4.0))
    before = nominal.paraxial(AIM_UM)[one.stop]
    maps = [np.array([[1.0 / before[0, 0], 0.0, 0.0], [0.0, 1.0 / before[0, 0], 0.0]])]
    angles, heights, slopes = [0.0], [0.0], [0.0]
    extension = nominal.extension(distance)
    for k in range(1, round(_FIELDS * _BEYOND) + 1):
        angle = np.radians(one.half_field_deg) * k / _FIELDS
        direction = np.array([[np.sin(angle), 0.0]])
        found = _aimed(nominal.system, direction, maps[-1][None], radius, 3, distance)
        if found is None:
            break
        chief = nominal.system.launch(direction, found[:, :, 2:], np.array([AIM_UM]), distance)
        height, slope = float(chief.place[0, 0, 0, 0]), float((chief.cosines[0] / chief.cosines[2])[0, 0, 0])
        if not np.isfinite(height) or height + extension * slope <= heights[-1] + extension * slopes[-1]:
            break
        angles.append(float(angle))
        heights.append(height)
        slopes.append(slope)
        maps.append(found[0])
    if len(angles) < _FIELDS // 2:
        raise InvalidInputError(
            f"{one.name}: no light comes through beyond {np.degrees(angles[-1]):.1f} degrees"
        )
    return Principal(np.array(angles), np.array(heights), np.array(slopes), np.array(maps))


def _aimed(
    system: System, directions: Array, maps: Array, radius: float, steps: int, distance: float
) -> Array | None:
    """Refine affine maps `(p, 2, 3)` from the stop to the entrance; None if a field gets hardly any light."""
    turn = np.arange(6) * (np.pi / 3.0)
    ring = np.stack([np.cos(turn), np.sin(turn)])
    targets = radius * np.hstack([np.zeros((2, 1)), 0.5 * ring, 0.9 * ring])
    for _ in range(steps):
        entrance = maps[:, :, :2] @ targets + maps[:, :, 2:]
        stop = system.launch(directions, entrance, np.array([AIM_UM]), distance).stop[:, :, 0]
        seen = np.asarray(np.isfinite(stop).all(axis=0))
        if (seen.sum(axis=1) < 6).any():
            return None
        basis = np.where(seen, np.stack([*stop, np.ones_like(stop[0])]), 0.0).transpose(1, 2, 0)
        goal, across = np.where(seen[:, None], entrance, 0.0).swapaxes(1, 2), basis.swapaxes(1, 2)
        maps = np.linalg.solve(across @ basis, across @ goal).swapaxes(1, 2)
    return maps


def aimed(
    nominal: Nominal, system: System, scale: float, directions: Array, angles: Array, azimuth: Array,
    radius: float, distance: float,
) -> Array:  # fmt: skip
    """Maps `(p, 2, 3)` from the stop to the entrance of a copy, `scale` times as large as its design."""
    known, _, _, maps = principal(nominal, distance / scale)
    flat = maps.reshape(len(maps), 6)
    start = np.stack([np.interp(angles, known, column) for column in flat.T], axis=1).reshape(-1, 2, 3)
    c, s = np.cos(azimuth), np.sin(azimuth)
    turn = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
    linear = turn @ start[:, :, :2] @ turn.transpose(0, 2, 1)
    offset = scale * turn @ start[:, :, 2:]
    found = _aimed(system, directions, np.concatenate([linear, offset], axis=2), radius, 1, distance)
    if found is None:
        raise InvalidInputError(f"{nominal.prescription.name}: no light comes through at some place")
    return found
