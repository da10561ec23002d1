"""From photos made to measure a lens to samples for its model: files in, samples out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import LensSettings, StepHook, ignore_step
from lensmodel.estimation import measure
from lensmodel.photo import LinearPhoto, develop, inspect
from lensmodel.workflow import pipeline

DEFAULT_SIZE: Final = 31  # pixels: that of an estimate


def samples_of_measurement(
    kind: str,
    paths: Sequence[Path],
    *,
    settings: LensSettings | None = None,
    size: int = DEFAULT_SIZE,
    on_step: StepHook = ignore_step,
) -> list[PsfSample]:
    """Develop the photos of one measurement and measure the PSF on them.

    Parameters
    ----------
    kind : str
        A name in `lensmodel.estimation.measure.methods`.
    paths : sequence of Path
        One photo; of an aperture pair two, the open one first.
    settings : LensSettings, optional
        Values that the first photo does not say, or says wrongly.
    size : int
        Odd side of the kernels in pixels.
    on_step : StepHook
        Called after each place.
    """
    photos = [develop(path) for path in paths]
    return samples_of_developed(
        kind, photos, photo_id=pipeline.photo_id(paths[0]), settings=settings, size=size, on_step=on_step
    )


def samples_of_developed(
    kind: str,
    photos: Sequence[LinearPhoto],
    *,
    photo_id: str,
    settings: LensSettings | None = None,
    size: int = DEFAULT_SIZE,
    on_step: StepHook = ignore_step,
) -> list[PsfSample]:
    """Measure the PSF on developed photos; see `samples_of_measurement`."""
    method = measure.methods.create(kind)
    if not photos:
        raise InvalidInputError(f"measuring by {kind} needs photos, none was given")
    pipeline.require_aperture(photos[0].info.metadata, settings)
    chosen = pipeline.settings_of(photos[0], settings)
    measured = method.measure(photos, size=size, on_step=on_step)
    return measure.samples_of(measured, method, photos[0], photo_id=photo_id, settings=chosen)


def measurements_of(kind: str, paths: Sequence[Path]) -> list[tuple[Path, ...]]:
    """Group photos into measurements: each for itself, or in twos, the wider aperture first."""
    method = measure.methods.create(kind)
    count = method.photos
    if not paths or len(paths) % count:
        raise InvalidInputError(
            f"measuring by {kind} takes {count} photo{'s' * (count > 1)} at a time, got {len(paths)}"
        )
    groups = [tuple(paths[i : i + count]) for i in range(0, len(paths), count)]
    return [_by_aperture(group) if count > 1 else group for group in groups]


def _by_aperture(group: tuple[Path, ...]) -> tuple[Path, ...]:
    """Widest aperture first; in the order given where a photo does not say its own."""
    apertures = [inspect(path).metadata.aperture for path in group]
    known = [aperture for aperture in apertures if aperture is not None]
    if len(known) < len(group):
        return group
    if len(set(known)) < len(group):
        raise InvalidInputError(
            f"{' and '.join(path.name for path in group)} are both at f/{known[0]:g}; a pair is one photo "
            "wide open and one closed to about f/8"
        )
    return tuple(path for _, path in sorted(zip(known, group, strict=True), key=lambda pair: pair[0]))
