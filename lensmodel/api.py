"""The verbs of the library: `calibrate` a lens from photos, `correct` photos with it."""

from __future__ import annotations

import dataclasses
import logging
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lensmodel import correction, photo
from lensmodel.blind import PsfEstimator, estimators, sampling
from lensmodel.blind.sampling import PRESETS, CalibrationEvent, EventHook, ignore_event, photo_id
from lensmodel.core import errors, processes
from lensmodel.core.errors import InvalidInputError, OutsideSupportError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import Channel, FieldPosition, LensSettings, StepHook
from lensmodel.lens import Lens
from lensmodel.model import LensModel, ModelField
from lensmodel.model.camera_bodies import ALIKE, circle_mm
from lensmodel.model.identity import Identity, difference
from lensmodel.model.query import PAPER
from lensmodel.patches import Selector
from lensmodel.photo import LinearPhoto, PhotoMetadata
from lensmodel.photo.development import photo_from_array
from lensmodel.photo.lateral import LateralColour, estimate_lateral, resample
from lensmodel.photo.metadata import gps_directory
from lensmodel.photo.values import CORRECTED, remarks_log

log = logging.getLogger(__name__)

FORMATS: dict[str, photo.OutputFormat] = {
    ".tif": "tiff16",
    ".tiff": "tiff16",
    ".png": "png16",
    ".jpg": "jpeg",
    ".jpeg": "jpeg",
    ".dng": "dng",
}
"""What is written, by the ending of the file's name, unless `file_format` says it."""

# Expected gain below which a photo is left (chosen): at 0.2 dB nobody saw a difference at 3:1
SEEN_DB: Final = 0.3
AHEAD: Final = 32  # photos that are sent to an executor at once (chosen): a gigabyte, work for dozens


def calibrate(
    photos: Path | str | Iterable[Path | str],
    *,
    lens: Lens | None = None,
    aperture: float | None = None,
    focal_mm: float | None = None,
    focus_m: float | None = None,
    estimator: str | PsfEstimator | None = None,
    selector: str | Selector = "r-map",
    model: str | None = None,
    kernel_size: int | None = None,
    any_lens: bool = False,
    patches: int | None = None,
    workers: int | None = None,
    executor: Executor | None = None,
    on_event: EventHook | None = None,
) -> Lens:
    """Learn the blur of one lens from photos taken with it (Hirsch and Schölkopf, ICCV 2015).

    Photos that cannot help are passed over, and `on_event` learns why: unreadable, too little detail, no
    aperture, of another lens. One that the lens knows already is passed over too.

    Parameters
    ----------
    photos : path, or iterable of paths
        RAW is best, JPEG worst; five or more, full of detail.
    lens : Lens, optional
        What is known already; the new photos are added to it.
    aperture, focal_mm, focus_m : float, optional
        f-number, focal length in mm and focus distance in metres of the photos that do not say their own:
        what a photo says goes first.
    estimator : str or PsfEstimator, optional
        A name in `estimators`, or an object of one's own; one that worker processes cannot load, as of a
        class in a notebook, runs in threads of this process. None takes that of `model`.
    selector : str or Selector
        A name in `selectors`, or an object of one's own.
    model : {"default", "paper"}, optional
        "paper" learns a new lens the paper's own way, and corrects with it so: to compare with, not for
        photos to keep. A lens that is given keeps its own.
    kernel_size, patches : int, optional
        Largest odd side of the estimated kernels in pixels, 3 to 55, by default 55, of an own estimator 31;
        and parts of a photo that are looked at, by default 96, and 24 where kernels are estimated one by one.
    any_lens : bool
        Take photos that seem to be of another lens as well.
    workers : int, optional
        Processes; all cores by default. The result does not depend on it.
    executor : concurrent.futures.Executor, optional
        Runs whole photos instead, on other machines too.
    on_event : callable
        Called as `on_event(event)` with a `CalibrationEvent`; raising `CancelledError` there stops the work.
        None shows the progress on a terminal or in a notebook.

    Raises
    ------
    FileNotFoundError, InvalidInputError
        Before anything is begun, if one of the files is not there, a value is out of its range, both `lens`
        and `model` are given, or no method has that name.
    NotEnoughEvidenceError
        If no photo could be used; the text says why for each.
    """
    _require_workers(workers)
    on_event = on_event or _show_event
    paths = [Path(photos)] if isinstance(photos, str | Path) else [Path(path) for path in photos]
    for path in paths:
        path.stat()
    if lens is not None and model is not None:
        raise InvalidInputError("the lens has a model of its own; give lens or model, not both")
    config = sampling.configured(
        model or ("default" if lens is None else lens.model.mode),
        LensSettings(aperture, focal_mm, focus_m),
        estimator=estimator,
        kernel_size=kernel_size,
        patches=patches,
        selector=selector,
    )
    reasons = []
    with processes.pool(None, workers, estimators.resolve(config.estimator)) as pool:
        calibration = Calibration(LensStore(lens), config, any_lens=any_lens, pool=pool)
        for event in calibration.learn(paths, executor, on_event=on_event):
            if event.error is not None:
                reasons.append(f"{event.photo.name}: {event.detail}")
            on_event(event)
    learned = calibration.known
    if learned is None:
        raise errors.NotEnoughEvidenceError(
            "no photo could be used:\n  " + "\n  ".join(reasons or ["none was given"])
        )
    return learned


