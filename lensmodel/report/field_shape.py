"""Astigmatism and curvature of the field, as widths of points along the radius and around the centre."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from lensmodel.core.psf import second_moments
from lensmodel.core.types import FieldPosition, Kernel

_EVEN_PX: Final = 0.1  # widths along u and v that differ by less count as alike: nobody sees it (chosen)

Ring: TypeAlias = list[tuple[FieldPosition, Kernel]]
"""Kernels at places of one radius."""


@dataclass(frozen=True, slots=True)
class FieldShape:
    """How blur along u and along v part over the radius, the mark of astigmatism and curved fields.

    Parameters
    ----------
    along_u, along_v : tuple of float
        Root mean square widths in pixels, one for each radius of the report, mean over angles.
    difference : tuple of float
        along_u - along_v: positive where points are drawn out radially.
    text : str
        The same as one sentence.

    Notes
    -----
    Two foci that part with the field (Welford, "Aberrations of Optical Systems", 1986, sec. 8.3) show
    as widths that part. How far each focal surface lies from the sensor cannot be told from photos
    of one focus; a curved but stigmatic field shows as both widths growing alike.
    """

    along_u: tuple[float, ...]
    along_v: tuple[float, ...]
    difference: tuple[float, ...]
    text: str


def field_shape(radii: Sequence[float], rings: Sequence[Ring]) -> FieldShape:
    """Measure how blur along u and along v part over the radius.

    Parameters
    ----------
    radii : sequence of float
        Half-diagonals.
    rings : sequence of Ring
        Kernels at places of each radius; a single place is the centre.
    """
    along_u, along_v = [], []
    for places in rings:
        squared = np.mean([np.square(widths_along(k, p.phi)) for p, k in places], axis=0)
        if len(places) == 1:
            squared[:] = squared.mean()  # u has no direction at the centre
        along_u.append(float(math.sqrt(squared[0])))
        along_v.append(float(math.sqrt(squared[1])))
    apart = tuple(u - v for u, v in zip(along_u, along_v, strict=True))
    largest = max(range(len(apart)), key=lambda i: abs(apart[i]))
    center, corner = along_u[0] + along_v[0], along_u[-1] + along_v[-1]
    if center < _EVEN_PX:  # a point within one pixel has no width to compare with
        growth = f"in the centre a point stays within a pixel, in the corners it is {corner / 2:.1f} px wide"
    else:
        way = "grows" if corner >= center else "shrinks"
        growth = f"towards the corners the blur {way} to {corner / center:.1f} times its width at the centre"
    if abs(apart[largest]) < _EVEN_PX:
        text = f"points stay round across the field; {growth}"
    else:
        along = "radially" if apart[largest] > 0 else "around the centre"
        text = (
            f"points are drawn out {along}, most at r = {radii[largest]:.2f} by "
            f"{abs(apart[largest]):.2f} px; {growth}"
        )
    return FieldShape(tuple(along_u), tuple(along_v), apart, text)


def widths_along(kernel: Kernel, phi: float) -> tuple[float, float]:
    """Root mean square widths along u and along v of a kernel at field angle `phi`, pixels.

    The variance along a unit vector a is a' M a, with M the second moments and u = (-sin, cos) as
    (row, col).
    """
    moments = second_moments(kernel)
    u = np.array([-math.sin(phi), math.cos(phi)])
    v = np.array([-math.cos(phi), -math.sin(phi)])
    return math.sqrt(max(float(u @ moments @ u), 0.0)), math.sqrt(max(float(v @ moments @ v), 0.0))
