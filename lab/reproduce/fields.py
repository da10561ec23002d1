"""PSF fields to compare with: a general profile of the lens model, and the lens measured with a target."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Final

import numpy as np

from lab import targets
from lab.reproduce.cases import Case
from lab.traced import wide_open
from lensmodel import measured
from lensmodel.core.psf import PsfField, as_kernel
from lensmodel.core.types import Channel, FieldPosition, Kernel
from lensmodel.measured.target import Target
from lensmodel.model import LensModel, ModelField
from lensmodel.photo import develop
from lensmodel.simulate import LENS_KINDS, draw_lens, photograph, write_photo

SIZE: Final = 31  # side of the kernels that are measured, that of the blind estimates
COPIES: Final = 6  # lenses that a profile is the mean of (chosen: a maker measures a few)

# Of the photo of the target (chosen): share of the frame, factor on the light, seed beside that of the case.
_FILL: Final = 0.97
_EXPOSURE: Final = 0.8
_SEED: Final = 77


@dataclass(frozen=True, slots=True, eq=False)
class MeanField:
    """Mean of PSF fields, pixel by pixel, each in some views: turned by k quarters, and mirrored.

    With R the turn of a kernel by 90 degrees towards growing phi, and M the mirror image upside down, the
    views of f are R^-k f(r, phi + 90 k) and M R^-k f(r, -phi + 90 k).
    """

    fields: Sequence[PsfField]
    views: Sequence[tuple[int, bool]] = ((0, False),)

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the mean kernel of a place; see `PsfField`."""
        kernels = []
        for field, (turns, mirrored) in product(self.fields, self.views):
            phi = -position.phi if mirrored else position.phi
            place = FieldPosition(position.r, phi + turns * math.pi / 2.0)
            upright = np.rot90(field.kernel_at(place, channel, size), -turns)
            kernels.append(upright[::-1] if mirrored else upright)
        return as_kernel(np.mean(kernels, axis=0))


def symmetric(field: PsfField) -> MeanField:
    """A PSF field without what makes a copy uneven: its mean over quarter turns and their mirror images."""
    return MeanField([field], list(product(range(4), (False, True))))


def general_words(case: Case) -> str:
    """Say what the general profile of a case is made of."""
    return f"mean of {COPIES} lenses of its kind" if case.grid is None else "the lens itself made symmetric"


def general_field(case: Case) -> PsfField:
    """What a maker of software has who measured other copies, see `general_words`."""
    if case.grid is not None:
        return symmetric(case.truth())
    seeds = range(case.seed % len(LENS_KINDS), COPIES * len(LENS_KINDS), len(LENS_KINDS))
    return MeanField([lens.field(wide_open(lens)) for lens in map(draw_lens, seeds)])


def measured_field(case: Case, path: Path) -> PsfField:
    """Photograph the printed target through the lens, measure it, and return the model of what was found."""
    page = measured.TargetPage(round(_FILL * case.height * 2**0.5))  # as many samples as it takes pixels
    scene = targets.target_scene(page, (case.height, case.width), targets.Setup(fill=_FILL))
    rng = np.random.default_rng([case.seed, _SEED])
    write_photo(path, photograph(scene, case.lens, case.settings, case.camera, rng, exposure=_EXPOSURE))
    photo, method = develop(path), Target(details=(page.detail,))
    samples = method.measure([photo], size=SIZE, settings=case.settings, photo_id="target")
    return ModelField(LensModel.fit(samples), case.settings, case.camera.pitch_um)