class LensStore:
    """Where a lens is kept while it learns: in memory; subclasses keep it where other runs may add to it."""

    def __init__(self, lens: Lens | None = None) -> None:
        self._lens = lens

    def lens(self) -> Lens | None:
        """Return the newest lens: the same object until another run has changed it."""
        return self._lens

    def keep(self, lens: Lens) -> None:
        """Keep a lens that has learned from one photo more."""
        self._lens = lens


Admit = Callable[[PhotoMetadata], None]
Sampler = Callable[[str, Admit], Sequence[PsfSample]]
"""Makes the samples of a photo, given its name and what may refuse it by its header."""


class Calibration:
    """A lens that learns from one photo after the other, kept in a store; `pool` estimates their cells."""

    def __init__(
        self,
        store: LensStore,
        config: sampling.Config,
        *,
        any_lens: bool = False,
        pool: Executor | None = None,
    ) -> None:
        self._store, self._config, self._any_lens, self._pool = store, config, any_lens, pool

    @property
    def known(self) -> Lens | None:
        """The lens as it is now, with what other runs added; None where no photo could be used."""
        return self._store.lens()

    def learn(
        self,
        paths: Iterable[Path],
        executor: Executor | None = None,
        *,
        ahead: int = AHEAD,
        on_event: EventHook = ignore_event,
    ) -> Iterator[CalibrationEvent]:
        """Learn from photos in their order, on an executor if there is one; give what becomes of each."""
        jobs: Iterable[tuple[Path, Future[list[PsfSample]] | None]] = ((path, None) for path in paths)
        if executor is not None:
            jobs = processes.in_order(executor, sampling.samples_of_bytes, paths, self._sent, ahead=ahead)
        for path, job in jobs:
            try:
                count = self.add(path, partial(self._sampled, path, job, on_event))
            except errors.CancelledError:  # is of the whole work, not of one photo
                raise
            except (errors.LensModelError, OSError) as error:
                yield CalibrationEvent(path, "skipped", detail=str(error), error=error)
            else:
                known = CalibrationEvent(path, "skipped", detail="its samples are in the model already")
                yield known if count is None else CalibrationEvent(path, "counted", count, count)

    def add(self, path: Path, sampler: Sampler) -> int | None:
        """Learn from one photo; return how many samples it gave, None where the lens has it already."""
        key = photo_id(path)
        if self._knows(key):
            return None
        if path.stem.endswith(CORRECTED):
            raise InvalidInputError(
                "it was corrected already and says nothing about the lens; give the original"
            )
        identities: list[Identity] = []
        samples = sampler(key, lambda metadata: identities.append(self._admitted(metadata)))
        if self._knows(key):  # another run has added it meanwhile
            return None
        lens, identity = self.known, identities[0]
        self._require_same(lens, identity)
        if lens is None:
            known = Lens(LensModel.fit(samples, self._config.model))
        else:
            known = dataclasses.replace(lens, model=lens.model.added(samples))
        names = known.names
        if lens is None or not self._any_lens:  # a photo that may be of another lens does not name this one
            names = {**identity.names, **names}
        cameras = tuple(dict.fromkeys([*known.cameras, *identity.cameras]))
        self._store.keep(Lens(known.model, names, {**known.photos, key: path.name}, cameras))
        return len(samples)

    def _knows(self, key: str) -> bool:
        """Whether the lens was learned from a photo already."""
        lens = self.known
        return lens is not None and (
            key in lens.photos or any(sample.photo == key for sample in lens.samples)
        )

    def _sampled(
        self, path: Path, job: Future[list[PsfSample]] | None, on_event: EventHook, key: str, admit: Admit
    ) -> list[PsfSample]:
        """Estimate the samples of a photo, or wait for those that are estimated elsewhere."""
        if job is not None:
            admit(photo.inspect(path).metadata)
            return job.result()
        return sampling.samples_of_photo(
            path, self._config, key=key, admit=admit, executor=self._pool, on_event=on_event
        )

    def _sent(self, path: Path) -> tuple[Any, ...] | None:
        """What an executor needs of a photo; None where there is nothing to send, and `add` says why."""
        try:
            key = photo_id(path)
            if self._knows(key) or path.stem.endswith(CORRECTED):
                return None
            self._admitted(photo.inspect(path).metadata)
            return path.name, path.read_bytes(), self._config, key
        except (errors.LensModelError, OSError):
            return None

    def _admitted(self, metadata: PhotoMetadata) -> Identity:
        """Return what a photo says of lens and camera, after refusing one that cannot teach this lens."""
        identity = Identity.of(metadata)
        self._require_same(self.known, identity)
        metadata.require_aperture(self._config.settings)
        return identity

    def _require_same(self, lens: Lens | None, identity: Identity) -> None:
        """Refuse a photo of another lens."""
        if lens is None or self._any_lens:
            return
        why = difference(lens.identity, identity)
        if why is not None:
            raise InvalidInputError(
                f"it seems to be of another lens: {why}; give it a profile of its own, or allow it "
                "(--any-lens, any_lens=True)"
            )


