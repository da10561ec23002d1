"""What every blind estimator takes and gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lensmodel.types import Kernel, NoiseModel, Plane, StepHook, ignore_step


@dataclass(frozen=True, slots=True, eq=False)
class PsfEstimate:
    """One estimated PSF and what speaks for it."""

    kernel: Kernel
    confidence: float
    reliability: NDArray[np.float64]
    predicted_error: float
    diagnostics: Mapping[str, float]
    seconds: float
    evidence: tuple[Any, ...] = ()
    no_blur: bool = False


class PsfEstimator(Protocol):
    """A blind estimator: patches of one field position in, one kernel out."""

    name: str
    version: int

    def estimate(
        self,
        patches: Sequence[Plane],
        noise: Sequence[NoiseModel],
        *,
        size: int = 31,
        rng: np.random.Generator | None = None,
        on_step: StepHook = ignore_step,
    ) -> PsfEstimate:
        """Estimate the kernel that all patches share."""

    def estimate_channel(
        self,
        patches: Sequence[Plane],
        noise: Sequence[NoiseModel],
        reference: PsfEstimate,
        reference_patches: Sequence[Plane],
        *,
        size: int = 31,
        rng: np.random.Generator | None = None,
        on_step: StepHook = ignore_step,
    ) -> PsfEstimate:
        """Estimate another channel of the same patches, given the result of the first."""
