"""What every way of measuring takes and gives, and the names by which they are chosen."""

from __future__ import annotations

import contextlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError, LensModelError, NotEnoughEvidenceError
from lensmodel.core.psf import PsfSample, as_kernel
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, Kernel, LensSettings, StepHook, ignore_step
from lensmodel.photo import LinearPhoto

PREFIX = "measured-"  # How the names of measuring estimators begin: blind ones never do


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredPsf:
    """A PSF measured at one place of a photo."""

    kernel: Kernel  # (k, k), impulse response on the sensor's grid, centre of mass on the middle pixel
    position: FieldPosition  # middle of what it was measured on
    channel: Channel  # colour plane
    error: float  # relative L2 distance to the truth that the method expects
    pixel: tuple[float, float]  # middle of what it was measured on, (row, col)
    side: int  # side in pixels of the window that it was measured on

    def __post_init__(self) -> None:
        object.__setattr__(self, "kernel", as_kernel(self.kernel))


Prepared: TypeAlias = tuple[Sequence[Any], Callable[[Any, Channel], MeasuredPsf]]


class Measurer(ABC):
    """One way to measure the PSF of a lens on photos made for it."""

    name: ClassVar[str]
    version: ClassVar[int]
    photos: ClassVar[int]
    """How many photos one measurement takes."""
    nothing: ClassVar[str]
    """What is missing where no place gives a PSF."""

    def measure(
        self,
        photos: Sequence[LinearPhoto],
        *,
        size: int,
        channels: Sequence[Channel] = CHANNELS,
        on_step: StepHook = ignore_step,
    ) -> list[MeasuredPsf]:
        """Measure the PSF wherever the photos show it.

        Parameters
        ----------
        photos : sequence of LinearPhoto
            As many as `photos` says; the first is the one whose PSF is measured.
        size : int
            Odd side of the kernels in pixels.
        channels : sequence of {"r", "g", "b"}
            Colour planes to measure.
        on_step : StepHook
            Called after each place, and now and then before the first one, with nothing done of 1.

        Raises
        ------
        InvalidInputError
            If the number of photos is wrong, or they do not fit each other.
        NotEnoughEvidenceError
            If they do not show what this way of measuring needs; the text says what is missing.
        """
        if len(photos) != self.photos:
            raise InvalidInputError(
                f"measuring by {self.name} takes {self.photos} photo{'s' * (self.photos > 1)} at a time, "
                f"got {len(photos)}"
            )
        if size < 3 or size % 2 == 0:
            raise InvalidInputError(f"kernels have an odd side of 3 pixels or more, got {size}")
        places, psf_in = self._prepare(photos, size, on_step)
        psfs = []
        for done, place in enumerate(places, start=1):
            for channel in channels:
                with contextlib.suppress(LensModelError):
                    psfs.append(psf_in(place, channel))
            on_step(done, len(places))
        if not psfs:
            raise NotEnoughEvidenceError(self.nothing)
        return psfs

    @abstractmethod
    def _prepare(self, photos: Sequence[LinearPhoto], size: int, on_step: StepHook) -> Prepared:
        """Find the places that photos show, and what measures one of them in a colour or raises."""


def samples_of(
    measured: Sequence[MeasuredPsf],
    method: Measurer,
    photo: LinearPhoto,
    *,
    photo_id: str,
    settings: LensSettings,
) -> list[PsfSample]:
    """Make samples of measurements, as a `LensModel` takes them.

    The estimator is called `measured-NAME/VERSION`; the weight is 1, the error is the measurement's own.
    """
    return [
        PsfSample(
            kernel=psf.kernel,
            position=psf.position,
            settings=settings.with_channel(psf.channel),
            weight=1.0,
            photo=photo_id,
            pixel_pitch_um=photo.info.metadata.pixel_pitch_um,
            estimator=f"{PREFIX}{method.name}/{method.version}",
            error=psf.error,
            half_diagonal_px=photo.frame.half_diagonal,
        )
        for psf in measured
    ]


def is_measured(sample: PsfSample) -> bool:
    """Whether a sample was measured, and not estimated from an ordinary photo."""
    return sample.estimator.startswith(PREFIX)


def psf_at(
    photo: LinearPhoto,
    channel: Channel,
    kernel: Kernel,
    pixel: NDArray[np.floating],
    side: int,
    error: float,
    most: float = math.inf,
) -> MeasuredPsf:
    """Say where a kernel was measured; refuse one whose expected error is as large as that of a blind one."""
    if not error < most:  # nor one that is not known
        raise NotEnoughEvidenceError(f"the kernel is expected to be wrong by {error:.0%}")
    row, col = map(float, pixel)
    return MeasuredPsf(kernel, photo.frame.position(row, col), channel, error, (row, col), side)
