"""Lenses drawn at random: copies of different kinds, of realistic blur, by seed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from lensmodel.core.errors import UnknownMethodError
from lensmodel.simulate.aberrations import Aberrations
from lensmodel.simulate.lens import DEFAULT_PITCH_UM, SimulatedLens
from lensmodel.simulate.pupil import REFERENCE_UM

Draw = Callable[[np.random.Generator], "_Recipe"]


@dataclass(frozen=True, slots=True)
class _Recipe:
    """Proportions of the aberrations, and how much blur they shall make."""

    f_number: float
    center_px: float  # rms width of the ray spot at the centre, pixels of 4.5 um
    corner_px: float  # same at r = 1, mean over phi
    spherical: float = 1.0
    coma: float = 1.0
    astigmatism: float = 1.0
    field_curvature: float = 1.0
    decentring: float = 0.05
    uniform_coma: float = 0.03  # as a share of the blur of the corner
    uniform_astigmatism: float = 0.03
    tilt: float = 0.03


def _recipes() -> dict[str, Draw]:
    def uniform(rng: np.random.Generator, low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    return {
        "soft-fast": lambda g: _Recipe(
            float(g.choice([1.4, 1.6, 1.8])), uniform(g, 0.9, 1.4), uniform(g, 2.2, 4.2), coma=1.5
        ),
        "coma": lambda g: _Recipe(
            float(g.choice([1.8, 2.0, 2.4])),
            uniform(g, 0.3, 0.7),
            uniform(g, 1.3, 3.0),
            coma=3.0,
            astigmatism=0.4,
            field_curvature=0.3,
        ),
        "astigmatism": lambda g: _Recipe(
            float(g.choice([2.0, 2.4, 2.8])),
            uniform(g, 0.3, 0.7),
            uniform(g, 1.2, 3.0),
            coma=0.4,
            astigmatism=3.0,
            field_curvature=0.2,
        ),
        "field-curvature": lambda g: _Recipe(
            float(g.choice([1.8, 2.0, 2.8])),
            uniform(g, 0.3, 0.7),
            uniform(g, 1.2, 3.0),
            coma=0.4,
            astigmatism=0.3,
            field_curvature=3.0,
        ),
        "decentred": lambda g: _Recipe(
            float(g.choice([1.8, 2.0, 2.8])),
            uniform(g, 0.4, 0.8),
            uniform(g, 1.2, 2.6),
            decentring=uniform(g, 0.2, 0.4),
            uniform_coma=uniform(g, 0.15, 0.3),
        ),
        "tilted": lambda g: _Recipe(
            float(g.choice([1.8, 2.0, 2.8])),
            uniform(g, 0.3, 0.7),
            uniform(g, 1.0, 2.2),
            tilt=uniform(g, 0.4, 0.7),
            uniform_astigmatism=uniform(g, 0.05, 0.15),
        ),
        "nearly-perfect": lambda g: _Recipe(
            float(g.choice([2.8, 3.5, 4.0])), uniform(g, 0.1, 0.25), uniform(g, 0.5, 0.8), tilt=0.1
        ),
        "zoom": lambda g: _Recipe(
            float(g.choice([2.8, 3.5, 4.0])), uniform(g, 0.4, 0.9), uniform(g, 1.2, 3.0), decentring=0.12
        ),
    }


LENS_KINDS: Final = tuple(_recipes())
"""Kinds of lenses that `draw_lens` knows."""


def draw_lens(seed: int, kind: str | None = None) -> SimulatedLens:
    """Draw a copy of a lens.

    Parameters
    ----------
    seed : int
        Not negative; equal seeds and kinds give equal lenses. It also makes the serial number.
    kind : str, optional
        One of `LENS_KINDS`; None takes them in turn by seed.

    Returns
    -------
    SimulatedLens

    Raises
    ------
    UnknownMethodError
        If there is no such kind.

    Notes
    -----
    Blur is set through the ray spot: its root mean square width per axis, over the whole pupil,
    without diffraction and pixel, hits a width drawn for the centre and one for the corner.
    """
    recipes = _recipes()
    kind = LENS_KINDS[seed % len(LENS_KINDS)] if kind is None else kind
    if kind not in recipes:
        raise UnknownMethodError(f"no kind of lens {kind!r}; known: {', '.join(LENS_KINDS)}")
    rng = np.random.default_rng([seed, LENS_KINDS.index(kind)])
    serial = f"SIM{seed:07d}"
    if kind == "zoom":
        short, long = float(rng.choice([18.0, 24.0, 28.0])), float(rng.choice([70.0, 85.0, 105.0]))
        recipe = recipes[kind](rng)
        wide = _optics(recipe, rng)
        tele = _optics(replace(recipe, corner_px=recipe.corner_px * float(rng.uniform(0.6, 1.1))), rng)
        # a shifted element stays where it is when one zooms
        tele = replace(tele, decentring=wide.decentring, tilt=wide.tilt)
        name = f"Simulated Zoom {short:.0f}-{long:.0f}mm f/{recipe.f_number:g}"
        return SimulatedLens((wide, tele), (short, long), model=name, serial=serial)
    focal = float(rng.choice([24.0, 35.0, 50.0, 85.0]))
    recipe = recipes[kind](rng)
    name = f"Simulated {kind.title()} {focal:.0f}mm f/{recipe.f_number:g}"
    return SimulatedLens((_optics(recipe, rng),), (focal,), model=name, serial=serial)


def _optics(recipe: _Recipe, rng: np.random.Generator) -> Aberrations:
    sign = rng.choice([-1.0, 1.0], size=4)
    part = rng.uniform(0.5, 1.0, size=4) * sign
    spherical, coma, astigmatism, curvature = (
        recipe.spherical * part[0],
        recipe.coma * part[1],
        recipe.astigmatism * part[2],
        recipe.field_curvature * part[3],
    )
    angle = rng.uniform(0.0, 2.0 * math.pi, size=4)

    def vector(k: int, length: float) -> tuple[float, float]:
        return length * math.cos(angle[k]), length * math.sin(angle[k])

    center = Aberrations(f_number=recipe.f_number, spherical=spherical, defocus=-1.1 * spherical)
    center = _scaled(center, recipe.center_px / _spot_px(center, 0.0))
    outer = Aberrations(
        f_number=recipe.f_number,
        coma=coma,
        astigmatism=astigmatism,
        field_curvature=curvature - astigmatism / 2.0,  # the flat compromise between the two foci
    )
    outer = _scaled(outer, recipe.corner_px / _spot_px(outer, 1.0))
    blur = _waves(recipe.corner_px, recipe.f_number)
    side = rng.choice([-1.0, 1.0])
    colour = float(rng.uniform(0.1, 0.4)) * blur
    return replace(
        outer,
        spherical=center.spherical,
        defocus=center.defocus,
        decentring=vector(0, recipe.decentring * float(rng.uniform(0.7, 1.3))),
        uniform_coma=vector(1, recipe.uniform_coma * blur),
        uniform_astigmatism=vector(2, recipe.uniform_astigmatism * blur),
        tilt=vector(3, recipe.tilt * blur),
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
