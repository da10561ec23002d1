"""From photos to a lens model, and from a model to corrected photos: the only glue.

    develop -> find_patches -> estimate_cell (many, independent) -> Calibration -> LensModel
    develop -> correct_photo -> write

Each step is a plain function on values, so that a script, the command line and the workers of
the service run the same code. The steps in the middle are independent of each other and may
run in as many processes as there are. Here they are under one name.
"""

from lensmodel.workflow.calibrating import AHEAD, Calibration, InMemory, PhotoVerdict
from lensmodel.workflow.correcting import correct_photo, lateral_of, psfs_for
from lensmodel.workflow.developed import (
    load_developed,
    photo_id,
    require_aperture,
    save_developed,
    settings_of,
)
from lensmodel.workflow.estimating import (
    DEFAULT_KERNEL_SIZE,
    CellSample,
    estimate_cell,
    find_patches,
    patches_by_cell,
    require_spread,
)
from lensmodel.workflow.sampling import (
    CalibrationEvent,
    EventHook,
    PhotoSteps,
    Recipe,
    Stage,
    ignore_event,
    samples_of_bytes,
    samples_of_photo,
    take,
)

__all__ = [
    "AHEAD",
    "DEFAULT_KERNEL_SIZE",
    "Calibration",
    "CalibrationEvent",
    "CellSample",
    "EventHook",
    "InMemory",
    "PhotoSteps",
    "PhotoVerdict",
    "Recipe",
    "Stage",
    "correct_photo",
    "estimate_cell",
    "find_patches",
    "ignore_event",
    "lateral_of",
    "load_developed",
    "patches_by_cell",
    "photo_id",
    "psfs_for",
    "require_aperture",
    "require_spread",
    "samples_of_bytes",
    "samples_of_photo",
    "save_developed",
    "settings_of",
    "take",
]
