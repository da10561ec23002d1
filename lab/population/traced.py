"""Lenses made of published designs: scaled, opened, faulty, focused, and traced to their wavefronts.

A copy is drawn by `draw`. Its wavefront is Hamilton's mixed characteristic over the direction cosines of the
light at the sensor, so that the PSF is a plain Fourier transform of it at any aperture and angle. With pupil
coordinates p = -2 N (L - L0) the light of a ray arrives at 2 N dW/dp from the reference point, and the rim of
the axial beam is |p| = 1. N is the f-number at the sensor: that of the aperture ring at infinity, larger when
the whole lens is moved forward to focus on what is near, with the aberrations that it has there. Off the axis
the pupil is smaller, seldom round, and cut by rims: four circles enclose it. Source: M. Born and E. Wolf,
"Principles of Optics", 7th ed., 1999, sec. 4.1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lab.population.kernels import WAVELENGTHS_UM, basis, draw_pitch_um, kernels_of
from lab.population.prescriptions import PRESCRIPTIONS
from lab.population.tracing import AIM_UM, Array, Crossing, Nominal, System, aimed, principal
from lab.traced import GridField
from lensmodel.core.errors import InvalidInputError
from lensmodel.neural.network import SIDE

GREEN_UM: Final = (0.52, 0.555)  # light that autofocus and the limits on blur look at

_FOCUS_PLACES: Final = ((0.0, 1.0), (0.35, 0.5), (0.65, 0.25))
"""Where an autofocus looks: radius and weight of rings of four points. Chosen: mostly the middle."""

_RAYS: Final = 192  # for 54 unknowns a place and wavelength
_OVERFILL: Final = 1.08  # of the stop: its edge must lie inside the rays, not at their end
_NEAR: Final = 1.04  # rays so far outside the stop and the rims count fully
_OUTSIDE_WEIGHT: Final = 1e-4  # of rays that the rims stop: they keep the fit quiet where no light is
_RIDGE: Final = 1e-9  # of the weights' mean: decides where no ray does
_WORST_PX: Final = 8.0  # r.m.s. spot at 0.9 of the half diagonal that a copy may have
_EDGE: Final = 0.9
_WORST_COLOUR_PX: Final = 10.0  # lateral colour between the ends of `_COLOURS_UM`
_WORST_MISFIT_UM: Final = 0.1  # r.m.s.: beyond it the terms do not hold the traced wavefront
_SOFT_PX: Final = (1.5, 5.0)  # r.m.s. spots in the centre of copies that are opened beyond their design
_COLOURS_UM: Final = (0.45, 0.54, 0.63)
_TRIES: Final = 60
_AT_ONCE: Final = 64  # places whose rays are traced together
_INSIDE: Final = 1.001  # half diagonals: designs are traced no farther out than the corner


@dataclass(frozen=True, eq=False)
class Faults:
    """How one copy differs from its design; all zero by default."""

    # (e, 2), of each single or cemented element: to the right and up; about the right and the up axis through
    # its front vertex
    shift_um: Array
    tilt_arcmin: Array
    space: Array  # (s,), relative errors of the air spaces behind the surfaces
    index: Array  # (s,), errors of the refractive index behind the surfaces
    # how far the sensor lies behind its place at r = 1 to the right, and upwards
    sensor_tilt_um: tuple[float, float] = (0.0, 0.0)
    # error of the autofocus: r.m.s. radius along one axis of the disc that it alone would make.
    focus_px: float = 0.0

    @classmethod
    def none(cls, design: str) -> Faults:
        """A perfect copy."""
        one = PRESCRIPTIONS[design]
        e, s = len(one.elements()), one.curvature.size
        return cls(np.zeros((e, 2)), np.zeros((e, 2)), np.zeros(s), np.zeros(s))


class _Light(NamedTuple):
    """Rays in pupil coordinates, at (places, waves, rays)."""

    p: Array  # (2, ...)
    path_um: Array
    outside: Array  # 1 at the rim that a ray is nearest to, larger outside
    place_um: Array  # (2, ...)
    slope: Array  # (2, ...), L / N and M / N
    circles: Array


@dataclass(frozen=True, eq=False)
class TracedLens:
    """One copy of a design in front of a sensor."""

    design: str  # name of the prescription
    half_diagonal_mm: float  # of the sensor
    cover: float  # share of the published field that the corner of the sensor sees
    f_number: float  # widest aperture
    pitch_um: float  # pixel pitch
    faults: Faults
    # open share of the pupil at r = 1 over that in the centre, wide open: the clear apertures of the first
    # and the last surface are chosen for it; 1 means as open as the stop lets it be
    corner_light: float = 1.0
    focus_m: float = math.inf  # from the sensor to what is in focus

    @property
    def nominal(self) -> Nominal:
        """The design that this is a copy of."""
        return _nominal(self.design)

    @cached_property
    def scale(self) -> float:
        """Millimetres of the copy per unit of the design."""
        angles, heights, _, _ = principal(self.nominal)
        angle = math.radians(self.cover * self.nominal.prescription.half_field_deg)
        if angle > angles[-1]:
            raise InvalidInputError(f"{self.design} sees {np.degrees(angles[-1]):.1f} degrees only")
        return self.half_diagonal_mm / float(np.interp(angle, angles, heights))

    @property
    def focal_mm(self) -> float:
        """Focal length."""
        return self.scale * self.nominal.focal(AIM_UM)

    @property
    def distance_mm(self) -> float:
        """From what is in focus to the first vertex."""
        return 1000.0 * self.focus_m - self.scale * float(self.nominal.prescription.thickness.sum())

    def working(self, f_number: float | None = None) -> float:
        """F-number of the light at the sensor, of an aperture as it is called; None means widest."""
        return self.nominal.working(f_number or self.f_number, self.distance_mm / self.scale)

    def at_focus(self, focus_m: float) -> TracedLens:
        """Return the lens moved forward to focus on what is `focus_m` from the sensor."""
        return replace(self, focus_m=focus_m)

    @cached_property
    def system(self) -> System:
        """Its surfaces in millimetres, each where it is in this copy."""
        one, faults = self.nominal.prescription, self.faults
        space = np.where(one.glass[:, 0] > 1.0, 0.0, faults.space)
        space[-1] = 0.0  # the focus is set anyway
        count = one.curvature.size
        origin = np.zeros((count + 1, 3))
        origin[1:, 2] = self.scale * np.cumsum(one.thickness * (1.0 + space))
        turn = np.repeat(np.eye(3)[None], count + 1, axis=0)
        for element, shift, tilt in zip(one.elements(), faults.shift_um, faults.tilt_arcmin, strict=True):
            front = origin[element[0]].copy()
            rotation = _rotation(*np.radians(tilt / 60.0))
            for i in element:
                turn[i] = rotation
                origin[i] = front + rotation @ (origin[i] - front) + np.array([*shift / 1000.0, 0.0])
        powers = self.scale ** -(3.0 + 2.0 * np.arange(one.asphere.shape[1]))
        index = np.where(one.glass[:, 0] > 1.0, faults.index, 0.0)
        shapes = (one.curvature / self.scale, one.conic, one.asphere * powers, one.glass)
        return System(*shapes, index, origin, turn, one.stop, self.nominal.rims)

    def stop_mm(self, f_number: float) -> float:
        """Radius of the stop at an aperture."""
        return self.scale * self.nominal.marginal(f_number)[0]

    @cached_property
    def limits_mm(self) -> Array:
        """Clear radii of the first and the last curved surface."""
        if math.isfinite(self.focus_m):
            return self.at_focus(math.inf).limits_mm
        axial = self.scale * self.nominal.marginal(self.f_number)[1]
        if self.corner_light >= 1.0:
            return np.full(axial.shape, np.inf)
        seen, area = self._rays(np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([AIM_UM]), self.f_number)
        inside = np.hypot(*seen.stop[:, :, 0]) <= self.stop_mm(self.f_number)
        rims = (np.hypot(seen.rims[:, 0, :, 0], seen.rims[:, 1, :, 0]) / axial[:, None, None]).max(axis=0)
        needed = np.sort(rims[1][inside[1] & np.isfinite(rims[1])])
        wanted = int(self.corner_light * inside[0].sum() * area[0] / area[1])
        if wanted >= needed.size:
            return np.full(axial.shape, np.inf)
        return axial * max(1.005, float(needed[wanted]))

    @cached_property
    def focus_mm(self) -> float:
        """Distance of the focused sensor behind the design's image plane: smallest mean square spot."""
        turn = np.pi * (0.25 + 0.5 * np.arange(4))
        places = [(0.0, 0.0)]
        weights = [_FOCUS_PLACES[0][1]]
        for r, weight in _FOCUS_PLACES[1:]:
            places += [(r * math.cos(a), r * math.sin(a)) for a in turn]
            weights += [weight / 4.0] * 4
        light = self._light(np.array(places), np.array(GREEN_UM), self.f_number, 0.0)
        open_ = light.outside <= 1.0
        spot, along = (_centred(v, open_) for v in (light.place_um, light.slope))
        share = np.array(weights)[:, None] / np.maximum(open_.sum(axis=2), 1)
        best = -(share * (spot * along).sum(axis=(0, 3))).sum() / (share * (along**2).sum(axis=(0, 3))).sum()
        return float(best + 4.0 * self.working() * self.pitch_um * self.faults.focus_px) / 1000.0

    def wavefronts(
        self, xy: Array, wavelengths_um: Array, f_number: float | None = None
    ) -> NDArray[np.float32]:
        """See `PopulationLens`; piston and tilt are removed, and a ray of p arrives at +2 N dW/dp."""
        return self._fitted(xy, wavelengths_um, f_number)[0]

    def aperture(self, xy: Array, f_number: float | None = None) -> NDArray[np.float32]:
        """Circles `(p, 4, 3)`, (x, y, radius) in pupil radii: what is in all and in the unit disc is open."""
        xy = np.asarray(xy, dtype=np.float64)
        light = self._light(xy, np.array([AIM_UM]), f_number or self.f_number, self.focus_mm)
        return light.circles.astype(np.float32)

    def lateral_um(
        self, xy: Array, wavelengths_um: Array, f_number: float | None = None
    ) -> NDArray[np.float32]:
        """Shift `(p, w, 2)` of the image in each wavelength against their mean: the tilt that was removed."""
        return self._fitted(xy, wavelengths_um, f_number)[1]

    def spots_px(self, xy: Array) -> Array:
        """Root mean square of the rays from their middle along one axis, green, in pixels, `(p,)`."""
        light = self._light(np.asarray(xy), np.array(GREEN_UM), self.f_number, self.focus_mm)
        open_ = light.outside <= 1.0
        spot = _centred(light.place_um, open_)
        square = (spot**2).sum(axis=(0, 3)) / np.maximum(open_.sum(axis=2), 1)
        return np.asarray(np.sqrt(square.mean(axis=1) / 2.0) / self.pitch_um)

    def _fitted(
        self, xy: Array, wavelengths_um: Array, f_number: float | None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], Array]:
        """Coefficients, lateral shifts, and r.m.s. misfit (um) in the open pupil `(p, w)`."""
        wanted = f_number or self.f_number
        if self.f_number * 0.995 > wanted:
            raise InvalidInputError(f"the lens opens to f/{self.f_number:g}, not f/{wanted:g}")
        N = self.working(wanted)
        waves = np.asarray(wavelengths_um, dtype=np.float64)
        light = self._light(np.asarray(xy, dtype=np.float64), waves, wanted, self.focus_mm)
        x, y = light.p
        terms = np.concatenate([np.stack([np.ones_like(x), x, y]), basis(x, y)])  # (t, p, w, r)
        known = np.isfinite(light.path_um)
        weight = np.where(known, np.where(light.outside <= _NEAR, 1.0, _OUTSIDE_WEIGHT), 0.0)
        terms = np.where(known, terms, 0.0).transpose(1, 2, 3, 0)
        path = np.where(known, light.path_um, 0.0)
        path = path - ((weight * path).sum(axis=2) / weight.sum(axis=2))[..., None]
        weighted = (terms * weight[..., None]).swapaxes(2, 3)
        ridge = np.full(terms.shape[3], _RIDGE * _RAYS)
        ridge[:3] = 0.0
        solved = np.linalg.solve(weighted @ terms + np.diag(ridge), weighted @ path[..., None])[..., 0]
        misfit = path - (terms @ solved[..., None])[..., 0]
        inside = known & (light.outside <= 1.0)
        rms = np.sqrt((misfit**2 * inside).sum(axis=2) / np.maximum(inside.sum(axis=2), 1))
        shift = 2.0 * N * solved[..., 1:3]
        shift = shift - shift.mean(axis=1, keepdims=True)
        return solved[..., 3:].astype(np.float32), shift.astype(np.float32), np.asarray(rms)

    def _rays(self, xy: Array, waves: Array, f_number: float) -> tuple[Crossing, Array]:
        """Trace overfilled bundles; also the entrance area `(p,)` per area of the stop."""
        distance = self.distance_mm
        angles, heights, slopes, _ = principal(self.nominal, distance / self.scale)
        r, azimuth = np.hypot(*xy.T), np.arctan2(xy[:, 1], xy[:, 0])
        image = heights + self.nominal.extension(distance / self.scale) * slopes
        image = image * (self.scale / self.half_diagonal_mm)
        theta = np.interp(np.minimum(r, image[-1]), image, angles)
        directions = np.sin(theta)[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
        radius = self.stop_mm(f_number)
        maps = aimed(self.nominal, self.system, self.scale, directions, theta, azimuth, radius, distance)
        entrance = maps[:, :, :2] @ (_OVERFILL * radius * _sunflower(_RAYS)) + maps[:, :, 2:]
        area = np.abs(np.linalg.det(maps[:, :, :2]))
        return self.system.launch(directions, entrance, waves, distance), area

    def _light(self, xy: Array, waves: Array, f_number: float, focus_mm: float) -> _Light:
        seen, _ = self._rays(xy, waves, f_number)
        radius, limits = self.stop_mm(f_number), self.limits_mm
        rims = np.concatenate([seen.stop[None] / radius, seen.rims / limits[:, None, None, None, None]])
        outside = np.hypot(rims[:, 0], rims[:, 1]).max(axis=0)
        arrived = np.isfinite(seen.path) & np.isfinite(outside)
        outside = np.where(arrived, outside, np.inf)
        middle = int(np.argmin(np.abs(waves - AIM_UM)))
        inside = outside[:, middle] <= 1.0
        if (inside.sum(axis=1) < 12).any():
            raise InvalidInputError(f"{self.design}: hardly any light arrives at some place")
        tilt = np.array(self.faults.sensor_tilt_um) / 1000.0
        farther = (focus_mm + xy @ tilt)[:, None, None]
        slope = seen.cosines[:2] / seen.cosines[2]
        place = seen.place + farther * slope
        L = seen.cosines[:2]
        x0 = _mean(place[:, :, middle], inside)[:, :, None, None]
        path = seen.path + farther * seen.cosines[2] - (L * (seen.place - x0)).sum(axis=0)
        working = self.working(f_number)
        centre, circles = _pupil(L[:, :, middle], rims[:, :, :, middle], arrived[:, middle], working)
        p = -2.0 * working * (L - centre[:, :, None, None])
        p, place, slope = (np.where(arrived, v, 0.0) for v in (p, 1000.0 * (place - x0), slope))
        return _Light(p, np.where(arrived, 1000.0 * path, np.nan), outside, place, slope, circles)


def draw(rng: np.random.Generator, designs: Sequence[str], *, opened: bool = False) -> TracedLens:
    """Draw a copy of a design that `forms_image`; if `opened`, one to two stops beyond it and soft."""
    for _ in range(_TRIES * (1 + opened)):
        lens = _candidate(rng, str(rng.choice(list(designs))), opened=opened)
        if (not opened or _is_soft(lens)) and forms_image(lens):
            return lens
    raise InvalidInputError(f"no copy of {', '.join(designs)} forms an image")


def _is_soft(lens: TracedLens) -> bool:
    try:
        return bool(_SOFT_PX[0] < lens.spots_px(np.zeros((1, 2)))[0] < _SOFT_PX[1])
    except InvalidInputError:
        return False


def forms_image(lens: TracedLens) -> bool:
    """Whether light comes through, spots are below eight pixels, and the terms hold the wavefronts."""
    corner = np.array([[math.cos(a), math.sin(a)] for a in (0.6, 2.5, -0.6, -2.5)])
    places = np.concatenate([np.zeros((1, 2)), 0.5 * corner[:2], _EDGE * corner, corner])
    try:
        if lens.spots_px(places)[:-4].max() > _WORST_PX:
            return False
        _, shift, misfit = lens._fitted(places, np.array(_COLOURS_UM), None)  # noqa: SLF001 - of this module
    except InvalidInputError:
        return False
    return bool(np.abs(shift).max() <= _WORST_COLOUR_PX * lens.pitch_um and misfit.max() <= _WORST_MISFIT_UM)


def _candidate(rng: np.random.Generator, design: str, *, opened: bool) -> TracedLens:
    """A copy that may not work. Tolerances of ordinary series production (chosen)."""
    one = PRESCRIPTIONS[design]
    half_diagonal = float(
        rng.choice([21.6, 14.2, 10.8, 8.0], p=[0.4, 0.3, 0.15, 0.15]) * rng.uniform(0.9, 1.1)
    )
    stops = rng.uniform(0.0, 1.5) if rng.random() < 0.55 else -rng.uniform(0.0, 2.0)
    if opened:
        stops = rng.uniform(1.0, 2.0)
    f_number = float(np.clip(one.f_number * 2.0 ** (-stops / 2.0), 0.95, 11.0))
    elements, surfaces = len(one.elements()), one.curvature.size
    focal = half_diagonal / math.tan(math.radians(0.85 * one.half_field_deg))
    size = float(np.clip(focal / 50.0, 0.2, 2.5))
    care = float(np.exp(rng.normal(0.0, 0.7)))
    shift = np.clip(8.0 * care * rng.normal(size=(elements, 2)), -28.0, 28.0) * size
    tilt = np.clip(0.7 * care * rng.normal(size=(elements, 2)), -2.1, 2.1)
    cover, pitch_um = float(rng.uniform(0.7, 1.0)), draw_pitch_um(rng)
    space, index = (rng.uniform(-most, most, surfaces) for most in (0.003, 0.0005))
    sensor = (_limited(rng, 6.0, 20.0), _limited(rng, 6.0, 20.0))
    faults = Faults(
        shift, tilt, space, index, sensor, float(rng.normal(0.0, 0.12) * rng.choice([1.0, 1.0, 2.5]))
    )
    return TracedLens(design, half_diagonal, cover, f_number, pitch_um, faults, float(rng.uniform(0.25, 1.0)))


def _limited(rng: np.random.Generator, deviation: float, limit: float) -> float:
    return float(np.clip(rng.normal(0.0, deviation), -limit, limit))


@cache
def _nominal(design: str) -> Nominal:
    return Nominal(PRESCRIPTIONS[design])


def _pupil(L: Array, rims: Array, arrived: Array, f_number: float) -> tuple[Array, Array]:
    """Cosines `(2, p)` at the middle of the stop, and circles `(p, 4, 3)` around the open pupil."""
    count = L.shape[1]
    p = -2.0 * f_number * L
    circles = np.zeros((count, 4, 3))
    centre = np.zeros((2, count))
    turn = np.linspace(0.0, 2.0 * np.pi, 96, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn)])
    for i in range(count):
        size = np.hypot(rims[0, 0, i], rims[0, 1, i])
        near = arrived[i] & (size <= 1.1)
        middle, shape = _ellipse(p[:, i, near], rims[0][:, i, near])
        centre[:, i] = middle / (-2.0 * f_number)
        axes, lengths, _ = np.linalg.svd(shape)
        a, b = lengths
        radius = (a * a / b + b) / 2.0  # of the two circles that touch the ellipse where it is narrowest
        narrow = axes[:, 1] * (radius - b)
        circles[i, 0] = (*narrow, radius)
        circles[i, 1] = (*-narrow, radius)
        for k in (1, 2):
            circles[i, 1 + k] = (0.0, 0.0, 2.0)
            rim = np.hypot(*rims[k][:, i])
            if not np.isfinite(rims[k][:, i, near]).all() or not (rim[near] > 0.9).any():
                continue
            where, outline = _ellipse(p[:, i, near], rims[k][:, i, near])
            edge = outline @ ring + (where - middle)[:, None]
            within = np.hypot(*np.linalg.solve(shape, edge))
            weight = np.exp(-np.maximum(within - 1.0, 0.0) * 12.0)
            if weight.max() > 1e-3:
                circles[i, 1 + k] = _circle(edge, weight)
    return centre, circles


