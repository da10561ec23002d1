"""Step 3: a photo without the blur of its lens."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from typing import Final

from lensmodel import correction, quality
from lensmodel.core.errors import NotEnoughEvidenceError, NoUsablePatchesError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import LensSettings, StepHook, ignore_step
from lensmodel.model import LensModel, ModelField
from lensmodel.model.answer import PAPER
from lensmodel.photo import LinearPhoto
from lensmodel.photo.lateral import LateralColour, estimate_lateral, resample
from lensmodel.workflow.estimating import estimate_cell, find_patches
from lensmodel.workflow.placing import placed
from lensmodel.workflow.ways import way_of

log = logging.getLogger(__name__)

LOSSY_SHARE: Final = 0.7
"""Share of the correction that compressed photos get (chosen). Their camera has sharpened and smoothed
them, so that a change may be in vain. A share s of one that is right gains 1 - (1 - s)^2 of it, nine
tenths; of one that is not, the error falls with s^2, to a half."""


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
    workers: int = 1,
    on_step: StepHook = ignore_step,
) -> correction.Corrected:
    """Remove the blur of the lens from a developed photo.

    The less sure a PSF is, by the error that the model expects, the gentler the correction. A lens that was
    learned the paper's way is corrected the paper's way: its PSFs are taken as right, and Richardson-Lucy
    deconvolution is all that is done.

    Parameters
    ----------
    method : str or Deconvolver, optional
        None takes that of the way the lens was learned (`way_of`).
    strength : float
        0 leaves the photo as it is, 1 applies what the noise allows, or `LOSSY_SHARE` of it if it is lossy.
    bounds : Bounds, optional
        What to allow beside edges and in flat areas.
    layers : sequence of Bounds
        Others to correct it within as well, in little more than the time of one.
    roi : tuple of int, optional
        `(row, col, height, width)` in sensor orientation; only that part is corrected.
    photo : str
        What samples of this photo are called, see `psfs_for`.
    known : ModelField, optional
        What `psfs_for` found for this photo; hand it over where the same photo is corrected several times.

    Returns
    -------
    Corrected
        Of a chart, with what was measured on its edges (`find_edges`) in each zone.
    """
    whole, developed = developed.frame, placed(developed, model)
    if lateral is not None and developed.frame != whole:
        lateral = lateral.counted_in(developed.frame.half_diagonal)
    wanted, plain = _way(model, method)
    field = known or psfs_for(developed, model, settings, method=method, photo=photo)
    planes, cfa = developed.planes, developed.cfa
    if developed.lossy and not plain:
        strength *= LOSSY_SHARE
    solver = correction.deconvolvers.resolve(wanted)
    if isinstance(solver, correction.WarpableMethod) and solver.warped and lateral is not None:
        planes, lateral, cfa = resample(planes, developed.frame, lateral), None, None
    corrected = correction.correct_planes(
        planes,
        field,
        developed.frame,
        method=solver,
        strength=strength,
        noise=developed.correction_noise,
        clip=developed.clip,
        psf_error=None if plain else field.error_at,
        lateral=lateral,
        cfa=cfa,
        bounds=bounds,
        layers=layers,
        plain=plain,
        stored=correction.StoredColour.of_photo(developed),
        roi=roi,
        workers=workers,
        on_step=on_step,
    )
    return _with_measured_gain(corrected, developed, roi)


def _way(
    model: LensModel, method: str | correction.Deconvolver | None
) -> tuple[str | correction.Deconvolver, bool]:
    """Which method is wanted, and whether all is done the paper's way and nothing else."""
    wanted = way_of(model).method if method is None else method
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

    Parameters
    ----------
    photo : str
        What samples of this photo are called: they count once if the lens was learned from it.
    """
    developed = placed(developed, model)
    _, plain = _way(model, method)
    if not plain and model.weights:
        model = model.added(_own_samples(developed, model, settings, photo))
    return model.field(settings, pitch_um=developed.info.metadata.pixel_pitch_um)


def _own_samples(
    developed: LinearPhoto, model: LensModel, settings: LensSettings, photo: str
) -> list[PsfSample]:
    """Samples of a photo, unless the model has them already or the photo shows too little."""
    if photo and any(sample.photo == photo and sample.encoded is not None for sample in model.samples):
        return []
    way = way_of(model)
    try:
        chosen = find_patches(developed, count=way.patches, estimator=way.estimator).patches
        made = estimate_cell(
            developed,
            chosen,
            settings=settings,
            photo_id=photo,
            estimator=way.estimator,
            size=way.kernel_size,
        )
    except (NoUsablePatchesError, NotEnoughEvidenceError) as error:
        log.info("the photo adds nothing to what is known of its lens: %s", error)
        return []
    return [one.sample for one in made]


def _with_measured_gain(
    corrected: correction.Corrected, developed: LinearPhoto, roi: tuple[int, int, int, int] | None
) -> correction.Corrected:
    """Say what the correction did to the edges of a chart, where the photo shows one."""
    top, left, height, width = roi or (0, 0, developed.frame.height, developed.frame.width)
    gains = quality.edge_gains(
        developed.planes[1, top : top + height, left : left + width],
        corrected.planes[1],
        developed.frame,
        origin=(top, left),
        noise=developed.noise[1],
        clip=developed.clip[1],
    )
    zones = {
        zone: dataclasses.replace(report, measured=gains.get(zone))
        for zone, report in corrected.zones.items()
    }
    return dataclasses.replace(corrected, zones=zones)
