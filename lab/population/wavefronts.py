"""Lenses as random wavefront fields: aberrations of all orders that vary over the field, wavelength and copy.

The family "wavefront" draws Zernike terms up to the eighth order, each a polynomial of the field with
decaying random weights around a node of its own (R. V. Shack, K. Thompson, "Influence of alignment errors of
a telescope system on its aberration field", Proc. SPIE 251, 1980). "third-order" keeps the five Seidel
terms, defocus and what decentring adds to them.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from lab.population.kernels import COLUMNS, TERMS, draw_pitch_um, spots, stopped_down

Family = Literal["wavefront", "third-order"]

_HIGHEST: Final = 8  # order of the drawn terms
_MIDDLE_UM, _BAND_UM = 0.537, 0.08  # wavelength and scale of its polynomial
_LARGEST: Final = 9.0  # pixels: largest r.m.s. radius of a spot anywhere (chosen)
_COMMON_STOPS: Final = (1.2, 1.4, 1.8, 2.0, 2.8, 2.8, 3.5, 4.0, 4.0, 4.5, 5.6, 8.0)

_INDEX: Final = {term: 2 * i for i, term in enumerate(TERMS)}


@dataclass(frozen=True, slots=True)
class _Field:
    """Weights of one wavefront field, before it is scaled and focused."""

    weights: dict[tuple[int, int], NDArray[np.float64]]  # of H^m H^2j
    nodes: dict[tuple[int, int], NDArray[np.float64]]  # where a term's field vanishes
    bounded: bool  # Legendre instead of monomials: fields that turn back towards the corner
    relative: dict[tuple[int, int], NDArray[np.float64]]  # change of each term with wavelength
    axial: NDArray[np.float64]
    axial_field: NDArray[np.float64]
    spherical: NDArray[np.float64]
    coma: NDArray[np.float64]
    tilt: NDArray[np.float64]
    axis_coma: NDArray[np.float64]
    axis_astigmatism: NDArray[np.float64]

    def coefficients(
        self, xy: NDArray[np.float64], wavelengths_um: NDArray[np.float64], focus: float
    ) -> NDArray[np.float64]:
        """Coefficients (place, wavelength, COLUMNS), not scaled."""
        u = (np.asarray(wavelengths_um) - _MIDDLE_UM) / _BAND_UM
        x, y = xy[:, 0], xy[:, 1]
        out = np.zeros((len(xy), len(u), COLUMNS))
        for term, weights in self.weights.items():
            m = term[1]
            hx, hy = x - self.nodes[term][0], y - self.nodes[term][1]
            h2, angle = hx * hx + hy * hy, np.arctan2(hy, hx)
            powers = (
                [_legendre(j, np.minimum(h2, 1.3)) for j in range(len(weights))]
                if self.bounded and m > 0
                else [h2**j for j in range(len(weights))]
            )
            value = sum(w * p for w, p in zip(weights, powers, strict=True)) * np.sqrt(h2) ** m
            change = 1.0 + self.relative[term][0] * u + self.relative[term][1] * u * u
            out[..., _INDEX[term]] = (value * np.cos(m * angle))[:, None] * change
            out[..., _INDEX[term] + 1] = (value * np.sin(m * angle))[:, None] * change

        def colour(weight: NDArray[np.float64]) -> NDArray[np.float64]:
            return weight[0] * u + weight[1] * u * u

        h2 = (x * x + y * y)[:, None]
        out[..., _INDEX[2, 0]] += focus + colour(self.axial) + h2 * colour(self.axial_field)
        out[..., _INDEX[2, 0]] += (self.tilt[0] * x + self.tilt[1] * y)[:, None]
        out[..., _INDEX[4, 0]] += colour(self.spherical)
        for k in range(2):
            out[..., _INDEX[3, 1] + k] += self.axis_coma[k] + colour(self.coma) * xy[:, k, None]
            out[..., _INDEX[2, 2] + k] += self.axis_astigmatism[k]
        return out


def _legendre(j: int, t: NDArray[np.float64]) -> NDArray[np.float64]:
    x = 2 * t - 1
    return [np.ones_like(x), x, 1.5 * x * x - 0.5, 2.5 * x**3 - 1.5 * x][j]


def _draw_field(rng: np.random.Generator, family: Family, decentring: float) -> _Field:
    third = family == "third-order"
    order_decay, field_decay = rng.uniform(0.35, 1.3), rng.uniform(0.3, 1.2)
    on_axis = np.exp(rng.normal(-1.3, 0.8)) * (4.0 if rng.random() < 0.15 else 1.0)
    of_symmetry = np.exp(rng.normal(0, 0.6, 3))
    spherical = np.exp(rng.normal(0, 0.7))
    common = rng.normal(0, 1, 2) * decentring
    weights, nodes = {}, {}
    for n, m in TERMS:
        if n > _HIGHEST or (third and (n, m) not in {(2, 0), (2, 2), (3, 1), (4, 0)}):
            continue
        count = 1 if third and (n, m) != (2, 0) else 2 if third else (6 - m) // 2 + 1
        size = np.exp(-0.6 * order_decay * (n - 2))
        size *= (1.0, of_symmetry[0], of_symmetry[1], 0.5 * of_symmetry[2])[min(m, 3)]
        if m == 0 and n >= 4:
            size *= spherical
        drawn = rng.standard_t(5, 4)[:count] * size * np.exp(-field_decay * np.arange(count))
        if m == 0:
            drawn[0] *= on_axis
        weights[n, m] = drawn
        nodes[n, m] = common * rng.uniform(0.3, 1.7) + rng.normal(0, 1, 2) * decentring
    colour = np.exp(rng.normal(np.log(0.45), 0.9)) * rng.choice([1, 1, 1, 0.2])
    return _Field(
        weights,
        nodes,
        bounded=not third and rng.random() < 0.4,
        relative={term: rng.normal(0, 0.12, 2) for term in weights},
        axial=rng.normal(0, 0.7, 2) * colour,
        axial_field=rng.normal(0, 0.35, 2) * colour,
        spherical=rng.normal(0, 0.3, 2) * colour,
        coma=rng.normal(0, 0.25, 2) * colour,
        tilt=rng.normal(0, 1, 2) * np.exp(rng.normal(np.log(0.12), 0.9)),
        axis_coma=rng.normal(0, 1, 2) * np.exp(rng.normal(np.log(0.06), 0.9)),
        axis_astigmatism=rng.normal(0, 1, 2) * np.exp(rng.normal(np.log(0.04), 0.9)),
    )


_FOCUS_PLACES: Final = np.array(
    [[0.2 * np.cos(t), 0.2 * np.sin(t)] for t in (0.4, 2.5, 4.6)]
    + [[0.55 * np.cos(t), 0.55 * np.sin(t)] for t in (0.1, 1.7, 3.2, 4.9)]
    + [[0.9 * np.cos(t), 0.9 * np.sin(t)] for t in (0.7, 2.8, 5.2)]
)
_FOCUS_WEIGHTS: Final = np.array([2.0] * 3 + [1.0] * 4 + [0.4] * 3)


class RandomLens:
    """A lens of the families "wavefront" or "third-order", everything drawn; see `PopulationLens`."""

    def __init__(self, rng: np.random.Generator, family: Family = "wavefront", *, zoom: bool = False) -> None:
        self.f_number = float(np.exp(rng.uniform(np.log(1.2), np.log(8.0))))
        if rng.random() < 0.6:
            self.f_number = float(rng.choice(_COMMON_STOPS))
        self.pitch_um = draw_pitch_um(rng)
        self.focal_mm = float(np.exp(rng.uniform(np.log(10), np.log(300))))
        self.state = 0.0
        decentring = float(np.exp(rng.normal(np.log(0.06), 0.8))) if rng.random() > 0.15 else 0.0
        self._fields = [_draw_field(rng, family, decentring) for _ in range(1 + zoom)]
        self._rims = np.array(
            [[rng.uniform(0, 0.65), rng.uniform(0.97, 1.35)], [-rng.uniform(0, 0.4), rng.uniform(1.0, 1.4)]]
        )
        target = np.exp(rng.uniform(np.log(0.18), np.log(3.4)))
        error = rng.normal(0, 0.08) * rng.choice([1, 1, 3])
        weaker = rng.choice([1, 1, 0.5])  # some autofocus systems miss the best plane
        self._focus: list[float] = []
        self._scale: list[float] = []
        for field in self._fields:
            at = [self._spots(field, f) for f in (0.0, 1.0, -1.0)]
            curve = (at[1] ** 2 + at[2] ** 2) / 2 - at[0] ** 2
            slope = (at[1] ** 2 - at[2] ** 2) / 2
            best = -(_FOCUS_WEIGHTS * slope).sum() / (2 * (_FOCUS_WEIGHTS * curve).sum())
            focus = float(best * weaker + error)
            radii = self._spots(field, focus)
            scale = min(target / np.median(radii), _LARGEST / radii.max())
            self._focus.append(focus)
            self._scale.append(float(scale) * float(np.exp(rng.normal(0, 0.2)) if len(self._scale) else 1.0))

    def _spots(self, field: _Field, focus: float) -> NDArray[np.float64]:
        green = field.coefficients(_FOCUS_PLACES, np.array([_MIDDLE_UM]), focus)[:, 0]
        return spots(green, self.f_number)[1] / self.pitch_um

    def at_state(self, state: float) -> RandomLens:
        """Return the lens at another focal length or focus: 0 and 1 are the two fields that were drawn."""
        other = copy(self)
        other.state = state
        return other

    def working(self, f_number: float | None = None) -> float:
        """F-number of the light at the sensor: the aperture as it is called."""
        return self.f_number if f_number is None else f_number

    def wavefronts(
        self, xy: NDArray[np.float64], wavelengths_um: NDArray[np.float64], f_number: float | None = None
    ) -> NDArray[np.float64]:
        """Coefficients (place, wavelength, COLUMNS) in micrometres; see `PopulationLens`."""
        parts = [
            field.coefficients(xy, wavelengths_um, focus) * scale
            for field, focus, scale in zip(self._fields, self._focus, self._scale, strict=True)
        ]
        whole = parts[0] if len(parts) == 1 else (1 - self.state) * parts[0] + self.state * parts[1]
        if f_number is None or f_number <= self.f_number:
            return whole
        return whole @ stopped_down(self.f_number / f_number)

    def aperture(self, xy: NDArray[np.float64], f_number: float | None = None) -> NDArray[np.float64]:
        """Two rims that move against the pupil along the radius, in radii of the pupil at the f-number."""
        ratio = 1.0 if f_number is None else max(f_number / self.f_number, 1.0)
        circles = np.empty((len(xy), 2, 3))
        for c, (shift, radius) in enumerate(self._rims):
            circles[:, c, :2] = -shift * xy * ratio
            circles[:, c, 2] = radius * ratio
        return circles
