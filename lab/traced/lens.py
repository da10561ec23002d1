"""One copy of a traced lens: its exact PSF at any place, aperture and channel."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lab.traced.designs import designs
from lab.traced.image import kernel_of, transmission
from lab.traced.prescription import Design
from lab.traced.rays import Array, Fault, Tracer
from lab.traced.wave import TracedPupil
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import CHANNELS, WAVELENGTH_NM, Channel, FieldPosition, Kernel

BAND_NM: Final[dict[Channel, float]] = {"r": 32.0, "g": 38.0, "b": 32.0}
"""Standard deviation of a channel's light: full widths of 75, 90 and 75 nm, typical of Bayer filters."""

FOCUS_POINTS: Final = ((0.0, 1.0), (0.35, 0.5), (0.65, 0.25))
"""Where an autofocus looks: radius and weight of rings of four points. Chosen: mostly the middle."""

FIELD_MARGIN: Final = 1.05
"""Fields are traced so far beyond the corner: light of outside blurs into the frame."""

_CHIEF_STEPS: Final = 24  # fields between axis and corner that chief rays are traced for (chosen)


def spectrum(channel: Channel, count: int = 3) -> tuple[tuple[float, float], ...]:
    """Wavelengths (um) and weights of a Gaussian band: Gauss-Hermite quadrature of `count` points."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(count)
    middle, width = WAVELENGTH_NM[channel], BAND_NM[channel]
    return tuple(
        (float(middle + width * t) / 1000.0, float(w / weights.sum()))
        for t, w in zip(nodes, weights, strict=True)
    )


@dataclass(frozen=True)
class Copy:
    """What makes one copy of a design; see `TracedLens`."""

    design: str  # name in `designs`
    f_number: float  # widest aperture; it may be up to two stops wider than the design's own
    # half the diagonal of the sensor: the design is scaled so that its largest field reaches it
    half_diagonal_mm: float = 8.11
    faults: tuple[Fault, ...] = ()  # elements that are shifted and tilted
    # how far the sensor lies behind its place at r = 1 to the right, and upwards
    sensor_tilt_um: tuple[float, float] = (0.0, 0.0)
    # Transmission of the pupil at r = 1 over that in the centre, wide open: clear apertures of the first and
    # last surface are chosen for it. 1 means none.
    corner_light: float = 0.5
    wavelengths: int = 3  # per channel


@dataclass(frozen=True)
class TracedLens:
    """A copy of a design, scaled, opened, focused: the exact PSF.

    Notes
    -----
    Cost: 0.1 to 0.4 CPU seconds a kernel.
    """

    copy: Copy

    @cached_property
    def design(self) -> Design:
        """The design in millimetres."""
        design = designs.create(self.copy.design)
        reach = abs(_chief_heights(Tracer(design), design.half_field_deg, 1.0)[1][-1])
        return design.scaled(self.copy.half_diagonal_mm / reach)

    @cached_property
    def rims(self) -> tuple[int, ...]:
        """Surfaces whose clear apertures vignette: the first and the last curved ones.

        A plane cover glass is left out: there the axial light is far narrower than the image.
        """
        curved = [i for i, surface in enumerate(self.design.surfaces) if math.isfinite(surface.radius)]
        return (curved[0], curved[-1])

    @cached_property
    def _perfect(self) -> Tracer:
        return Tracer(self.design, (), self.rims)

    @cached_property
    def _tracer(self) -> Tracer:
        return Tracer(self.design, self.copy.faults, self.rims)

    @cached_property
    def _field(self) -> tuple[Array, Array, list[Array]]:
        """Angles, image heights over the half diagonal, and maps to aim by, of principal rays."""
        angles, heights, maps = _chief_heights(self._perfect, self.design.half_field_deg, 1.3)
        return angles, heights / self.copy.half_diagonal_mm, maps

    @property
    def largest_r(self) -> float:
        """Beyond this radius no light is traced: there the PSF of this radius answers."""
        return min(float(self._field[1][-1]), FIELD_MARGIN)

    @cached_property
    def focal_mm(self) -> float:
        """Focal length."""
        angles, heights, _ = self._field
        return float(heights[1] * self.copy.half_diagonal_mm / math.tan(angles[1]))

    @cached_property
    def _stops(self) -> dict[float, float]:
        return {}

    def stop_radius(self, f_number: float) -> float:
        """Radius of the stop in mm at an aperture."""
        if f_number in self._stops:
            return self._stops[f_number]
        if f_number < self.copy.f_number * 0.995:
            raise InvalidInputError(f"the lens opens to f/{self.copy.f_number:g}, not f/{f_number:g}")
        self._stops[f_number] = float(self._perfect.marginal(f_number)[0])
        return self._stops[f_number]

    @cached_property
    def limits(self) -> tuple[float, ...]:
        """Clear radii of `rims` in mm."""
        axial = self._perfect.marginal(self.copy.f_number)[1:]
        open_ = tuple(float(a) * 4.0 for a in axial)
        if self.copy.corner_light >= 1.0:
            return open_
        radius = self.stop_radius(self.copy.f_number)
        wave = (WAVELENGTH_NM["g"] / 1000.0,)
        center = self._pupils(self._perfect, (0.0, 0.0), radius, wave, open_)[0]
        corner = self._pupils(self._perfect, (1.0, 0.0), radius, wave, open_)[0]
        full = transmission(center, radius, open_)
        low, high = 1.005, 4.0  # the axial bundle passes whole
        for _ in range(20):
            middle = 0.5 * (low + high)
            limits = tuple(float(a) * middle for a in axial)
            if transmission(corner, radius, limits) < self.copy.corner_light * full:
                low = middle
            else:
                high = middle
        return tuple(float(a) * high for a in axial)

    @cached_property
    def focus_um(self) -> float:
        """Distance of the focused sensor behind the traced plane: least mean square path, wide open."""
        radius = self.stop_radius(self.copy.f_number)
        waves = tuple(w for w, _ in spectrum("g", self.copy.wavelengths))
        weights = [w for _, w in spectrum("g", self.copy.wavelengths)]
        above = below = 0.0
        for r, share in FOCUS_POINTS:
            points = 1 if r == 0 else 4
            for k in range(points):
                angle = math.pi * (0.25 + 0.5 * k)
                h = (r * math.cos(angle), r * math.sin(angle))
                for pupil, weight in zip(
                    self._pupils(self._tracer, h, radius, waves, self.limits), weights, strict=True
                ):
                    step = 2.0 * max(pupil.half) / 48
                    L, M = pupil.grid(step)
                    amplitude, path = pupil.evaluate(L, M, radius, self.limits, 0.0)
                    _, longer = pupil.evaluate(L, M, radius, self.limits, 1.0)
                    light = amplitude**2 / (amplitude**2).sum()
                    tilt = np.stack(np.broadcast_arrays(np.ones_like(path), L[None, :], M[:, None]))
                    slope = _without(longer - path, tilt, light)
                    part = weight * share / points
                    above -= part * float((light * slope * _without(path, tilt, light)).sum())
                    below += part * float((light * slope * slope).sum())
        return above / below

    def pupils(
        self, h: tuple[float, float], channel: Channel, f_number: float
    ) -> list[tuple[TracedPupil, float, float]]:
        """Pupils of a field vector (right, up) with wavelengths (um) and weights of the channel."""
        return self._coloured(h, (channel,), f_number)[channel]

    def pupils_of_all(
        self, h: tuple[float, float], f_number: float
    ) -> dict[Channel, list[tuple[TracedPupil, float, float]]]:
        """`pupils` of all channels, with one reference point."""
        return self._coloured(h, CHANNELS, f_number)

    def _coloured(
        self, h: tuple[float, float], channels: tuple[Channel, ...], f_number: float
    ) -> dict[Channel, list[tuple[TracedPupil, float, float]]]:
        colours = [(c, wave, weight) for c in channels for wave, weight in spectrum(c, self.copy.wavelengths)]
        waves = tuple(wave for _, wave, _ in colours)
        found = self._pupils(self._tracer, h, self.stop_radius(f_number), waves, self.limits)
        by_channel: dict[Channel, list[tuple[TracedPupil, float, float]]] = {c: [] for c in channels}
        for pupil, (channel, wave, weight) in zip(found, colours, strict=True):
            by_channel[channel].append((pupil, wave, weight))
        return by_channel

    def sensor_um(self, h: tuple[float, float]) -> float:
        """Distance of the tilted sensor behind the traced plane at a field vector."""
        tilt = self.copy.sensor_tilt_um
        return self.focus_um + tilt[0] * h[0] + tilt[1] * h[1]

    def kernel(
        self,
        position: FieldPosition,
        channel: Channel = "g",
        size: int = 55,
        *,
        f_number: float | None = None,
        pitch_um: float = 4.5,
    ) -> Kernel:
        """Exact kernel, centred, `(size, size)`, at a place, channel and aperture (None: widest)."""
        h = (position.r * math.cos(position.phi), position.r * math.sin(position.phi))
        n = f_number or self.copy.f_number
        return kernel_of(
            self.pupils(h, channel, n),
            self.stop_radius(n),
            self.limits,
            size=size,
            pitch_um=pitch_um,
            focus_um=self.sensor_um(h),
        )[0]

    def _pupils(
        self,
        tracer: Tracer,
        h: tuple[float, float],
        radius: float,
        waves: tuple[float, ...],
        limits: tuple[float, ...],
    ) -> list[TracedPupil]:
        angles, heights, maps = self._field
        r = min(math.hypot(*h), self.largest_r)
        theta = float(np.interp(r, heights, angles))
        phi = math.atan2(h[1], h[0])
        direction = (math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi))
        start = _turned(maps[int(np.argmin(np.abs(heights - r)))], phi)
        return [TracedPupil.of(b) for b in tracer.bundles(direction, radius, waves, limits, start=start)]


def _chief_heights(tracer: Tracer, half_field_deg: float, beyond: float) -> tuple[Array, Array, list[Array]]:
    """Angles and image heights (mm) of principal rays along +x, as far as light comes through."""
    radius = float(tracer.marginal(max(tracer.design.f_number, 4.0))[0])
    angles, heights, maps = [0.0], [0.0], [tracer.affine((0.0, 0.0), radius, None)]
    count = round(_CHIEF_STEPS * beyond)
    for k in range(1, count + 1):
        angle = math.radians(half_field_deg) * k / _CHIEF_STEPS
        direction = (math.sin(angle), 0.0)
        try:
            start = tracer.affine(direction, radius, maps[-1])
        except InvalidInputError:
            break
        place, *_ = tracer.launch(direction, start[:, 2:], np.array([0.54]))
        height = float(place[0, 0])
        if not math.isfinite(height) or abs(height) <= abs(heights[-1]):
            break
        angles.append(angle)
        heights.append(height)
        maps.append(start)
    return np.array(angles), np.array(heights), maps


def _turned(start: Array, phi: float) -> Array:
    """Turn the map of a field point on +x to one at angle phi."""
    c, s = math.cos(phi), math.sin(phi)
    turn = np.array([[c, -s], [s, c]])
    linear = turn @ start[:, :2] @ turn.T
    return np.hstack([linear, turn @ start[:, 2:]])


def _without(values: Array, basis: NDArray[np.float64], light: Array) -> Array:
    """Remove the weighted least-squares fit of `basis` `(k, ...)` from `values`."""
    flat = basis.reshape(basis.shape[0], -1)
    w = light.ravel()
    solved = np.linalg.solve((flat * w) @ flat.T, (flat * w) @ values.ravel())
    return np.asarray(values - np.tensordot(solved, basis, axes=1))
