"""Step 1 of a photo: choose its patches, and estimate one PSF for each."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from lensmodel import estimation
from lensmodel.core.cross_phase import cross_phase
from lensmodel.core.errors import InvalidInputError, NotEnoughEvidenceError, NoUsablePatchesError
from lensmodel.core.psf import PsfSample, delta, rms_width
from lensmodel.core.spectrum import CrossPhase, PatchSpectrum, binned_spectrum
from lensmodel.core.types import (
    CHANNELS,
    Channel,
    FieldPosition,
    LensSettings,
    NoiseModel,
    Plane,
    StepHook,
    ignore_step,
)
from lensmodel.estimation import patches
from lensmodel.estimation.darkest import darkest_share
from lensmodel.estimation.patches import Patch, Selection
from lensmodel.photo import LinearPhoto

log = logging.getLogger(__name__)

DEFAULT_PATCHES: Final = 24
"""Patches asked for in one photo: enough for every ring and octant of the field to get one."""

DEFAULT_KERNEL_SIZE: Final = 31
"""Pixels: holds the blur of usual lenses, while the cost grows with the square of it; the paper's largest has
55 (chosen)."""
_PATCH_SIZE: Final = 192  # pixels: room for a kernel, few enough for one blur (chosen)
_SMALLEST_PATCH: Final = 64  # pixels: one tile of a patch's spectrum


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


@dataclass(frozen=True, slots=True, eq=False)
class SeenPatch:
    """A patch of a photo as a witness of a model's kernels.

    Parameters
    ----------
    position : FieldPosition
    spectrum : PatchSpectrum
        Of green.
    darkest : float or None
        As `PsfSample.darkest`.
    """

    position: FieldPosition
    spectrum: PatchSpectrum
    darkest: float | None = None


def find_patches(
    developed: LinearPhoto,
    *,
    count: int = DEFAULT_PATCHES,
    selector: str | patches.Selector = "r-map",
    on_step: StepHook = ignore_step,
) -> Selection:
    """Choose the patches that tell about the blur, on the green plane."""
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


def require_spread(determined: Sequence[Patch], *, count: int = DEFAULT_PATCHES) -> None:
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
    the votes of a cell's samples add up to the confidence of its estimate.
    """
    method = estimation.estimators.resolve(estimator)
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
        width = rms_width(estimate.kernel)
        for patch, plane, noise in zip(group, planes, noises, strict=True):
            sample = PsfSample(
                kernel=estimate.kernel,
                position=patch.position,
                settings=settings.with_channel(channel),
                weight=float(np.clip(estimate.confidence / len(group), 0.0, 1.0)),
                photo=photo_id,
                pixel_pitch_um=developed.info.metadata.pixel_pitch_um,
                estimator=f"{method.name}/{method.version}",
                error=estimate.predicted_error if math.isfinite(estimate.predicted_error) else None,
                # sharpened by cameras and compressed: no power law of a scene times a lens is left in them
                spectrum=None
                if developed.lossy
                else PatchSpectrum.of(plane, noise, width, _cross(developed, patch, channel)),
                half_diagonal_px=developed.frame.half_diagonal,
                darkest=_darkest(developed, patch) if channel == "g" else None,
            )
            diagnostics = {**estimate.diagnostics, "predicted_error": estimate.predicted_error}
            results.append(CellSample(patch, channel, sample, diagnostics))
        on_step(done + 1, len(order))
    return results


def seen_patches(developed: LinearPhoto) -> list[SeenPatch]:
    """Patches of a photo that tell whether a model's kernels fit it.

    None of a JPEG file or a lossy DNG: cameras sharpen them, and a sharpened spectrum passes for that of a
    sharper lens, as errors of compression do.
    """
    if developed.lossy:
        return []
    try:
        return [
            SeenPatch(
                patch.position,
                PatchSpectrum(*binned_spectrum(*_view(developed, patch, "g"))),
                _darkest(developed, patch),
            )
            for patch in find_patches(developed).patches
        ]
    except (NoUsablePatchesError, InvalidInputError):  # nothing to see, or too small a picture
        return []


def witnesses_of(
    developed: LinearPhoto, settings: LensSettings, patches: Sequence[SeenPatch] | None = None
) -> list[PsfSample]:
    """Samples of a photo's `seen_patches`, found if not handed over, without kernels of their own."""
    known, none = developed.info.metadata, delta(DEFAULT_KERNEL_SIZE)
    return [
        PsfSample(
            kernel=none,
            position=patch.position,
            settings=settings.with_channel("g"),
            pixel_pitch_um=known.pixel_pitch_um,
            half_diagonal_px=developed.frame.half_diagonal,
            spectrum=patch.spectrum,
            darkest=patch.darkest,
        )
        for patch in (seen_patches(developed) if patches is None else patches)
    ]


def _cross(developed: LinearPhoto, patch: Patch, channel: Channel) -> CrossPhase | None:
    """Phase of red or blue against green, where the planes hold the samples of a Bayer mosaic."""
    if developed.cfa is None or channel == "g":
        return None
    window = (slice(None), slice(patch.row, patch.row + patch.size), slice(patch.col, patch.col + patch.size))
    rows = (developed.cfa[(patch.row + row) % 2] for row in (0, 1))
    first, second = ((colours[patch.col % 2], colours[(patch.col + 1) % 2]) for colours in rows)
    return cross_phase(developed.planes[window], (first, second), channel)


def _darkest(developed: LinearPhoto, patch: Patch) -> float | None:
    """How dark green gets around a patch; shadows of compressed files are of their camera's making."""
    if developed.lossy:
        return None
    half = patch.size // 2
    return darkest_share(developed.planes[1], float(developed.clip[1]), patch.row + half, patch.col + half)


def _view(developed: LinearPhoto, patch: Patch, channel: Channel) -> tuple[Plane, NoiseModel]:
    index = CHANNELS.index(channel)
    window = (slice(patch.row, patch.row + patch.size), slice(patch.col, patch.col + patch.size))
    return np.ascontiguousarray(developed.planes[index][window]), developed.noise[index]
