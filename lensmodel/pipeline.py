"""From photos to a lens model, and from a model to corrected photos: the only glue.

    develop -> find_patches -> estimate_cell (many, independent) -> LensModel.fit
    develop -> correct_photo -> write

Each step is a plain function on values, so that a script, the command line and the workers of
the service run the same code. The steps in the middle are independent of each other and may
run in as many processes as there are.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import math
import os
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import numpy as np

from lensmodel import blind, codec, deconv, patches, photo, quality
from lensmodel.errors import (
    InvalidInputError,
    LensModelError,
    MetadataMissingError,
    NotEnoughEvidenceError,
    NoUsablePatchesError,
)
from lensmodel.files import atomic
from lensmodel.patches import Patch, Selection
from lensmodel.photo import LinearPhoto
from lensmodel.photo.lateral import LateralColour, estimate_lateral, resample
from lensmodel.psf import PsfSample, delta, rms_width
from lensmodel.regression import Doubt, LensModel, ModelSettings, Witness, WitnessedField
from lensmodel.spectrum import PatchSpectrum, binned_spectrum
from lensmodel.types import (
    CHANNELS,
    Channel,
    FieldPosition,
    LensSettings,
    NoiseModel,
    Plane,
    StepHook,
    ignore_step,
)

log = logging.getLogger(__name__)

DEFAULT_PATCHES = 24
"""Patches asked for in one photo: enough for every ring and octant of the field to get one."""

BLIND_BIAS = 0.4
"""Relative L2 error that blind estimates share, so that their scatter in the model does not show it."""

_RING_PLACES, _RING_STEP = 8, 0.05
"""Angles at which the error of a ring is asked for, and how far rings lie apart (chosen): a side of a photo
that is out of focus gives wide kernels of which its own patches are sure, and the other sides are not."""

DEFAULT_PATCH_SIZE = 192
SMALLEST_PATCH = 64
DEFAULT_KERNEL_SIZE = 31


# --- a developed photo on disk -----------------------------------------------------------------


def save_developed(developed: LinearPhoto, folder: Path) -> None:
    """Keep a developed photo so that other processes can map it: planes.npy and photo.json.

    The planes are written last: a folder that has them is complete.
    """
    folder.mkdir(parents=True, exist_ok=True)
    fields = {
        f.name: getattr(developed, f.name) for f in dataclasses.fields(LinearPhoto) if f.name != "planes"
    }
    (folder / "photo.json").write_text(json.dumps(codec.to_json(fields)), encoding="utf-8")
    with atomic(folder / "planes.npy") as file:
        np.save(file, developed.planes, allow_pickle=False)


def load_developed(folder: Path) -> LinearPhoto:
    """Open what `save_developed` kept; the planes are memory-mapped, read-only.

    Raises
    ------
    InvalidInputError
        If the folder holds no complete developed photo.
    """
    try:
        planes = np.load(folder / "planes.npy", mmap_mode="r", allow_pickle=False)
        stored = json.loads((folder / "photo.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"{folder} holds no developed photo; develop it again") from error
    return codec.from_json(LinearPhoto, {**stored, "planes": planes})


# --- calibration -------------------------------------------------------------------------------


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
    evidence : bytes or None
        The patch's sufficient statistics, serialised.
    diagnostics : mapping of str to float
        What the estimator reports of itself.
    """

    patch: Patch
    channel: Channel
    sample: PsfSample
    evidence: bytes | None
    diagnostics: Mapping[str, float]


