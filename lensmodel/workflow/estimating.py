"""Step 1 of a photo: choose its patches, and estimate one PSF for each."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from lensmodel import estimation
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import (
    CHANNELS,
    Channel,
    LensSettings,
    NoiseModel,
    Plane,
    StepHook,
    ignore_step,
)
from lensmodel.estimation import patches
from lensmodel.estimation.patches import Patch, Selection
from lensmodel.photo import LinearPhoto

log = logging.getLogger(__name__)

DEFAULT_KERNEL_SIZE: Final = 31
"""Pixels: holds the blur of usual lenses, while the cost grows with the square of it; the paper's largest has
55 (chosen)."""
_PATCH_SIZE: Final = 192  # pixels: room for a kernel, few enough for one blur (chosen)
_SMALLEST_PATCH: Final = 64  # pixels: the least that estimators take


@dataclass(frozen=True, slots=True)
class CellSample:
    """One PSF sample with what it was made from.

    Parameters
    ----------
    patch : Patch
        Where in the photo.
    channel : {"r", "g", "b"}
        Which colour plane.
    sample : PsfSample
        The estimate, ready for the model.
    diagnostics : mapping of str to float
        What the estimator reports of itself.
    """

    patch: Patch
    channel: Channel
    sample: PsfSample
    diagnostics: Mapping[str, float]


def find_patches(
    developed: LinearPhoto,
    *,
    count: int,
    selector: str | patches.Selector = "r-map",
    estimator: str | estimation.PsfEstimator = "default",
    on_step: StepHook = ignore_step,
) -> Selection:
    """Choose the patches that tell about the blur.

    An estimator of whole photos chooses its own; for others `selector` scores windows of the green plane.
    """
    method = estimation.estimators.resolve(estimator)
    if isinstance(method, estimation.PhotoEstimator):
        selection = method.select(developed, count=count)
        require_spread(selection.patches, count=count)
        return selection
    third = (min(developed.frame.height, developed.frame.width) // 3) // 2 * 2
    size = min(_PATCH_SIZE, max(third, _SMALLEST_PATCH))
    selection = patches.select(
        developed.planes[1],
        developed.noise[1],
        developed.frame,
        clip=developed.clip[1],
        count=count,
        size=size,
        selector=selector,
        jpeg=developed.lossy,
        coarse_noise=developed.coarse_noise[1],
        on_step=on_step,
    )
    # the selector makes cells of about three patches: of few that were asked for, few lie apart
    patches.require_enough(selection.patches, least=min(patches.LEAST_PATCHES, math.ceil(count / 3)))
    return selection


def require_spread(determined: Sequence[Patch], *, count: int) -> None:
    """Refuse a photo of whose patches too few gave a PSF: three parts of the picture must be left.

    Parameters
    ----------
    determined : sequence of Patch
        Patches with a PSF.
    count : int
        How many patches were asked for.
    """
    patches.require_enough(determined, least=min(patches.LEAST_PARTS, math.ceil(count / 3)))


def patches_by_cell(selection: Selection) -> list[tuple[Patch, ...]]:
    """Group accepted patches by field cell, the unit of work, largest groups first."""
    grouped: dict[int, list[Patch]] = {}
    for patch in selection.patches:
        grouped.setdefault(patch.cell, []).append(patch)
    return [tuple(group) for _, group in sorted(grouped.items(), key=lambda item: (-len(item[1]), item[0]))]


def estimate_cell(
    developed: LinearPhoto,
    group: Sequence[Patch],
    *,
    settings: LensSettings,
    photo_id: str,
    estimator: str | estimation.PsfEstimator = "default",
    size: int = DEFAULT_KERNEL_SIZE,
    seed: int = 0,
    channels: Sequence[Channel] = CHANNELS,
    on_step: StepHook = ignore_step,
) -> list[CellSample]:
    """Estimate the PSF of one field cell in each channel, green first.

    The patches of a cell share one kernel: their normal equations are summed, which is worth
    more than averaging finished kernels. Each patch becomes one sample at its own place, and
    the weights of a cell's samples add up to the confidence of its estimate. An estimator of whole
    photos has all patches of one in one cell, and gives each its own kernels.
    """
    method = estimation.estimators.resolve(estimator)
    if isinstance(method, estimation.PhotoEstimator):
        patches_of = {patch.position: patch for patch in group}
        samples = method.samples(
            developed, group, settings=settings, photo=photo_id, size=size, on_step=on_step
        )
        return [
            CellSample(
                patches_of[sample.position],
                sample.settings.channel,
                sample,
                {"predicted_error": sample.error or 0.0},
            )
            for sample in samples
        ]
    rng = np.random.default_rng(seed)
    order = sorted(channels, key=lambda c: c != "g")
    views = {c: [_view(developed, patch, c) for patch in group] for c in order}
    results: list[CellSample] = []
    green: estimation.PsfEstimate | None = None
    for done, channel in enumerate(order):
        planes = [view[0] for view in views[channel]]
        noises = [view[1] for view in views[channel]]
        try:
            if green is None or "g" not in views:
                estimate = method.estimate(planes, noises, size=size, rng=rng)
            else:
                reference = [view[0] for view in views["g"]]
                estimate = method.estimate_channel(planes, noises, green, reference, size=size, rng=rng)
        except NotEnoughEvidenceError:
            if channel == "g":
                raise
            log.info("channel %s of a cell at r=%.2f gave no kernel", channel, group[0].position.r)
            continue
        if channel == "g":
            green = estimate
        for patch in group:
            sample = PsfSample(
                kernel=estimate.kernel,
                position=patch.position,
                settings=settings.with_channel(channel),
                weight=float(np.clip(estimate.confidence / len(group), 0.0, 1.0)),
                photo=photo_id,
                pixel_pitch_um=developed.info.metadata.pixel_pitch_um,
                estimator=f"{method.name}/{method.version}",
                error=estimate.predicted_error if math.isfinite(estimate.predicted_error) else None,
                half_diagonal_px=developed.frame.half_diagonal,
            )
            diagnostics = {**estimate.diagnostics, "predicted_error": estimate.predicted_error}
            results.append(CellSample(patch, channel, sample, diagnostics))
        on_step(done + 1, len(order))
    return results


def _view(developed: LinearPhoto, patch: Patch, channel: Channel) -> tuple[Plane, NoiseModel]:
    index = CHANNELS.index(channel)
    window = (slice(patch.row, patch.row + patch.size), slice(patch.col, patch.col + patch.size))
    return np.ascontiguousarray(developed.planes[index][window]), developed.noise[index]