def _ellipse(p: Array, crossing: Array) -> tuple[Array, Array]:
    """Middle `(2,)` and shape `(2, 2)`: p = middle + shape @ crossing, least squares."""
    basis = np.vstack([crossing, np.ones(p.shape[1])])
    solved = np.linalg.lstsq(basis.T, p.T, rcond=None)[0].T
    return np.asarray(solved[:, 2]), np.asarray(solved[:, :2])


def _circle(points: Array, weight: Array) -> tuple[float, float, float]:
    """Weighted algebraic fit of a circle. Source: I. Kasa, IEEE Trans. Instrum. Meas. 25, 1976."""
    x, y = points
    basis = np.stack([x, y, np.ones_like(x)], axis=1)
    w = weight[:, None]
    a, b, c = np.linalg.lstsq(basis * w, (x * x + y * y) * weight, rcond=None)[0]
    return float(a / 2.0), float(b / 2.0), float(math.sqrt(c + (a * a + b * b) / 4.0))


def _centred(values: Array, open_: NDArray[np.bool_]) -> Array:
    """Values `(2, p, w, r)` less their mean over open rays; 0 elsewhere."""
    mean = (values * open_).sum(axis=3, keepdims=True) / np.maximum(open_.sum(axis=2), 1)[..., None]
    return np.asarray((values - mean) * open_)


