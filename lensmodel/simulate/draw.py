"""Lenses drawn at random: copies of different kinds, of realistic blur, by seed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from lensmodel.core.errors import UnknownMethodError
from lensmodel.simulate.lens import DEFAULT_PITCH_UM, REFERENCE_UM, Aberrations, SimulatedLens


@dataclass(frozen=True, slots=True)
class _Kind:
    """Proportions of the aberrations of a kind of lens, and how much blur they shall make."""

    f_numbers: tuple[float, ...]
    center_px: tuple[float, float]  # rms width of the ray spot at the centre, pixels of 4.5 um: from, to
    corner_px: tuple[float, float]  # same at r = 1, mean over phi
    fixed: Mapping[str, float] = field(default_factory=dict)  # other than the defaults of `_Config`
    drawn: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # from, to

    def config(self, rng: np.random.Generator) -> _Config:
        """Draw one copy."""
        f_number = float(rng.choice(self.f_numbers))
        center, corner = (float(rng.uniform(*ends)) for ends in (self.center_px, self.corner_px))
        drawn = {name: float(rng.uniform(*ends)) for name, ends in self.drawn.items()}
        return _Config(f_number, center, corner, **{**self.fixed, **drawn})


@dataclass(frozen=True, slots=True)
class _Config:
    """What was drawn of a kind; widths as there, uniform faults and tilt as shares of the corner's blur."""

    f_number: float
    center_px: float
    corner_px: float
    spherical: float = 1.0
    coma: float = 1.0
    astigmatism: float = 1.0
    field_curvature: float = 1.0
    decentring: float = 0.05
    uniform_coma: float = 0.03
    uniform_astigmatism: float = 0.03
    tilt: float = 0.03


_KINDS: Final = {
    "soft-fast": _Kind((1.4, 1.6, 1.8), (0.9, 1.4), (2.2, 4.2), {"coma": 1.5}),
    "coma": _Kind(
        (1.8, 2.0, 2.4), (0.3, 0.7), (1.3, 3.0), {"coma": 3.0, "astigmatism": 0.4, "field_curvature": 0.3}
    ),
    "astigmatism": _Kind(
        (2.0, 2.4, 2.8), (0.3, 0.7), (1.2, 3.0), {"coma": 0.4, "astigmatism": 3.0, "field_curvature": 0.2}
    ),
    "field-curvature": _Kind(
        (1.8, 2.0, 2.8), (0.3, 0.7), (1.2, 3.0), {"coma": 0.4, "astigmatism": 0.3, "field_curvature": 3.0}
    ),
    "decentred": _Kind(
        (1.8, 2.0, 2.8), (0.4, 0.8), (1.2, 2.6), drawn={"decentring": (0.2, 0.4), "uniform_coma": (0.15, 0.3)}
    ),
    "tilted": _Kind(
        (1.8, 2.0, 2.8),
        (0.3, 0.7),
        (1.0, 2.2),
        drawn={"tilt": (0.4, 0.7), "uniform_astigmatism": (0.05, 0.15)},
    ),
    "nearly-perfect": _Kind((2.8, 3.5, 4.0), (0.1, 0.25), (0.5, 0.8), {"tilt": 0.1}),
    "zoom": _Kind((2.8, 3.5, 4.0), (0.4, 0.9), (1.2, 3.0), {"decentring": 0.12}),
}

LENS_KINDS: Final = tuple(_KINDS)
"""Kinds of lenses that `draw_lens` knows."""


def draw_lens(seed: int, kind: str | None = None) -> SimulatedLens:
    """Draw a copy of a lens.

    Notes
    -----
    Blur is set through the ray spot: its root mean square width per axis, over the whole pupil,
    without diffraction and pixel, hits a width drawn for the centre and one for the corner.
    """
    kind = LENS_KINDS[seed % len(LENS_KINDS)] if kind is None else kind
    if kind not in _KINDS:
        raise UnknownMethodError(f"no kind of lens {kind!r}; known: {', '.join(LENS_KINDS)}")
    rng = np.random.default_rng([seed, LENS_KINDS.index(kind)])
    serial = f"SIM{seed:07d}"
    if kind == "zoom":
        short, long = float(rng.choice([18.0, 24.0, 28.0])), float(rng.choice([70.0, 85.0, 105.0]))
        config = _KINDS[kind].config(rng)
        wide = _optics(config, rng)
        tele = _optics(replace(config, corner_px=config.corner_px * float(rng.uniform(0.6, 1.1))), rng)
        # a shifted element stays where it is when one zooms
        tele = replace(tele, decentring=wide.decentring, tilt=wide.tilt)
        name = f"Simulated Zoom {short:.0f}-{long:.0f}mm f/{config.f_number:g}"
        return SimulatedLens((wide, tele), (short, long), model=name, serial=serial)
    focal = float(rng.choice([24.0, 35.0, 50.0, 85.0]))
    config = _KINDS[kind].config(rng)
    name = f"Simulated {kind.title()} {focal:.0f}mm f/{config.f_number:g}"
    return SimulatedLens((_optics(config, rng),), (focal,), model=name, serial=serial)


