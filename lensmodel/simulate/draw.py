"""Lenses drawn at random: copies of different kinds, of realistic blur, by seed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final, TypeAlias

import numpy as np

from lensmodel.core.errors import UnknownMethodError
from lensmodel.simulate.lens import DEFAULT_PITCH_UM, REFERENCE_UM, Aberrations, Pupil, SimulatedLens

_Range: TypeAlias = tuple[float, float]

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

# Of each kind: its f-numbers, and the r.m.s. widths of the ray spot at the centre and at r = 1 (mean
# over phi) in pixels of 4.5 um, from and to.
_BLUR: Final[Mapping[str, tuple[Sequence[float], _Range, _Range]]] = {
    "soft-fast": ((1.4, 1.6, 1.8), (0.9, 1.4), (2.2, 4.2)),
    "coma": ((1.8, 2.0, 2.4), (0.3, 0.7), (1.3, 3.0)),
    "astigmatism": ((2.0, 2.4, 2.8), (0.3, 0.7), (1.2, 3.0)),
    "field-curvature": ((1.8, 2.0, 2.8), (0.3, 0.7), (1.2, 3.0)),
    "decentred": ((1.8, 2.0, 2.8), (0.4, 0.8), (1.2, 2.6)),
    "tilted": ((1.8, 2.0, 2.8), (0.3, 0.7), (1.0, 2.2)),
    "nearly-perfect": ((2.8, 3.5, 4.0), (0.1, 0.25), (0.5, 0.8)),
    "zoom": ((2.8, 3.5, 4.0), (0.4, 0.9), (1.2, 3.0)),
}
# And what is not as usual: a number, or from and to.
_UNUSUAL: Final[Mapping[str, Mapping[str, float | _Range]]] = {
    "soft-fast": {"coma": 1.5},
    "coma": {"coma": 3.0, "astigmatism": 0.4, "field_curvature": 0.3},
    "astigmatism": {"coma": 0.4, "astigmatism": 3.0, "field_curvature": 0.2},
    "field-curvature": {"coma": 0.4, "astigmatism": 0.3, "field_curvature": 3.0},
    "decentred": {"decentring": (0.2, 0.4), "uniform_coma": (0.15, 0.3)},
    "tilted": {"tilt": (0.4, 0.7), "uniform_astigmatism": (0.05, 0.15)},
    "nearly-perfect": {"tilt": 0.1},
    "zoom": {"decentring": 0.12},
}
_PRIME_MM: Final = (24.0, 35.0, 50.0, 85.0)
_ZOOM_MM: Final = ((18.0, 24.0, 28.0), (70.0, 85.0, 105.0))

LENS_KINDS: Final = tuple(_BLUR)  # kinds of lenses that `draw_lens` knows


def draw_lens(seed: int, kind: str | None = None) -> SimulatedLens:
    """Draw a copy of a lens.

    Notes
    -----
    Blur is set through the ray spot: its root mean square width per axis, over the whole pupil,
    without diffraction and pixel, hits a width drawn for the centre and one for the corner.
    """
    kind = LENS_KINDS[seed % len(LENS_KINDS)] if kind is None else kind
    if kind not in _BLUR:
        raise UnknownMethodError(f"no kind of lens {kind!r}; known: {', '.join(LENS_KINDS)}")
    rng = np.random.default_rng([seed, LENS_KINDS.index(kind)])
    f_numbers, *widths = _BLUR[kind]
    choices = _ZOOM_MM if kind == "zoom" else (_PRIME_MM,)
    focals = tuple(float(rng.choice(several)) for several in choices)
    f_number = float(rng.choice(f_numbers))
    center, corner = (float(rng.uniform(*ends)) for ends in widths)
    drawn = {
        name: float(rng.uniform(*value)) if isinstance(value, tuple) else value
        for name, value in _UNUSUAL[kind].items()
    }
    proportions = {**_USUAL, **drawn}
    optics = [_optics(proportions, f_number, center, corner, rng)]
    if kind == "zoom":
        corner *= float(rng.uniform(0.6, 1.1))
        tele = _optics(proportions, f_number, center, corner, rng)
        # a shifted element stays where it is when one zooms
        optics.append(replace(tele, decentring=optics[0].decentring, tilt=optics[0].tilt))
    name = f"Simulated {kind.title()} {'-'.join(f'{mm:.0f}' for mm in focals)}mm f/{f_number:g}"
    return SimulatedLens(tuple(optics), focals, model=name, serial=f"SIM{seed:07d}")


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

    def vector(k: int, length: float) -> tuple[float, float]:
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
