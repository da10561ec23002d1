"""The non-blind row of Table 1: the lens measured with a printed target, by a photo like the others.

The target stands before the simulated camera a little turned, aslant and unevenly lit, and is photographed
through the lens into the same kind of file; then it is measured as a user's would be. The simulator's truth
takes no part.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from lab.measured import scenes
from lab.reproduce.cases import Case
from lensmodel.core.psf import PsfField
from lensmodel.core.types import StepHook, ignore_step
from lensmodel.estimation import measure
from lensmodel.estimation.measure.target import Target
from lensmodel.model import LensModel
from lensmodel.photo import develop
from lensmodel.simulate import photograph, write_photo

SIZE: Final = 31
"""Side of the kernels, that of the blind estimates."""

_FILL: Final = 0.97  # share of the frame that the target fills (chosen: corners count too)
_EXPOSURE: Final = 0.8  # factor on the light (chosen: white does not clip)
_SEED: Final = 77  # of the noise, beside that of the case (chosen)


def page_of(case: Case) -> measure.TargetPage:
    """Return the page whose samples are as many as the pixels that it takes."""
    return measure.TargetPage(round(_FILL * case.height * 2**0.5))


def photograph_target(case: Case, path: Path) -> None:
    """Take the photo of the target as a DNG file."""
    scene = scenes.target_scene(page_of(case), (case.height, case.width), scenes.Setup(fill=_FILL))
    rng = np.random.default_rng([case.seed, _SEED])
    photo = photograph(scene, case.lens, case.settings, case.camera, rng, exposure=_EXPOSURE)
    write_photo(path, photo)


def measured_field(case: Case, path: Path, *, on_step: StepHook = ignore_step) -> PsfField:
    """Measure the lens on the photo of the target, and return the model of what was found.

    Raises
    ------
    NotEnoughEvidenceError
        If the target cannot be found or measured.
    """
    photo = develop(path)
    method = Target(details=(page_of(case).detail,))
    found = method.measure([photo], size=SIZE, on_step=on_step)
    samples = measure.samples_of(found, method, photo, photo_id="target", settings=case.settings)
    model = LensModel.fit(samples)
    return model.field(case.settings, pitch_um=case.camera.pitch_um)
