"""From a raw kernel to an estimate: the last steps that several blind methods share."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import centred, resized, rms_width
from lensmodel.core.spectrum import binned_spectrum
from lensmodel.core.types import Kernel, NoiseModel, Plane
from lensmodel.estimation.estimator import PsfEstimate, is_no_blur

_HALF_CONFIDENT = 0.4
"""Relative error at which a kernel's weight is a half: that of a usual blind one (chosen)."""


def signal_share(kept: Sequence[tuple[Plane, NoiseModel]]) -> NDArray[np.float64]:
    """Share of signal in the power of each ring of frequency, mean over patches, `(rings,)`."""
    shares = []
    for patch, model in kept:
        spectrum, floor = binned_spectrum(patch, model)
        power = spectrum.mean(axis=1, dtype=np.float64)
        shares.append(np.clip(1.0 - floor / np.maximum(power, 1e-30), 0.0, 1.0))
    return np.asarray(np.mean(shares, axis=0), dtype=np.float64)


def confidence_of(error: float) -> float:
    """Confidence of an estimate with an expected relative L2 error; 1/2 at 0.4."""
    return 1.0 / (1.0 + (error / _HALF_CONFIDENT) ** 2)


def finished(
    kernel: Kernel,
    kept: Sequence[tuple[Plane, NoiseModel]],
    *,
    size: int,
    error: float,
    diagnostics: Mapping[str, float],
    began: float,
) -> PsfEstimate:
    """Centre a kernel and gather the evidence for it.

    Parameters
    ----------
    kernel : Kernel
        Of any odd side.
    kept : sequence of (Plane, NoiseModel)
        The patches that it came from.
    size : int
        Odd side of the answer.
    error : float
        Expected relative L2 distance to the true kernel; confidence is 1/2 at 0.4.
    diagnostics : mapping of str to float
        What else the method reports.
    began : float
        `time.process_time()` at its start.
    """
    final = resized(centred(kernel), size)
    error = min(max(error, 0.0), 1.0) if math.isfinite(error) else 1.0
    return PsfEstimate(
        kernel=final,
        confidence=confidence_of(error),
        reliability=signal_share(kept),
        predicted_error=error,
        diagnostics={"width": rms_width(final), **diagnostics},
        seconds=time.process_time() - began,
        no_blur=is_no_blur(final),
    )