def correct(
    image: Path | str | LinearPhoto | NDArray[np.floating],
    lens: Lens | Path | str,
    output: Path | str | None = None,
    *,
    aperture: float | None = None,
    focal_mm: float | None = None,
    focus_m: float | None = None,
    method: str | correction.Deconvolver | None = None,
    strength: float = 1.0,
    bounds: correction.Bounds | None = None,
    file_format: photo.OutputFormat | None = None,
    color_space: photo.ColorSpace = "same",
    quality: int = 95,
    least_gain_db: float | None = None,
    keep_location: bool = False,
    workers: int | None = None,
    on_step: StepHook | None = None,
) -> correction.Corrected:
    """Remove the blur of a lens from a photo: files in and out, or arrays.

    Non-blind deconvolution with the PSF of each place (Hirsch and Schölkopf, ICCV 2015, section 7), the
    gentler the less sure PSF and photo are. The photo's own patches join the samples for its correction. With
    the method "paper", a lens that was learned the paper's way is corrected without all of that.

    Parameters
    ----------
    image : path, LinearPhoto, or ndarray of float, shape (3, height, width)
        A photo file; what `develop` or `photo_from_array` made; or planes of linear light, black 0 and
        saturation 1, in sensor orientation.
    lens : Lens or path
        The lens, or the file of its profile.
    output : path, optional
        Where to write the corrected photo; it appears complete or not at all. None writes nothing.
    aperture, focal_mm, focus_m : float, optional
        As of `calibrate`. Unknown, the samples of all apertures answer together.
    method : str or Deconvolver, optional
        A name in `deconvolvers`, or an object of one's own with the method `deconvolve`. None takes
        "standard", and "paper" for a lens that was learned the paper's way.
    strength : float
        0 leaves the photo as it is, 1 removes all that its noise allows.
    bounds : Bounds, optional
        What to allow beside edges and in flat areas.
    file_format : {"tiff16", "tiff32", "png16", "png8", "jpeg", "dng"}, optional
        By default what the ending of `output` says, and for a TIFF of floating-point numbers the same again.
    color_space : {"same", "srgb", "camera-linear"}
        Colors of the written file; `quality` is that of a JPEG, 1..100.
    least_gain_db : float, optional
        Write nothing where a lesser gain is expected (`Corrected.expected_gain_db`); None always writes.
    keep_location : bool
        Write where the photo was taken (GPS) into the corrected one too.
    workers : int, optional
        Threads; all cores by default. The result does not depend on it.
    on_step : callable
        Called as `on_step(done, total)`; raising `CancelledError` there stops the work. None shows the
        progress on a terminal.

    Returns
    -------
    Corrected
        `.planes`, float32 of shape (3, height, width) in linear light; `.zones`, the expected gain in centre,
        mid and corner; `.audit`, what was held back and why.

    Raises
    ------
    OSError, UnreadablePhotoError, ImageTooLargeError
        If a file cannot be read or written, not be decoded, or has more pixels than are read.
    InvalidInputError, OutsideSupportError
        If a value is out of its range, the ending of `output` is unknown, it is the photo itself, or no
        method has that name; if nothing tells which part of what the lens draws the photo shows.
    """
    _require_workers(workers)
    given = LensSettings(aperture, focal_mm, focus_m)
    target = None if output is None else Path(output)
    written = file_format or (None if target is None else _format_of(target))
    source = Path(image) if isinstance(image, str | Path) else None
    if target is not None and source is not None and target.exists() and target.samefile(source):
        raise InvalidInputError(f"{target} is the photo itself; name another file for the corrected one")
    known = lens if isinstance(lens, Lens) else Lens.load(lens)
    method = PRESETS[known.model.mode].method if method is None else method
    correction.deconvolvers.resolve(method)  # before the work of developing
    developed = (
        image
        if isinstance(image, LinearPhoto)
        else photo_from_array(np.asarray(image))
        if source is None
        else photo.develop(source)
    )
    corrected = correct_photo(
        developed,
        known.model,
        developed.info.metadata.settings(given),
        method=method,
        strength=strength,
        bounds=bounds,
        lateral=lateral_of(developed),
        photo="" if source is None else photo_id(source),
        least_gain_db=least_gain_db,
        workers=workers or os.cpu_count() or 1,
        on_step=on_step or partial(_show_step, "the photo" if source is None else source.name),
    )
    too_little = least_gain_db is not None and corrected.expected_gain_db < least_gain_db
    if target is None or too_little:
        return corrected
    encoding = developed.encoding
    if file_format is None and source is not None and written == "tiff16" and encoding.bit_depth == 32:
        written = "tiff32"  # what came as floating-point numbers may hold light beyond white
    del developed  # its planes are as large as the result: at 100 megapixels, 1.1 GiB
    name = method if isinstance(method, str) else type(method).__name__
    description = (
        f"lens blur corrected by lensmodel: {known.description}, "
        f"method {name}, strength {strength:g}{'' if bounds is None else bounds.described}"
    )
    photo.write_image(
        target,
        corrected.planes,
        encoding,
        format=written or "tiff16",
        color_space=color_space,
        quality=quality,
        description=description,
        gps=gps_directory(source) if keep_location and source is not None else {},
    )
    return corrected