def _optics(config: _Config, rng: np.random.Generator) -> Aberrations:
    sign = rng.choice([-1.0, 1.0], size=4)
    part = rng.uniform(0.5, 1.0, size=4) * sign
    spherical, coma, astigmatism, curvature = (
        config.spherical * part[0],
        config.coma * part[1],
        config.astigmatism * part[2],
        config.field_curvature * part[3],
    )
    angle = rng.uniform(0.0, 2.0 * math.pi, size=4)

    def vector(k: int, length: float) -> tuple[float, float]:
        return length * math.cos(angle[k]), length * math.sin(angle[k])

    center = Aberrations(f_number=config.f_number, spherical=spherical, defocus=-1.1 * spherical)
    center = _scaled(center, config.center_px / _spot_px(center, 0.0))
    outer = Aberrations(
        f_number=config.f_number,
        coma=coma,
        astigmatism=astigmatism,
        field_curvature=curvature - astigmatism / 2.0,  # the flat compromise between the two foci
    )
    outer = _scaled(outer, config.corner_px / _spot_px(outer, 1.0))
    blur = _waves(config.corner_px, config.f_number)
    side = rng.choice([-1.0, 1.0])
    colour = float(rng.uniform(0.1, 0.4)) * blur
    return replace(
        outer,
        spherical=center.spherical,
        defocus=center.defocus,
        decentring=vector(0, config.decentring * float(rng.uniform(0.7, 1.3))),
        uniform_coma=vector(1, config.uniform_coma * blur),
        uniform_astigmatism=vector(2, config.uniform_astigmatism * blur),
        tilt=vector(3, config.tilt * blur),
        colour_focus=(side * colour * 0.3, colour * 0.6),
        vignetting=(1.15, float(rng.uniform(0.15, 0.4))),
        lateral_red=(float(rng.normal(0.0, 4e-4)), float(rng.normal(0.0, 3e-4))),
        lateral_blue=(float(rng.normal(0.0, 4e-4)), float(rng.normal(0.0, 3e-4))),
    )


def _waves(width_px: float, f_number: float) -> float:
    """Defocus in waves whose ray spot has this rms width per axis: a disc of radius 2 width."""
    return 2.0 * width_px * DEFAULT_PITCH_UM / (4.0 * REFERENCE_UM * f_number)


def _scaled(optics: Aberrations, factor: float) -> Aberrations:
    return replace(
        optics,
        spherical=optics.spherical * factor,
        defocus=optics.defocus * factor,
        coma=optics.coma * factor,
        astigmatism=optics.astigmatism * factor,
        field_curvature=optics.field_curvature * factor,
    )


def _spot_px(optics: Aberrations, r: float) -> float:
    """Root mean square width per axis of the ray spot on the axis phi = 0, pixels of 4.5 um."""
    p = (np.arange(64) + 0.5) / 32.0 - 1.0
    px, py = np.meshgrid(p, p)
    inside = px**2 + py**2 <= 1.0
    px, py = px[inside], py[inside]
    radius2 = px**2 + py**2
    w040, coma = optics.spherical, optics.coma * r
    focus = optics.defocus + optics.field_curvature * r * r
    gx = 4 * w040 * radius2 * px + coma * (radius2 + 2 * px * px)
    gx = gx + 2 * (focus + optics.astigmatism * r * r) * px
    gy = 4 * w040 * radius2 * py + 2 * coma * px * py + 2 * focus * py
    scale = 2.0 * REFERENCE_UM * optics.f_number / DEFAULT_PITCH_UM
    return scale * math.sqrt((float(np.var(gx)) + float(np.var(gy))) / 2.0)
