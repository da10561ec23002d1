"""The verbs of the library: `calibrate` a lens from photos, `correct` photos with it."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from concurrent.futures import Executor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lensmodel import correction, photo
from lensmodel.core.errors import InvalidInputError, LensModelError
from lensmodel.core.types import LensSettings, StepHook, ignore_step
from lensmodel.estimation import PsfEstimator
from lensmodel.estimation.patches import Selector
from lensmodel.model import ModelSettings
from lensmodel.photo.arrays import photo_from_array
from lensmodel.workflow import pipeline
from lensmodel.workflow.identity import Identity, difference
from lensmodel.workflow.lens import Lens
from lensmodel.workflow.pipeline import CalibrationEvent, EventHook, ignore_event
from lensmodel.workflow.ways import WAYS, way_named, way_of

FORMATS: dict[str, photo.OutputFormat] = {
    ".tif": "tiff16",
    ".tiff": "tiff16",
    ".png": "png16",
    ".jpg": "jpeg",
    ".jpeg": "jpeg",
    ".dng": "dng",
}
"""What is written, by the ending of the file's name, unless `file_format` says it."""


def calibrate(
    photos: Path | str | Iterable[Path | str],
    *,
    lens: Lens | None = None,
    aperture: float | None = None,
    focal_mm: float | None = None,
    focus_m: float | None = None,
    estimator: str | PsfEstimator | None = None,
    selector: str | Selector = "r-map",
    model: str | ModelSettings | None = None,
    kernel_size: int | None = None,
    any_lens: bool = False,
    patches: int = pipeline.DEFAULT_PATCHES,
    workers: int | None = None,
    executor: Executor | None = None,
    on_event: EventHook = ignore_event,
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
    aperture : float, optional
        f-number of the photos that do not say their own: what a photo says goes first. The same goes for
        `focal_mm`, the focal length in mm, and `focus_m`, the focus distance in metres.
    estimator : str or PsfEstimator
        A name in `estimators`, or an object of one's own with the same methods. It is sent to worker
        processes; one that they cannot load, as of a class in a notebook, runs in threads of this process.
        None takes that of `model`.
    selector : str or Selector
        A name in `selectors`, or an object of one's own, which scores the windows of a photo by how much they
        tell about the blur.
    model : {"default", "paper"} or ModelSettings, optional
        "paper" learns a new lens the paper's own way, with nothing else mixed in, and corrects with it so:
        to compare with, not for photos to keep. Or the choices of the regression. A lens that is given keeps
        its own.
    kernel_size : int, optional
        Odd side of the estimated kernels in pixels, 3 to 55; by default 31, and 55 the paper's way.
    any_lens : bool
        Take photos that seem to be of another lens as well.
    patches : int
        Parts of a photo that are looked at; fewer are faster and know less.
    workers : int, optional
        Processes; all cores by default. The result does not depend on it.
    executor : concurrent.futures.Executor, optional
        Runs whole photos instead, on other machines too.
    on_event : callable
        Called as `on_event(event)` with a `CalibrationEvent`: `event.photo`, `event.stage`, `event.done` of
        `event.total` patches, `event.detail`.

    Returns
    -------
    Lens
        With all fitted that takes long: it answers and corrects at once.

    Raises
    ------
    FileNotFoundError
        If one of the files is not there; nothing is begun then.
    InvalidInputError
        If a value is out of its range, or both `lens` and `model` are given.
    UnknownMethodError
        If there is no estimator or model of that name.
    NotEnoughEvidenceError
        If no photo could be used; the text says why for each.
    """
    paths = [Path(photos)] if isinstance(photos, str | Path) else [Path(path) for path in photos]
    for path in paths:
        path.stat()
    way = (
        way_named(model)
        if isinstance(model, str)
        else WAYS["default"]
        if lens is None
        else way_of(lens.model)
    )
    chosen = ModelSettings(mode=way.mode) if isinstance(model, str) else model
    grown = _Growing(lens, any_lens=any_lens, on_event=on_event)
    fitted = pipeline.calibrate(
        grown.admitted(paths),
        model=None if lens is None else lens.model,
        settings=LensSettings(aperture, focal_mm, focus_m),
        model_settings=chosen,
        estimator=way.estimator if estimator is None else estimator,
        selector=selector,
        count=patches,
        kernel_size=kernel_size or way.kernel_size,
        workers=workers,
        executor=executor,
        on_event=grown.record,
    )
    return Lens.grown(lens, fitted, grown.photos, grown.identities, any_lens=any_lens)


class _Growing:
    """What the photos of one calibration say of their lens, as they are counted."""

    def __init__(self, lens: Lens | None, *, any_lens: bool, on_event: EventHook) -> None:
        self.photos: dict[str, str] = {}
        self.identities: list[Identity] = []
        self._names = {} if lens is None else dict(lens.profile.lens)
        self._cameras = [] if lens is None else list(lens.profile.cameras)
        self._any_lens, self._on_event = any_lens, on_event
        self._known = lens is not None

    def admitted(self, paths: Iterable[Path]) -> Iterator[Path]:
        """Give the photos that nothing speaks against; those that cannot be read are refused later on."""
        for path in paths:
            if (why := self._objection(path)) is not None:
                self._on_event(CalibrationEvent(path, "skipped", detail=why))
            else:
                yield path

    def _objection(self, path: Path) -> str | None:
        if self._any_lens or not self._known:
            return None
        try:
            return difference(self._names, self._cameras, _identity(path))
        except LensModelError:
            return None

    def record(self, event: CalibrationEvent) -> None:
        """Remember a photo that counted, and pass the event on."""
        if event.stage == "counted":
            identity = _identity(event.photo)
            self.photos[pipeline.photo_id(event.photo)] = event.photo.name
            self.identities.append(identity)
            self._known = True
            self._names = {**identity.lens, **self._names}
            if identity.camera is not None:
                self._cameras.append(identity.camera)
        self._on_event(event)


def _identity(path: Path) -> Identity:
    return Identity.of(photo.inspect(path).metadata)


def correct(
    image: Path | str | photo.LinearPhoto | NDArray[np.floating],
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
    sidecar: bool = False,
    workers: int | None = None,
    on_step: StepHook = ignore_step,
) -> correction.Corrected:
    """Remove the blur of a lens from a photo: files in and out, or arrays.

    Parameters
    ----------
    image : path, LinearPhoto, or ndarray of shape (3, height, width)
        A photo file; what `develop` or `photo_from_array` made; or planes of linear light, black 0 and
        saturation 1, in sensor orientation.
    lens : Lens or path
        The lens, or the file of its profile.
    output : path, optional
        Where to write the corrected photo; it appears complete or not at all. None writes nothing.
    aperture : float, optional
        f-number of a photo that does not say its own: what a photo says goes first. The same goes for
        `focal_mm` in mm and `focus_m` in metres. Unknown, the samples of all apertures answer together.
    method : str or Deconvolver, optional
        A name in `deconvolvers`, or an object of one's own with the method `deconvolve`. None takes
        "standard", and "paper" for a lens that was learned the paper's way.
    strength : float
        0 leaves the photo as it is, 1 removes all that its noise allows.
    bounds : Bounds, optional
        What to allow beside edges and in flat areas.
    file_format : {"tiff16", "png16", "png8", "jpeg", "dng"}, optional
        By default what the ending of `output` says (`FORMATS`).
    color_space : {"same", "srgb", "camera-linear"}
        Colors of the written file.
    quality : int
        Of a JPEG, 1..100.
    least_gain_db : float, optional
        Write nothing where a lesser gain is expected (`Corrected.expected_gain_db`); None always writes.
    sidecar : bool
        Write an XMP file beside the corrected photo too, which tells what was done.
    workers : int, optional
        Threads; all cores by default. The result does not depend on it.
    on_step : callable
        Called as `on_step(done, total)`; raising `CancelledError` there stops the work.

    Returns
    -------
    Corrected
        `.planes`, float32 of shape (3, height, width) in linear light; `.zones`, the expected gain in center,
        mid and corner; `.audit`, what was held back and why.

    Raises
    ------
    UnreadablePhotoError
        If the file cannot be decoded.
    InvalidInputError
        If a value is out of its range, the ending of `output` is unknown, or it is the photo itself.
    UnknownMethodError
        If there is no method of that name.
    """
    target = None if output is None else Path(output)
    written = file_format or (None if target is None else _format_of(target))
    source = Path(image) if isinstance(image, str | Path) else None
    if target is not None and source is not None and target.exists() and target.samefile(source):
        raise InvalidInputError(f"{target} is the photo itself; name another file for the corrected one")
    known = (lens if isinstance(lens, Lens) else Lens.load(lens)).warmed()
    method = way_of(known.model).method if method is None else method
    correction.deconvolvers.resolve(method)  # before the work of developing
    return pipeline.correct(
        source or (image if isinstance(image, photo.LinearPhoto) else photo_from_array(np.asarray(image))),
        known.model,
        target,
        settings=LensSettings(aperture, focal_mm, focus_m),
        method=method,
        strength=strength,
        bounds=bounds,
        file_format=written or "tiff16",
        color_space=color_space,
        quality=quality,
        least_gain_db=least_gain_db,
        sidecar=sidecar,
        lens=known.description,
        workers=workers or os.cpu_count() or 1,
        on_step=on_step,
    )


def _format_of(output: Path) -> photo.OutputFormat:
    known = FORMATS.get(output.suffix.lower())
    if known is None:
        raise InvalidInputError(
            f"no format for {output.name}; give a name that ends in {', '.join(FORMATS)}, or file_format"
        )
    return known