def lateral_of(developed: LinearPhoto) -> LateralColour:
    """Estimate the lateral colour of a photo from its own edges."""
    return estimate_lateral(developed.planes, developed.frame, clip=developed.clip)


def correct_photo(
    developed: LinearPhoto,
    model: LensModel,
    settings: LensSettings,
    *,
    method: str | correction.Deconvolver | None = None,
    lateral: LateralColour | None = None,
    photo: str = "",
    known: ModelField | None = None,
    **options: Any,  # noqa: ANN401 - of `correct_planes`
) -> correction.Corrected:
    """Remove the blur of the lens from a developed photo; `options` are those of `correct_planes`.

    The paper's way with a lens that was learned so, its PSFs are taken as right.
    """
    whole, developed = developed.frame, placed(developed, model)
    if lateral is not None and developed.frame != whole:
        lateral = lateral.counted_in(developed.frame.half_diagonal)
    wanted, unguarded = _method_of(model, method)
    field = known or psfs_for(developed, model, settings, method=method, photo=photo)
    planes, cfa = developed.planes, developed.cfa
    solver = correction.deconvolvers.resolve(wanted)
    if getattr(solver, "warped", False) and lateral is not None:
        planes, lateral, cfa = resample(planes, developed.frame, lateral), None, None
    return correction.correct_planes(
        planes,
        field if unguarded else _Posteriors(field, (1, 3) if developed.info.turned else (0,)),
        developed.frame,
        method=solver,
        noise=developed.correction_noise,
        clip=developed.clip,
        lateral=lateral,
        cfa=cfa,
        unguarded=unguarded,
        stored=correction.StoredColour.of_photo(developed),
        processed=developed.lossy,
        **options,
    )


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Posteriors:
    """What a model knows of the PSFs of a lens, as the correction needs it."""

    field: ModelField
    turns: Sequence[int] = (0,)  # quarter turns that may lead from the photo to its sensor, equally likely

    def posterior_at(self, position: FieldPosition, channel: Channel) -> correction.PsfPosterior:
        kernels, expected = [], []
        for turn in self.turns:
            place = FieldPosition(position.r, position.phi + turn * math.pi / 2.0)
            answer = self.field.answer_at(place, channel, correction.KERNEL_SIZE)
            kernels.append(np.rot90(answer.kernel, -turn))
            expected.append(answer.predicted_error)
        kernel = np.mean(kernels, axis=0)
        apart = max(np.linalg.norm(each - kernel) for each in kernels) / np.linalg.norm(kernel)
        error = math.hypot(max(expected), apart)
        rings = answer.ring_error if len(self.turns) == 1 else None
        return correction.PsfPosterior.of_error(correction.crop_to_support(kernel), error, rings)


