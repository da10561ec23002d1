"""Compile the inner loops, lest each task do it again: `python -m app.jobs.warming NICENESS`.

It reads no photo but its own, and so may write where Numba keeps compiled code (`NUMBA_CACHE_DIR`); tasks may
only read there.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image
from scipy import ndimage

from app.sandbox import confine
from app.sandbox.child import give_way
from lensmodel import api, photo
from lensmodel.blind import sampling
from lensmodel.core.errors import LensModelError
from lensmodel.core.types import LensSettings
from lensmodel.model import LensModel
from lensmodel.photo.values import PhotoMetadata
from lensmodel.photo.writing import write_bayer_dng

SIDE: Final = 384  # of the made-up photo in pixels (chosen): patches fit in, and it takes seconds
METHODS: Final = ("fast", "standard", "paper")
SETTINGS: Final = LensSettings(aperture=2.8, focal_mm=35.0)


def warm(folder: Path) -> None:
    """Develop, learn from and correct a made-up photo, as RAW and as JPEG."""
    rng = np.random.default_rng(0)
    blocks = np.kron(rng.random((SIDE // 8, SIDE // 8)), np.ones((8, 8)))
    light = 0.8 * ndimage.gaussian_filter(blocks, 1.0) + rng.normal(0.1, 0.004, blocks.shape)
    raw, jpeg = folder / "warm.dng", folder / "warm.jpg"
    metadata = PhotoMetadata(aperture=SETTINGS.aperture, focal_mm=SETTINGS.focal_mm)
    mosaic = (512.0 + 15000.0 * light.clip(0.0, 1.0)).astype(np.uint16)
    write_bayer_dng(raw, mosaic, black=512, white=15512, metadata=metadata)
    Image.fromarray(np.uint8(255.0 * light.clip(0.0, 1.0))).convert("RGB").save(jpeg, quality=90)
    for path in (raw, jpeg):
        with contextlib.suppress(LensModelError):  # what cannot be done is compiled when it is needed
            _learn_and_correct(photo.develop(path))


def _learn_and_correct(developed: photo.LinearPhoto) -> None:
    selection = sampling.find_patches(developed, count=8)
    estimated = sampling.estimate_cell(developed, selection.patches, settings=SETTINGS, photo_id="warm")
    measured = [replace(sample, encoded=None) for sample in estimated]  # kernels alone
    lateral = api.lateral_of(developed)
    for samples in (estimated, measured):
        model = LensModel.fit(samples)
        model.expected_errors()
        for method in METHODS:
            part = (0, 0, SIDE, SIDE)
            api.correct_photo(developed, model, SETTINGS, method=method, lateral=lateral, roi=part)


if __name__ == "__main__":
    confine.end_with_parent()
    give_way(int(sys.argv[1]))
    with tempfile.TemporaryDirectory() as scratch:
        warm(Path(scratch))
