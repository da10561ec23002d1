"""The task that compiles the inner loops, lest the first photo of an owner wait for them."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import Image
from scipy import ndimage

from app.sandbox.child import ProgressHook
from lensmodel import photo
from lensmodel.core.errors import LensModelError
from lensmodel.core.types import LensSettings
from lensmodel.model import LensModel, ModelSettings
from lensmodel.photo.dng import write_bayer_dng
from lensmodel.photo.values import PhotoMetadata
from lensmodel.workflow import correcting, sampling

SIDE: Final = 384  # of the made-up photo in pixels (chosen): patches fit in, and it takes seconds
METHODS: Final = ("fast", "standard")  # those that the pages and most programs ask for
SETTINGS: Final = LensSettings(aperture=2.8, focal_mm=35.0)


def warm(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> dict[str, Any]:
    """Develop, learn from and correct a made-up photo, as RAW and as JPEG."""
    del arguments, progress
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
    return {}


def _learn_and_correct(developed: photo.LinearPhoto) -> None:
    selection = sampling.find_patches(developed, count=8)
    results = sampling.estimate_cell(developed, selection.patches, settings=SETTINGS, photo_id="warm")
    model = LensModel.fit([result.sample for result in results], ModelSettings())
    model.expected_errors()
    lateral = correcting.lateral_of(developed)
    for method in METHODS:
        part = (0, 0, SIDE, SIDE)
        correcting.correct_photo(developed, model, SETTINGS, method=method, lateral=lateral, roi=part)
