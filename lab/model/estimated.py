"""Samples as a user gets them: photographs behind a simulated lens, their patches estimated blindly."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lensmodel import photo
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import LensSettings
from lensmodel.simulate import SimulatedCamera, SimulatedLens, load_scene, photograph, write_photo
from lensmodel.workflow import pipeline
from lensmodel.workflow.ways import WAYS

_MARGIN = 56  # pixels of the scene beyond the frame, which a wide kernel brings into it


def estimated_samples(
    lens: SimulatedLens, files: Sequence[Path], seed: int, *, count: int = WAYS["default"].patches
) -> list[PsfSample]:
    """Green samples of photographs taken wide open.

    Parameters
    ----------
    lens : SimulatedLens
    files : sequence of Path
        Sharp photographs, each seen once: "photo0", "photo1", ...
    seed : int
        Of the noise.
    count : int
        Patches that are looked for in each.

    Notes
    -----
    Cost: some seconds of CPU for each photograph.
    """
    settings = LensSettings(aperture=lens.at_focal().f_number, focal_mm=lens.focal_mm[0])
    found: list[PsfSample] = []
    with tempfile.TemporaryDirectory(prefix="lensmodel-") as folder:
        for number, file in enumerate(files):
            scene = load_scene(file)
            height, width = ((n - _MARGIN) // 2 * 2 for n in scene.shape[1:])
            scene = scene[:, : height + _MARGIN, : width + _MARGIN]
            camera = SimulatedCamera(height=height, width=width)
            path, rng = Path(folder) / f"{number}.dng", np.random.default_rng([seed, number])
            write_photo(path, photograph(scene, lens, settings, camera, rng))
            developed = photo.develop(path)
            for group in pipeline.patches_by_cell(pipeline.find_patches(developed, count=count)):
                try:
                    estimates = pipeline.estimate_cell(
                        developed, group, settings=settings, photo_id=f"photo{number}"
                    )
                except NotEnoughEvidenceError:
                    continue
                found += [estimate.sample for estimate in estimates if estimate.channel == "g"]
    return found
