"""An estimator of another channel that begins with the kernel of the first."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

from lensmodel.blind import PsfEstimate
from lensmodel.core.types import Kernel, NoiseModel, Plane, StepHook, ignore_step


class StartingFrom(ABC):
    """Both calls of `PsfEstimator` by one run, that for another channel starts from the reference kernel."""

    __slots__ = ()

    def estimate(
        self,
        patches: Sequence[Plane],
        noise: Sequence[NoiseModel],
        *,
        size: int = 31,
        on_step: StepHook = ignore_step,
    ) -> PsfEstimate:
        """Estimate the kernel that all patches share; see `PsfEstimator`."""
        return self._run(patches, noise, size, None, on_step)

    def estimate_channel(
        self,
        patches: Sequence[Plane],
        noise: Sequence[NoiseModel],
        reference: PsfEstimate,
        reference_patches: Sequence[Plane],
        *,
        size: int = 31,
        on_step: StepHook = ignore_step,
    ) -> PsfEstimate:
        """Estimate another channel: the finest level alone, from the reference kernel on."""
        return self._run(patches, noise, size, reference.kernel, on_step)

    @abstractmethod
    def _run(
        self,
        patches: Sequence[Plane],
        noise: Sequence[NoiseModel],
        size: int,
        start: Kernel | None,
        on_step: StepHook,
    ) -> PsfEstimate:
        """Estimate from scratch, or on the finest level alone from a kernel to start with."""
