"""Step 3: a photo without the blur of its lens."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from lensmodel import correction
from lensmodel.core.errors import NotEnoughEvidenceError, NoUsablePatchesError, OutsideSupportError
from lensmodel.core.geometry import Frame
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import Channel, FieldPosition, LensSettings, StepHook, ignore_step
from lensmodel.model import LensModel, ModelField
from lensmodel.model.answer import PAPER
from lensmodel.model.camera_bodies import ALIKE, circle_mm
from lensmodel.photo import LinearPhoto
from lensmodel.photo.lateral import LateralColour, estimate_lateral, resample
from lensmodel.photo.values import remarks_log
from lensmodel.workflow.sampling import estimate_cell, find_patches, preset_of

log = logging.getLogger(__name__)

SEEN_DB: Final = 0.3
"""Expected gain below which a photo is left (chosen): at 0.2 dB nobody saw a difference at 3:1."""


def lateral_of(developed: LinearPhoto) -> LateralColour:
    """Estimate the lateral colour of a photo from its own edges."""
    return estimate_lateral(developed.planes, developed.frame, clip=developed.clip)


def correct_photo(
    developed: LinearPhoto,
    model: LensModel,
    settings: LensSettings,
    *,
    method: str | correction.Deconvolver | None = None,
    strength: float = 1.0,
    bounds: correction.Bounds | None = None,
    layers: Sequence[correction.Bounds] = (),
    lateral: LateralColour | None = None,
    roi: tuple[int, int, int, int] | None = None,
    photo: str = "",
    known: ModelField | None = None,
    least_gain_db: float | None = None,
    workers: int = 1,
    on_step: StepHook = ignore_step,
) -> correction.Corrected:
    """Remove the blur of the lens from a developed photo.

    The less sure a PSF is, by the error that the model expects, the gentler the correction. A lens that was
    learned the paper's way is corrected the paper's way: its PSFs are taken as right, and Richardson-Lucy
    deconvolution is all that is done.
    """
    whole, developed = developed.frame, placed(developed, model)
    if lateral is not None and developed.frame != whole:
        lateral = lateral.counted_in(developed.frame.half_diagonal)
    wanted, unguarded = _method_of(model, method)
    field = known or psfs_for(developed, model, settings, method=method, photo=photo)
    planes, cfa = developed.planes, developed.cfa
    solver = correction.deconvolvers.resolve(wanted)
    if isinstance(solver, correction.WarpableMethod) and solver.warped and lateral is not None:
        planes, lateral, cfa = resample(planes, developed.frame, lateral), None, None
    return correction.correct_planes(
        planes,
        field if unguarded else _Posteriors(field, (1, 3) if developed.info.turns is None else (0,)),
        developed.frame,
        method=solver,
        strength=strength,
        noise=developed.correction_noise,
        clip=developed.clip,
        lateral=lateral,
        cfa=cfa,
        bounds=bounds,
        layers=layers,
        unguarded=unguarded,
        least_gain_db=least_gain_db,
        stored=correction.StoredColour.of_photo(developed),
        processed=developed.lossy,
        roi=roi,
        workers=workers,
        on_step=on_step,
    )


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Posteriors:
    """What a model knows of the PSFs of a lens, as the correction needs it."""

    field: ModelField
    turns: Sequence[int] = (0,)  # quarter turns that may lead from the photo to its sensor, equally likely

    def posterior_at(self, position: FieldPosition, channel: Channel) -> correction.PsfPosterior:
        kernels, errors = [], []
        for turn in self.turns:
            place = FieldPosition(position.r, position.phi + turn * math.pi / 2.0)
            answer = self.field.answer_at(place, channel, correction.KERNEL_SIZE)
            kernels.append(np.rot90(answer.kernel, -turn))
            errors.append(answer.predicted_error)
        kernel = np.mean(kernels, axis=0)
        apart = max(np.linalg.norm(each - kernel) for each in kernels) / np.linalg.norm(kernel)
        error = math.hypot(max(errors), apart)
        return correction.PsfPosterior.of_error(correction.crop_to_support(kernel), error)


def _method_of(
    model: LensModel, method: str | correction.Deconvolver | None
) -> tuple[str | correction.Deconvolver, bool]:
    """Which method is wanted, and whether all is done the paper's way and nothing else."""
    wanted = preset_of(model).method if method is None else method
    return wanted, model.mode == PAPER and wanted == PAPER