def _mean(values: Array, chosen: NDArray[np.bool_]) -> Array:
    return np.asarray(np.where(chosen, values, 0.0).sum(axis=-1) / chosen.sum(axis=-1))


def _rotation(about_x: float, about_y: float) -> Array:
    """Rotation about the right, then about the up axis."""
    cx, sx, cy, sy = math.cos(about_x), math.sin(about_x), math.cos(about_y), math.sin(about_y)
    x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    return np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]]) @ x


@cache
def _sunflower(count: int) -> Array:
    """Points `(2, count)` that fill the unit disc evenly, a sixth of them on its edge."""
    edge = count // 6
    inner = np.sqrt((np.arange(count - edge) + 0.5) / (count - edge))
    radius = np.concatenate([inner, np.ones(edge)])
    golden = math.pi * (3.0 - math.sqrt(5.0))
    angle = np.concatenate([golden * np.arange(count - edge), 2.0 * math.pi * np.arange(edge) / edge])
    return radius * np.vstack([np.cos(angle), np.sin(angle)])


def grid_of(
    lens: TracedLens, f_number: float | None = None, *, step: float = 0.1, size: int = 55
) -> GridField:
    """Kernels of odd side `size` of a traced lens at nodes of the field, wide open by default.

    Nodes lie `step` half diagonals apart, which divides 1; those beyond the corner repeat the nearest inside.
    """
    reach = round(1.0 / step) + 1
    axis = np.arange(-reach, reach + 1, dtype=np.float64) * step
    right, up = np.meshgrid(axis, axis)
    radius = np.hypot(right, up)
    inside = np.argwhere(radius <= _INSIDE)
    xy = np.stack([right[tuple(inside.T)], up[tuple(inside.T)]], -1)
    parts = [kernels_of(lens, xy[i : i + _AT_ONCE], f_number) for i in range(0, len(xy), _AT_ONCE)]
    margin = (SIDE - size) // 2
    cut = np.concatenate(parts)[:, :, margin : SIDE - margin, margin : SIDE - margin]
    cut = cut / cut.sum((-1, -2), keepdims=True)
    shifts = np.concatenate(
        [lens.lateral_um(xy[i : i + _AT_ONCE], WAVELENGTHS_UM, f_number) for i in range(0, len(xy), _AT_ONCE)]
    )
    of_colours = shifts.reshape(len(xy), 3, 2, 2).mean(2) / lens.pitch_um
    n = axis.size
    kernels = np.zeros((3, n, n, size, size), np.float16)
    centers = np.zeros((3, n, n, 2), np.float32)
    kernels[:, inside[:, 0], inside[:, 1]] = cut.transpose(1, 0, 2, 3)
    centers[:, inside[:, 0], inside[:, 1]] = (of_colours - of_colours[:, 1:2]).transpose(1, 0, 2)
    for i, j in np.argwhere(radius > _INSIDE):
        near = inside[np.argmin(np.hypot(*(inside - (i, j)).T))]
        kernels[:, i, j], centers[:, i, j] = kernels[:, near[0], near[1]], centers[:, near[0], near[1]]
    known = {name: getattr(lens, name) for name in ("design", "focal_mm", "pitch_um", "half_diagonal_mm")}
    apertures = {"widest": lens.f_number, "f_number": f_number or lens.f_number}
    facts = known | apertures | {"source": PRESCRIPTIONS[lens.design].source}
    return GridField(axis, kernels, centers, facts)
