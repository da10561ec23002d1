"""What every blind estimator takes, gives and refuses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol, runtime_checkable

import numpy as np

from lensmodel.core.errors import InvalidInputError, NotEnoughEvidenceError
from lensmodel.core.psf import PsfSample, centred, resized
from lensmodel.core.types import Kernel, LensSettings, NoiseModel, Plane, StepHook, ignore_step
from lensmodel.patches import Patch, Selection
from lensmodel.photo.values import LinearPhoto

_MIN_SIDE = 64  # pixels: one tile of a patch's spectrum
_CONTRAST_IN_NOISE = 3.0  # standard deviations: less contrast is noise (chosen)
_CLIPPED_SHARE = 0.02  # of the pixels: a few clipped ones spoil no estimate (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class PsfEstimate:
    """One estimated PSF and the evidence for it.

    Parameters
    ----------
    kernel : Kernel, float64, shape (size, size)
        Of sum 1, on the pixel grid of the patches.
    predicted_error : float
        Expected relative L2 distance to the true kernel; the larger, the less an estimate counts.
    """

    kernel: Kernel
    predicted_error: float


class PsfEstimator(Protocol):
    """A blind estimator: patches of one field position in, one kernel out.

    Name and version are stored with each sample. Source: M. Hirsch, B. Schölkopf, "Self-Calibration of
    Optical Lenses", ICCV 2015, section 5.
    """

    @property
    def name(self) -> str:
        """As in the registry."""

    @property
    def version(self) -> int | str:
        """Grows, or changes, when results change."""

    def estimate(
        self,
        patches: Sequence[Plane],
        noise: Sequence[NoiseModel],
        *,
        size: int = 31,
        green: PsfEstimate | None = None,
    ) -> PsfEstimate:
        """Estimate the kernel that all patches share, of sum 1 and with its centre of mass in the middle.

        Parameters
        ----------
        patches, noise : sequence of Plane, float32, each of shape (h, w), and of NoiseModel
            Windows of 64 to 512 px of one color plane, linear light, and a model for each.
        size : int
            Odd side of the kernel, up to 55.
        green : PsfEstimate, optional
            What this method gave for the same windows in green, to start another color from.

        Raises
        ------
        InvalidInputError, NotEnoughEvidenceError
            If patches are no such windows; if none determines a kernel: flat, clipped, or noise only.
        """


@runtime_checkable
class PhotoEstimator(Protocol):
    """An estimator that chooses windows of a whole photo and learns from each beside the others."""

    def select(self, developed: LinearPhoto, *, count: int) -> Selection:
        """Choose at most `count` windows."""

    def samples(
        self,
        developed: LinearPhoto,
        patches: Sequence[Patch],
        *,
        settings: LensSettings,
        photo: str,
        size: int,
        on_step: StepHook = ignore_step,
    ) -> list[PsfSample]:
        """Return the samples of the windows, three of each in the order of `CHANNELS`."""


LARGEST: Final = 55  # pixels, the side of the paper's kernels: a larger one leaves too little of a patch


def require_size(size: int) -> None:
    """Refuse kernel sizes that cannot be estimated."""
    if size % 2 == 0 or not 3 <= size <= LARGEST:
        raise InvalidInputError(f"the size of kernels must be odd and in 3..{LARGEST}, got {size}")


def usable(
    patches: Sequence[Plane], noise: Sequence[NoiseModel], size: int
) -> list[tuple[Plane, NoiseModel]]:
    """Check patches first and keep those that carry signal."""
    require_size(size)
    if len(patches) != len(noise) or not patches:
        raise InvalidInputError(f"every patch needs a noise model, got {len(patches)} and {len(noise)}")
    for patch in patches:
        if patch.ndim != 2 or min(patch.shape) < _MIN_SIDE:
            raise InvalidInputError(f"a patch must be a plane of at least {_MIN_SIDE} px, got {patch.shape}")
        if not np.isfinite(patch).all():
            raise InvalidInputError("a patch must be finite; mask or replace NaN and infinity first")
    kept = [pair for pair in zip(patches, noise, strict=True) if _tells(*pair)]
    if not kept:
        raise NotEnoughEvidenceError(
            "no patch determines a kernel: they are flat, clipped or noise; choose parts with fine detail"
        )
    return kept


def _tells(patch: Plane, model: NoiseModel) -> bool:
    """Whether a patch is neither flat nor clipped, nor noise alone."""
    least = max(_CONTRAST_IN_NOISE * model.sigma_at(float(patch.mean())), 1e-7)
    # White noise has as much power between neighbours as anywhere; a picture has far less.
    steps = 0.5 * float(np.var(np.diff(patch, axis=0)) + np.var(np.diff(patch, axis=1)))
    clipped = float((patch >= 0.995).mean())
    return float(patch.std()) > least and clipped <= _CLIPPED_SHARE and steps <= 1.4 * float(patch.var())


def weight_of(error: float) -> float:
    """Weight of an estimate with an expected relative L2 error; 1/2 at a usual one, 0.4 (chosen)."""
    return 1.0 / (1.0 + (error / 0.4) ** 2)


def finished(kernel: Kernel, *, size: int, error: float) -> PsfEstimate:
    """Centre a kernel of any odd side, of an expected relative L2 error."""
    error = min(max(error, 0.0), 1.0) if math.isfinite(error) else 1.0
    return PsfEstimate(resized(centred(kernel), size), error)