def _method_of(
    model: LensModel, method: str | correction.Deconvolver | None
) -> tuple[str | correction.Deconvolver, bool]:
    """Which method is wanted, and whether all is done the paper's way and nothing else."""
    wanted = PRESETS[model.mode].method if method is None else method
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
    return ModelField(model, settings, developed.info.metadata.pixel_pitch_um)


def _own_samples(
    developed: LinearPhoto, model: LensModel, settings: LensSettings, photo: str
) -> list[PsfSample]:
    """Samples of a photo, unless the model has them already or the photo shows too little."""
    if photo and any(sample.photo == photo and sample.encoded is not None for sample in model.samples):
        return []
    preset = PRESETS[model.mode]
    named: dict[str, Any] = {"settings": settings, "photo_id": photo, "size": preset.kernel_size}
    try:
        chosen = sampling.find_patches(developed, count=preset.patches, estimator=preset.estimator).patches
        return sampling.estimate_cell(developed, chosen, estimator=preset.estimator, **named)
    except (errors.NoUsablePatchesError, errors.NotEnoughEvidenceError) as error:
        log.info("the photo adds nothing to what is known of its lens: %s", error)
        return []


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
        diagonal = 2.0 * frame.half_diagonal
        known = sorted({round(2.0 * s.half_diagonal_px) for s in model.samples if s.half_diagonal_px})
        if known and not any(abs(diagonal / size - 1.0) < ALIKE for size in known):
            raise OutsideSupportError(
                f"its {frame.width} x {frame.height} pixels have a diagonal of {diagonal:.0f} pixels, and "
                f"its lens is known on {' and '.join(map(str, known))}: nothing tells whether it was cut or "
                "scaled; give the photo as the camera wrote it"
            )
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


def _format_of(output: Path) -> photo.OutputFormat:
    known = FORMATS.get(output.suffix.lower())
    if known is None:
        raise InvalidInputError(
            f"no format for {output.name}; give a name that ends in {', '.join(FORMATS)}, or file_format"
        )
    return known


def _require_workers(workers: int | None) -> None:
    if workers is not None and workers < 1:
        raise InvalidInputError(f"workers must be at least 1, got {workers}; None takes all cores")


# --- progress -------------------------------------------------------------------------------------


def say(text: str, *, stays: bool = False) -> None:
    """Show a step on the last line of a terminal; a notebook gets only lines that stay, others nothing."""
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\x1b[K{text}{chr(10) if stays else ''}")  # in place of the step before
        sys.stderr.flush()
    elif stays and "ipykernel" in sys.modules:
        sys.stderr.write(f"{text}\n")


def _show_event(event: CalibrationEvent) -> None:
    """Show what becomes of a photo."""
    if event.stage == "counted":
        say(f"{event.photo.name}: {event.total} samples", stays=True)
    elif event.stage == "skipped":
        say(f"{event.photo.name}: not used: {event.detail}", stays=True)
    else:
        share = f" {event.done / event.total:.0%}" if event.total else ""
        say(f"{event.photo.name}: {event.stage}{share}")


def _show_step(name: str, done: int, total: int) -> None:
    """Show how far the correction of a photo is."""
    say(f"{name}: corrected {done / max(total, 1):.0%}" if done < total else "")
