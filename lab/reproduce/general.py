"""A general profile of a lens model: what a maker of software has who measured other copies, not this one."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from lab.reproduce import families
from lab.reproduce.cases import Case
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfField, as_kernel
from lensmodel.core.types import Channel, FieldPosition, Kernel, LensSettings
from lensmodel.simulate import LENS_KINDS, SimulatedField, draw_lens

_FAULTS: Final = ("faults", "sensor_tilt_um")
"""Facts of a grid that make its copy."""

COPIES: Final = 6
"""Lenses that a profile of a third-order lens is the mean of (chosen: a maker measures a few)."""


@dataclass(frozen=True, slots=True, eq=False)
class MeanField:
    """Mean of several PSF fields: kernels of one place, centred each, averaged pixel by pixel."""

    fields: Sequence[PsfField]

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the mean kernel of a place; see `PsfField`."""
        kernels = [field.kernel_at(position, channel, size) for field in self.fields]
        return as_kernel(np.mean(kernels, axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class SymmetricField:
    """A PSF field without what makes a copy uneven: its mean over quarter turns and their mirror images.

    With R the turn of a kernel by 90 degrees towards growing phi, and M the mirror image upside down::

        g(r, phi) = 1/8 sum_k ( R^-k f(r, phi + 90 k) + M R^-k f(r, -phi + 90 k) ),    k = 0..3
    """

    field: PsfField

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the mean kernel of a place; see `PsfField`."""
        kernels = []
        for turns in range(4):
            for mirrored in (False, True):
                phi = -position.phi if mirrored else position.phi
                place = FieldPosition(position.r, phi + turns * math.pi / 2.0)
                upright = np.rot90(self.field.kernel_at(place, channel, size), -turns)
                kernels.append(upright[::-1] if mirrored else upright)
        return as_kernel(np.mean(kernels, axis=0))


def other_copies(path: Path) -> tuple[Path, ...]:
    """Grids beside a grid that are of the same design, f-number and pitch, with other faults."""
    own = families.traced(path).grids[0]
    found = []
    for other in sorted(path.parent.glob("*.npz")):
        try:
            grid = families.traced(other).grids[0]
        except (InvalidInputError, KeyError):  # some other archive
            continue
        same = all(grid.facts[name] == own.facts[name] for name in ("design", "f_number", "pitch_um"))
        if same and any(grid.facts.get(name) != own.facts.get(name) for name in _FAULTS):
            found.append(other)
    return tuple(found)


def general_key(case: Case) -> str:
    """Ending of the name under which results are stored: of the other copies, empty without any."""
    copies = () if case.grid is None else other_copies(case.grid)
    if not copies:
        return ""
    total = "".join(families.content(path) for path in copies)
    return f"-{hashlib.sha256(total.encode()).hexdigest()[:8]}"


def general_words(case: Case) -> str:
    """Say what the general profile of a case is made of."""
    if case.grid is None:
        return f"mean of {COPIES} lenses of its kind"
    count = len(other_copies(case.grid))
    if not count:
        return "the lens itself made symmetric"
    return f"mean of {count} other copies of the design" if count > 1 else "another copy of the design"


def general_field(case: Case) -> PsfField:
    """Return what is known of the lens of a case without any photo of it.

    Third order: the mean of lenses of the same kind, drawn from development seeds (below 100), as far
    stopped down. Ray-traced: the mean of the other copies of its design at that aperture and pitch whose
    grids lie beside its own; without any, the lens itself made symmetric, which is kinder to the profile.
    """
    if case.grid is not None:
        copies = other_copies(case.grid)
        if copies:
            return MeanField([families.traced(path).field(case.settings) for path in copies])
        return SymmetricField(case.truth())
    kind = case.seed % len(LENS_KINDS)
    lenses = [draw_lens(kind + len(LENS_KINDS) * i) for i in range(COPIES)]
    at_long_end = case.focal_mm > case.lens.focal_mm[0]
    fields = []
    for lens in lenses:
        focal = lens.focal_mm[-1 if at_long_end else 0]
        aperture = lens.widest(focal) * 2.0 ** (case.stops / 2.0)
        settings = LensSettings(aperture=aperture, focal_mm=focal)
        fields.append(SimulatedField(lens, settings, case.camera.pitch_um))
    return MeanField(fields)
