"""Published lens designs as numbers that a ray trace needs: surfaces, glasses, aperture, field.

`prescriptions.json` holds one design a line. Radii, thicknesses and aspheric terms are those of the patent or
book that its `source` names, in its own unit; a zoom lens stands there once a focal length. A glass is (n_d,
V_d, P_gF). Patents publish the first two; the third is that of the catalogue glass with this n_d and V_d, and
where there is none `partial_dispersion` tells it from the two. Designs that were not within two percent of
their published focal length, or did not form an image, were left out; tests hold both for all of them.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError

Array = NDArray[np.float64]

D_UM: Final = 0.58756  # wavelength of n_d, helium

_F_UM, _C_UM, _G_UM = 0.48613, 0.65627, 0.43584

LOOKED_AT: Final = frozenset({"heliar", "reverse-telephoto", "tronnier", "retrofocus"})  # in development

_UNSEEN: Final = frozenset({"telephoto", "field-corrector", "aspheric", "noct"})
"""Designs that are held out, whatever theirs."""


@dataclass(frozen=True, eq=False)
class Prescription:
    """A design in millimetres or in a unit of its own."""

    name: str
    source: str  # patent or book, and which of its examples
    focal: float  # published focal length
    f_number: float  # published
    half_field_deg: float  # published half angle of view
    curvature: Array  # (s,), of the surfaces from the first glass on; `thickness` lies behind the surface
    thickness: Array
    conic: Array
    asphere: Array  # (s, k), coefficients of h^4, h^6, ... that are added to the sag.
    glass: Array  # (s, 3), n_d, V_d and P_gF of the medium behind; air has n_d = 1
    stop: int  # surface that is the aperture stop

    @property
    def family(self) -> str:
        """Patent or book page: its examples and focal lengths are held out together."""
        return re.split(r"[-@]", self.name)[0] if self.name[-1].isdigit() else self.name

    def index(self, wavelengths_um: Array) -> Array:
        """Refractive index of the medium behind each surface, `(s, w)`."""
        return refractive_index(self.glass, wavelengths_um)

    def elements(self) -> list[tuple[int, ...]]:
        """Surfaces of each single or cemented element, front to back."""
        groups: list[tuple[int, ...]] = []
        current: list[int] = []
        for i, (n, _, _) in enumerate(self.glass):
            if current or n > 1.0:
                current.append(i)
            if current and n == 1.0:
                groups.append(tuple(current))
                current = []
        return groups


def partial_dispersion(n_d: float, v_d: float) -> float:
    """P_gF = (n_g - n_F) / (n_F - n_C) of a glass of which only n_d and V_d are known, to 0.003 r.m.s.

    Normal line through K7 and F2 (Schott, TIE-29, eq. 1.2-6), and what catalogue glasses lie beside it.
    """
    normal = 0.6438 - 0.001682 * v_d
    if v_d > 75.0:
        return 0.5375 - 0.0003 * (v_d - 81.5)
    dense = 9.4e-5 * max(38.0 - v_d, 0.0) ** 2
    lanthanum = -0.0075 * float(
        np.clip((n_d - 1.64) / 0.06, 0.0, 1.0) * np.clip((v_d - 33.0) / 12.0, 0.0, 1.0)
    )
    fluoride = 0.0145 * float(np.clip((v_d - 64.0) / 3.0, 0.0, 1.0)) if n_d > 1.54 else 0.0
    return normal + dense + lanthanum + fluoride


def refractive_index(glass: Array, wavelengths_um: Array) -> Array:
    """Index of glasses `(..., 3)` at wavelengths `(w,)`: `(..., w)`, to 2e-5 r.m.s. between .45 and .63 um.

    n_d + a w + b w^2 in H. A. Buchdahl's coordinate w = l / (1 + 2.5 l), l counted from the d line (P. N.
    Robb and R. I. Mercado, Applied Optics 22, 1983), where a and b make n_F - n_C and n_g - n_F exact.
    """
    n_d, v_d, p_gf = np.moveaxis(np.asarray(glass, dtype=np.float64), -1, 0)
    spread = np.where(n_d > 1.0, (n_d - 1.0) / v_d, 0.0)
    f, c, g = _chromatic(np.array([_F_UM, _C_UM, _G_UM]))
    rows = np.array([[f - c, f * f - c * c], [g - f, g * g - f * f]])
    a, b = np.linalg.solve(rows, np.stack([spread, spread * p_gf]).reshape(2, -1)).reshape(2, *n_d.shape)
    w = _chromatic(np.asarray(wavelengths_um, dtype=np.float64))
    return np.asarray(n_d[..., None] + a[..., None] * w + b[..., None] * w * w)


def _chromatic(wavelengths_um: Array) -> Array:
    return (wavelengths_um - D_UM) / (1.0 + 2.5 * (wavelengths_um - D_UM))


def _parsed(row: dict[str, Any]) -> Prescription:
    """One line of the file: surfaces are (radius or null, thickness, glass, conic and aspheric terms)."""
    surfaces = row["surfaces"]
    terms = max([len(s[4]) for s in surfaces if len(s) > 4], default=0)
    asphere = np.zeros((len(surfaces), terms))
    glass = np.zeros((len(surfaces), 3))
    for i, s in enumerate(surfaces):
        if len(s) > 4:
            asphere[i, : len(s[4])] = s[4]
        glass[i] = _glass(tuple(s[2]) if s[2] else None)
    curvature = np.array([1.0 / s[0] if s[0] else 0.0 for s in surfaces])
    thickness = np.array([float(s[1]) for s in surfaces])
    conic = np.array([float(s[3]) if len(s) > 3 else 0.0 for s in surfaces])
    return Prescription(
        row["name"], row["source"], row["focal"], row["f_number"], row["half_field_deg"],
        curvature, thickness, conic, asphere, glass, int(row["stop"]),
    )  # fmt: skip


def _glass(glass: Any) -> tuple[float, float, float]:  # noqa: ANN401 - a tuple of two or three, or a name
    if glass is None:
        return (1.0, 1.0, 0.0)
    if len(glass) == 2 and not isinstance(glass[0], str):
        return (float(glass[0]), float(glass[1]), partial_dispersion(float(glass[0]), float(glass[1])))
    if len(glass) == 3:
        return (float(glass[0]), float(glass[1]), float(glass[2]))
    raise InvalidInputError(f"a glass is (n_d, V_d) or (n_d, V_d, P_gF), got {glass}")


def _read() -> dict[str, Prescription]:
    lines = files(__package__).joinpath("prescriptions.json").read_text(encoding="utf-8").splitlines()
    read = [_parsed(json.loads(line)) for line in lines]
    return {one.name: one for one in sorted(read, key=lambda one: one.name)}


def _held_out() -> frozenset[str]:
    families = sorted({one.family for one in PRESCRIPTIONS.values()} - LOOKED_AT - _UNSEEN)
    unseen = _UNSEEN | set(families[1::2])
    return frozenset(name for name, one in PRESCRIPTIONS.items() if one.family in unseen)


PRESCRIPTIONS: Final = _read()  # all designs by name, in sorted order

HELD_OUT: Final = _held_out()
"""Names of the designs that nothing may be trained on: every other patent or book page in sorted order."""