def psfs_for(
    developed: LinearPhoto,
    model: LensModel,
    settings: LensSettings,
    *,
    method: str | correction.Deconvolver | None = None,
    photo: str = "",
) -> ModelField:
    """Return the PSFs of a lens for the correction of a photo, whose own patches join the samples.

    Only the way of the paper, and lenses of measured kernels alone, take no patches of the photo.
    """
    developed = placed(developed, model)
    _, unguarded = _method_of(model, method)
    if not unguarded and model.weights:
        model = model.added(_own_samples(developed, model, settings, photo))
    return model.field(settings, pitch_um=developed.info.metadata.pixel_pitch_um)


def _own_samples(
    developed: LinearPhoto, model: LensModel, settings: LensSettings, photo: str
) -> list[PsfSample]:
    """Samples of a photo, unless the model has them already or the photo shows too little."""
    if photo and any(sample.photo == photo and sample.encoded is not None for sample in model.samples):
        return []
    preset = preset_of(model)
    try:
        chosen = find_patches(developed, count=preset.patches, estimator=preset.estimator).patches
        made = estimate_cell(
            developed,
            chosen,
            settings=settings,
            photo_id=photo,
            estimator=preset.estimator,
            size=preset.kernel_size,
        )
    except (NoUsablePatchesError, NotEnoughEvidenceError) as error:
        log.info("the photo adds nothing to what is known of its lens: %s", error)
        return []
    return [one.sample for one in made]


def placed(developed: LinearPhoto, model: LensModel) -> LinearPhoto:
    """Count the places of a photo in the half diagonal of the largest frame that its lens was seen on.

    A frame in crop mode is the middle of the sensor. Where a pixel pitch is unknown, only a photo of a size
    that the lens was seen on can be placed.
    """
    frame, info = developed.frame, developed.info
    pitch, circle = info.metadata.pixel_pitch_um, circle_mm(model.samples)
    if frame.circle_px is not None:
        return developed
    if pitch is None or circle is None:
        _require_known_size(frame, model)
        return developed
    own = frame.half_diagonal * pitch / 1000.0
    sizes = f"{2.0 * own:.1f} mm diagonal, and its lens is known on a frame of {2.0 * circle:.1f} mm"
    if own > (1.0 + ALIKE) * circle:
        raise OutsideSupportError(
            f"it shows a frame of {sizes}: nothing is known of what lies beyond; calibrate the lens with "
            "photos of the larger frame"
        )
    if own > (1.0 - ALIKE) * circle:
        return developed
    if not info.centred:
        raise OutsideSupportError(
            f"it was cut to {sizes}: nobody can tell from which part; correct the whole photo, then cut it"
        )
    remarks_log.info("it is taken for the middle of the frame: it has %s", sizes)
    return dataclasses.replace(developed, frame=dataclasses.replace(frame, circle_px=circle * 1000.0 / pitch))


def _require_known_size(frame: Frame, model: LensModel) -> None:
    """Refuse a photo that may be a crop, or scaled down, where nothing tells."""
    known = sorted({round(2.0 * s.half_diagonal_px) for s in model.samples if s.half_diagonal_px})
    if known and not any(abs(2.0 * frame.half_diagonal / size - 1.0) < ALIKE for size in known):
        raise OutsideSupportError(
            f"its {frame.width} x {frame.height} pixels have a diagonal of {2.0 * frame.half_diagonal:.0f} "
            f"pixels, and its lens is known on {' and '.join(map(str, known))}: nothing tells whether it was "
            "cut or scaled; give the photo as the camera wrote it"
        )