def find_patches(
    developed: LinearPhoto,
    *,
    count: int = DEFAULT_PATCHES,
    selector: str = "r-map",
    on_step: StepHook = ignore_step,
) -> Selection:
    """Choose the patches that tell about the blur, on the green plane.

    Raises
    ------
    NoUsablePatchesError
        If no part of the photo does, or too few parts to count for a lens (`patches.require_enough`).
    """
    third = (min(developed.frame.height, developed.frame.width) // 3) // 2 * 2
    size = min(DEFAULT_PATCH_SIZE, max(third, SMALLEST_PATCH))
    selection = patches.select(
        developed.planes[1],
        developed.noise[1],
        developed.frame,
        clip=developed.clip[1],
        count=count,
        size=size,
        selector=selector,
        jpeg=developed.info.kind == "jpeg",
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

    Raises
    ------
    NoUsablePatchesError
        If what is left does not tell how the blur changes over the field.
    """
    patches.require_enough(determined, least=min(patches.LEAST_PARTS, math.ceil(count / 3)))


def cells(selection: Selection) -> list[tuple[Patch, ...]]:
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
    estimator: str = "default",
    size: int = DEFAULT_KERNEL_SIZE,
    seed: int = 0,
    channels: Sequence[Channel] = CHANNELS,
    on_step: StepHook = ignore_step,
) -> list[CellSample]:
    """Estimate the PSF of one field cell in each channel, green first.

    The patches of a cell share one kernel: their normal equations are summed, which is worth
    more than averaging finished kernels. Each patch becomes one sample at its own place, and
    the votes of a cell's samples add up to the confidence of its estimate.

    Raises
    ------
    NotEnoughEvidenceError
        If the cell does not determine a kernel.
    """
    method = blind.estimators.create(estimator)
    rng = np.random.default_rng(seed)
    order = sorted(channels, key=lambda c: c != "g")
    views = {c: [_view(developed, patch, c) for patch in group] for c in order}
    results: list[CellSample] = []
    green: blind.PsfEstimate | None = None
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
        proofs = estimate.evidence or (None,) * len(group)
        for patch, evidence, plane, noise in zip(group, proofs, planes, noises, strict=True):
            sample = PsfSample(
                kernel=estimate.kernel,
                position=patch.position,
                settings=settings.with_channel(channel),
                weight=float(np.clip(estimate.confidence / len(group), 0.0, 1.0)),
                photo=photo_id,
                pixel_pitch_um=developed.info.metadata.pixel_pitch_um,
                estimator=f"{method.name}/{method.version}",
                error=estimate.predicted_error if math.isfinite(estimate.predicted_error) else None,
                # cameras sharpen their JPEGs: no power law of a scene times a lens is left in them
                spectrum=None if developed.info.kind == "jpeg" else PatchSpectrum.of(plane, noise, width),
                evidence=evidence,
                half_diagonal_px=developed.frame.half_diagonal,
            )
            stored = None if evidence is None else evidence.to_bytes()
            diagnostics = {**estimate.diagnostics, "predicted_error": estimate.predicted_error}
            results.append(CellSample(patch, channel, sample, stored, diagnostics))
        on_step(done + 1, len(order))
    return results


def _view(developed: LinearPhoto, patch: Patch, channel: Channel) -> tuple[Plane, NoiseModel]:
    index = CHANNELS.index(channel)
    window = (slice(patch.row, patch.row + patch.size), slice(patch.col, patch.col + patch.size))
    return np.ascontiguousarray(developed.planes[index][window]), developed.noise[index]


@dataclass(frozen=True, slots=True)
class CalibrationEvent:
    """What just happened in a calibration, for progress displays.

    `stage` is one of developing, selecting, estimating, counted, skipped; `done` of `total`
    counts patches while estimating.
    """

    photo: Path
    stage: Literal["developing", "selecting", "estimating", "counted", "skipped"]
    done: int = 0
    total: int = 0
    detail: str = ""


EventHook = Callable[[CalibrationEvent], None]


def ignore_event(event: CalibrationEvent) -> None:
    """Do nothing: the default `EventHook`."""


def settings_of(developed: LinearPhoto, override: LensSettings | None = None) -> LensSettings:
    """Settings of the lens as the photo's metadata say, with the caller's values before them."""
    seen = developed.info.metadata
    override = override or LensSettings()
    return LensSettings(
        aperture=seen.aperture if override.aperture is None else override.aperture,
        focal_mm=seen.focal_mm if override.focal_mm is None else override.focal_mm,
        focus_m=seen.focus_m if override.focus_m is None else override.focus_m,
    )


def photo_id(path: Path) -> str:
    """Name a photo by its content: the first 16 hex digits of its SHA-256."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


def samples_of_photo(
    path: Path,
    *,
    settings: LensSettings | None = None,
    estimator: str = "default",
    count: int = DEFAULT_PATCHES,
    workers: int | None = None,
    on_event: EventHook = ignore_event,
) -> list[PsfSample]:
    """Develop one photo, find its patches and estimate a PSF for each patch and channel.

    Cells are estimated in `workers` processes (all cores by default); the result does not
    depend on their number.

    Raises
    ------
    MetadataMissingError
        If the aperture is neither in the file nor given.
    NoUsablePatchesError
        If the photo tells nothing about the blur, or too little, or of one place only.
    """
    on_event(CalibrationEvent(path, "developing"))
    developed = photo.develop(path)
    chosen = settings_of(developed, settings)
    if chosen.aperture is None:
        raise MetadataMissingError(
            f"{path.name} does not say its aperture; give it (for example --aperture 2.8)"
        )
    on_event(CalibrationEvent(path, "selecting"))
    key = photo_id(path)
    groups = cells(find_patches(developed, count=count))
    total = sum(len(group) for group in groups)
    on_event(CalibrationEvent(path, "estimating", 0, total))
    found: dict[int, list[CellSample]] = {}
    done = 0
    with tempfile.TemporaryDirectory(prefix="lensmodel-") as folder:
        save_developed(developed, Path(folder))
        del developed
        workers = max(1, workers or os.cpu_count() or 1)
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            jobs = {
                pool.submit(_cell_from_folder, folder, group, chosen, key, estimator): index
                for index, group in enumerate(groups)
            }
            try:
                for job in as_completed(jobs):
                    index = jobs[job]
                    try:
                        found[index] = job.result()
                    except NotEnoughEvidenceError as error:
                        log.info("a cell of %s was dropped: %s", path.name, error)
                    done += len(groups[index])
                    on_event(CalibrationEvent(path, "estimating", done, total))
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)  # leaving `with` waits only for what runs
                raise
    samples = [cell.sample for index in sorted(found) for cell in found[index]]
    if not samples:
        raise NoUsablePatchesError(
            f"none of the {total} patches of {path.name} determines a PSF; "
            "use a photo with more fine detail in focus"
        )
    determined = [cell.patch for index in sorted(found) for cell in found[index] if cell.channel == "g"]
    require_spread(determined, count=count)
    return samples


def _cell_from_folder(
    folder: str, group: tuple[Patch, ...], settings: LensSettings, key: str, estimator: str
) -> list[CellSample]:
    return estimate_cell(
        load_developed(Path(folder)), group, settings=settings, photo_id=key, estimator=estimator
    )


def calibrate(
    paths: Iterable[Path],
    *,
    model: LensModel | None = None,
    settings: LensSettings | None = None,
    model_settings: ModelSettings | None = None,
    estimator: str = "default",
    count: int = DEFAULT_PATCHES,
    workers: int | None = None,
    on_event: EventHook = ignore_event,
) -> LensModel:
    """Learn the blur of one lens from photos taken with it.

    Photos that cannot help (no detail, unreadable) are skipped and reported through `on_event`.

    Parameters
    ----------
    paths : iterable of Path
        Photos of one lens. RAW is best, JPEG worst.
    model : LensModel, optional
        What is known already; photos that it has not seen are added to it.
    settings : LensSettings, optional
        Values that the files do not say, or say wrongly.
    model_settings : ModelSettings, optional
        Choices of a new model; one that is given keeps its own.

    Raises
    ------
    InvalidInputError
        If both a model and settings for a new one are given.
    NotEnoughEvidenceError
        If no photo gave a sample and there was no model to start from.
    """
    if model is not None and model_settings is not None:
        raise InvalidInputError("the model has settings of its own; give a model or model_settings")
    samples: list[PsfSample] = []
    reasons: list[str] = []
    known = set() if model is None else {sample.photo for sample in model.samples}
    for path in paths:
        if (key := photo_id(path)) in known:
            on_event(CalibrationEvent(path, "skipped", detail="its samples are in the model already"))
            continue
        try:
            found = samples_of_photo(
                path, settings=settings, estimator=estimator, count=count, workers=workers, on_event=on_event
            )
        except LensModelError as error:
            reasons.append(f"{path.name}: {error}")
            on_event(CalibrationEvent(path, "skipped", detail=str(error)))
            continue
        samples.extend(found)
        known.add(key)
        on_event(CalibrationEvent(path, "counted", len(found), len(found)))
    if model is not None:
        return model.added(samples) if samples else model
    if not samples:
        raise NotEnoughEvidenceError(
            "no photo could be used:\n  " + "\n  ".join(reasons or ["none was given"])
        )
    return LensModel.fit(samples, model_settings or ModelSettings())


# --- correction --------------------------------------------------------------------------------


def lateral_of(developed: LinearPhoto) -> LateralColour:
    """Estimate the lateral colour of a photo from its own edges."""
    return estimate_lateral(developed.planes, developed.frame, clip=developed.clip)


def witnesses_of(developed: LinearPhoto, settings: LensSettings) -> list[PsfSample]:
    """Patches of a photo that tell whether a model's kernels fit it: spectra without kernels of their own.

    None of a JPEG file: cameras sharpen them, and a sharpened spectrum passes for that of a sharper lens.
    """
    if developed.info.kind == "jpeg":
        return []
    try:
        selection = find_patches(developed)
    except (NoUsablePatchesError, InvalidInputError):  # nothing to see, or too small a picture
        return []
    known, none = developed.info.metadata, delta(DEFAULT_KERNEL_SIZE)
    return [
        PsfSample(
            kernel=none,
            position=patch.position,
            settings=settings.with_channel("g"),
            pixel_pitch_um=known.pixel_pitch_um,
            half_diagonal_px=developed.frame.half_diagonal,
            spectrum=PatchSpectrum(*binned_spectrum(*_view(developed, patch, "g"))),
        )
        for patch in selection.patches
    ]


def correct_photo(
    developed: LinearPhoto,
    model: LensModel,
    settings: LensSettings,
    *,
    method: str = "standard",
    strength: float = 1.0,
    bounds: deconv.Bounds | None = None,
    lateral: LateralColour | None = None,
    roi: tuple[int, int, int, int] | None = None,
    workers: int = 1,
    on_step: StepHook = ignore_step,
) -> deconv.Corrected:
    """Remove the blur of the lens from a developed photo.

    The model's own predicted error of each PSF makes the correction gentler where it is large, less so
    where the patches exclude that the PSF is too wide (`Doubt`). Where patches of the model and of this photo
    object to a PSF, it is narrowed and its error grows (`Witness`).

    Parameters
    ----------
    bounds : Bounds, optional
        What to allow beside edges and in flat areas.
    roi : tuple of int, optional
        `(row, col, height, width)` in sensor orientation; only that part is corrected.

    Returns
    -------
    Corrected
        Of a chart, with what was measured on its edges (`find_edges`) in each zone.
    """
    model, pitch_um = model.warmed(), developed.info.metadata.pixel_pitch_um
    half_px, doubt = developed.frame.half_diagonal, Doubt(model)
    witness = Witness.of(model, settings, witnesses_of(developed, settings))

    def own_error(position: FieldPosition, channel: Channel) -> float:
        asked = settings.with_channel(channel)
        answer = model.query(position, asked, size=15, pitch_um=pitch_um, half_diagonal_px=half_px)
        error = answer.predicted_error if math.isfinite(answer.predicted_error) else 1.0
        # samples whose estimator said nothing of itself share the error that is usual
        error = math.hypot(error, 0.0 if answer.shared_error > 0 else BLIND_BIAS)
        own = error if answer.extrapolated else error * doubt.share(position, settings)
        return math.hypot(own, witness.verdict(position).error(answer.kernel))

    @lru_cache(maxsize=128)
    def ring_error(r: float) -> float:
        """Mean error around the ring of a radius: a lens is nearly as sharp on one side as on the other."""
        angles = np.arange(_RING_PLACES) * 2.0 * math.pi / _RING_PLACES - math.pi + 1e-6
        return float(np.mean([own_error(FieldPosition(r, float(phi)), "g") for phi in angles]))

    def psf_error(position: FieldPosition, channel: Channel) -> float:
        ring = min(round(position.r / _RING_STEP) * _RING_STEP, 1.0)
        return max(own_error(position, channel), ring_error(ring))

    planes, cfa = developed.planes, developed.cfa
    solver = deconv.deconvolvers.create(method)
    if isinstance(solver, deconv.WarpableMethod) and solver.warped and lateral is not None:
        planes, lateral, cfa = resample(planes, developed.frame, lateral), None, None
    corrected = deconv.correct_planes(
        planes,
        WitnessedField(model.field(settings, pitch_um=pitch_um, half_diagonal_px=half_px), witness),
        developed.frame,
        method=solver,
        strength=strength,
        noise=developed.correction_noise,
        clip=developed.clip,
        psf_error=psf_error,
        lateral=lateral,
        cfa=cfa,
        bounds=bounds,
        roi=roi,
        workers=workers,
        on_step=on_step,
    )
    return _with_measured_gain(corrected, developed, roi)


def _with_measured_gain(
    corrected: deconv.Corrected, developed: LinearPhoto, roi: tuple[int, int, int, int] | None
) -> deconv.Corrected:
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


def correct(
    path: Path,
    model: LensModel,
    output: Path,
    *,
    settings: LensSettings | None = None,
    method: str = "standard",
    strength: float = 1.0,
    bounds: deconv.Bounds | None = None,
    file_format: photo.OutputFormat = "tiff16",
    color_space: photo.ColorSpace = "same",
    quality: int = 95,
    lens: str = "",
    workers: int = 1,
    on_step: StepHook = ignore_step,
) -> deconv.Corrected:
    """Correct one photo file and write the result, in the encoding of the input.

    The file appears complete or not at all. It says in a tag what was done; `lens` goes into that.
    """
    developed = photo.develop(path)
    chosen = settings_of(developed, settings)
    corrected = correct_photo(
        developed,
        model,
        chosen,
        method=method,
        strength=strength,
        bounds=bounds,
        lateral=lateral_of(developed),
        workers=workers,
        on_step=on_step,
    )
    encoding = developed.encoding
    del developed  # its planes are as large as the result: at 100 megapixels, 1.1 GiB
    photo.write_image(
        output,
        corrected.planes,
        encoding,
        format=file_format,
        color_space=color_space,
        quality=quality,
        description=f"lens blur corrected by lensmodel: {lens + ', ' if lens else ''}"
        f"method {method}, strength {strength:g}{'' if bounds is None else bounds.described}",
    )
    return corrected
