"""A lens design as a table of surfaces, and as a system that `optiland` traces."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

from lensmodel.core.errors import InvalidInputError

Optic: TypeAlias = Any
"""An `optiland.optic.Optic`: the tracer is an extra, and its types are not ours."""

Glass: TypeAlias = str | tuple[str, str] | tuple[float, float] | None
"""A catalogue name, a name and its maker, (n_d, V_d), or None for air."""


@dataclass(frozen=True, slots=True)
class Surface:
    """One surface and the medium behind it; lengths in the design's own unit."""

    radius: float  # of curvature; positive where the centre lies behind the surface, infinite for a plane
    thickness: float  # axial distance to the next surface
    glass: Glass = None  # medium behind the surface
    conic: float = 0.0  # conic constant: -1 is a parabola
    asphere: tuple[float, ...] = ()  # Coefficients of h^4, h^6, h^8, ... added to the sag.
    stop: bool = False  # whether this surface is the aperture stop

    def scaled(self, factor: float) -> Surface:
        """Return the same surface `factor` times as large."""
        terms = tuple(a * factor ** (1 - (4 + 2 * i)) for i, a in enumerate(self.asphere))
        return replace(self, radius=self.radius * factor, thickness=self.thickness * factor, asphere=terms)


@dataclass(frozen=True, slots=True)
class Design:
    """A published design, or one made of a published design."""

    name: str  # short, lower case
    source: str  # where the numbers come from
    # from the first glass to the last; the last thickness is the distance to the image
    surfaces: tuple[Surface, ...]
    f_number: float  # the design's own
    half_field_deg: float  # largest angle of an object point from the axis that the design is good for

    def __post_init__(self) -> None:
        if sum(surface.stop for surface in self.surfaces) != 1:
            raise InvalidInputError(f"design {self.name} needs exactly one stop")
        if not (0.5 <= self.f_number <= 32.0 and 0.0 < self.half_field_deg < 85.0):
            raise InvalidInputError(f"design {self.name}: aperture or field is out of range")

    @property
    def stop(self) -> int:
        """Index of the stop."""
        return next(i for i, surface in enumerate(self.surfaces) if surface.stop)

    def scaled(self, factor: float) -> Design:
        """Return the same design `factor` times as large."""
        return replace(self, surfaces=tuple(surface.scaled(factor) for surface in self.surfaces))

    def elements(self) -> list[tuple[int, ...]]:
        """Surfaces that lie in one piece of glass or cemented group, front to back."""
        groups: list[tuple[int, ...]] = []
        current: list[int] = []
        for i, surface in enumerate(self.surfaces):
            if current or surface.glass is not None:
                current.append(i)
            if current and surface.glass is None:
                groups.append(tuple(current))
                current = []
        return groups


def optic_of(design: Design) -> Optic:
    """Build the system; surface `i` of the design is surface `i + 1` of the system."""
    from optiland.optic import Optic as System

    system = System()
    system.surfaces.add(index=0, radius=math.inf, thickness=math.inf)
    for i, surface in enumerate(design.surfaces, start=1):
        common = {
            "index": i,
            "radius": surface.radius,
            "thickness": surface.thickness,
            "conic": surface.conic,
            "material": _material(surface.glass),
            "is_stop": surface.stop,
        }
        if surface.asphere:
            # its first coefficient is that of h^2
            system.surfaces.add(surface_type="even_asphere", coefficients=[0.0, *surface.asphere], **common)
        else:
            system.surfaces.add(**common)
    system.surfaces.add(index=len(design.surfaces) + 1)
    system.set_aperture(aperture_type="imageFNO", value=design.f_number)
    system.fields.set_type(field_type="angle")
    system.fields.add(y=0)
    system.wavelengths.add(value=0.54, is_primary=True)
    return system


def surfaces_of(system: Optic, glasses: tuple[Glass, ...]) -> tuple[Surface, ...]:
    """Read the surfaces of a system of spheres and conics, object and image left out.

    Parameters
    ----------
    system : Optic
    glasses : tuple of Glass
        Medium behind each surface: a system holds materials, not their names.
    """
    group = system.surfaces
    return tuple(
        Surface(
            radius=float(group[i].geometry.radius),
            thickness=float(group.get_thickness(i)[0]),
            glass=glass,
            conic=float(getattr(group[i].geometry, "k", 0.0)),
            stop=bool(group[i].is_stop),
        )
        for i, glass in enumerate(glasses, start=1)
    )


def _material(glass: Glass) -> object:
    if glass is None:
        return "air"
    if isinstance(glass, tuple) and not isinstance(glass[0], str):
        from optiland.materials import AbbeMaterial

        return AbbeMaterial(n=glass[0], abbe=glass[1], model="buchdahl")
    return glass
