"""What every non-blind deconvolver takes and returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import NoiseModel, Plane, Planes, StepHook, ignore_step
from lensmodel.correction.blur import UniformBlur

TINY = 1e-6
"""Least light that is divided by, in units of saturation (chosen: far below the noise of any sensor, far
above what single precision cannot divide by)."""

LEAST_PREDICTED = 0.1
"""Least prediction in Richardson-Lucy, as a share of the datum, so that a step raises light tenfold at most
(chosen): a transfer function that belongs to no positive kernel, such as that of a point moved by a part of a
pixel, predicts zero or negative light here and there."""


@dataclass(frozen=True, slots=True, eq=False)
class Sensor:
    """What is known of one plane's sensor: its noise and where it clips.

    Parameters
    ----------
    noise : NoiseModel
        Variance against level.
    clip : float
        Level at and above which a value is only a lower bound; infinity where nothing clips.
    measured : ndarray of bool, shape (H, W), or None
        Where the sensor measured this plane; demosaicing filled in the rest. `None` for everywhere.
    surrounded : bool
        Whether a rim as wide as the reach of the blur will be cut off on all sides. What lies beyond the
        plane then need not be solved for.
    edges : tuple of bool
        Which sides of the plane (top, bottom, left, right) are sides of the frame. The others are cuts:
        what lies beyond them was measured, but is not given.

    Raises
    ------
    InvalidInputError
        If `clip` is no positive level.
    """

    noise: NoiseModel = field(default_factory=lambda: NoiseModel.white(0.005))
    clip: float = float("inf")
    measured: NDArray[np.bool_] | None = None
    surrounded: bool = False
    edges: tuple[bool, bool, bool, bool] = (True, True, True, True)

    def __post_init__(self) -> None:
        if not self.clip > 0.0:
            raise InvalidInputError(f"clip must be a positive level, got {self.clip}")

    def variance(self, plane: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the variance of the noise at each pixel.

        Parameters
        ----------
        plane : ndarray of float, any shape
            Linear light.

        Returns
        -------
        ndarray of float32, same shape
        """
        return self.noise.variance(plane).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Restored:
    """Result of a deconvolution.

    Parameters
    ----------
    plane : Plane, float32, shape (H, W)
        The latent plane inside the frame, in linear light.
    steps : int
        Steps that were taken.
    """

    plane: Plane
    steps: int


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Planes that were restored together.

    Parameters
    ----------
    planes : Planes, shape (3, H, W), float32
        The latent planes inside the frame.
    unexplained : Planes or None
        The light that a prior took of the data; None for a method without one.
    """

    planes: Planes
    unexplained: Planes | None = None


class Deconvolver(Protocol):
    """Non-blind deconvolution of one plane: step 3 of Hirsch and Schölkopf (ICCV 2015, section 7)."""

    def deconvolve(
        self, blurred: Plane, blur: UniformBlur, *, sensor: Sensor, on_step: StepHook = ignore_step
    ) -> Restored:
        """Estimate the latent plane.

        Parameters
        ----------
        blurred : Plane, shape (H, W), float32
            Linear light, as the photo shows it.
        blur : UniformBlur
            From the latent plane, which is wider than the frame by the reach of the blur, onto the frame.
        sensor : Sensor
            Noise, clipping, and which pixels were measured.
        on_step : callable
            Called as `on_step(done, total)` after each step; raising `CancelledError` there stops the work.
            Compiled loops run through and call it once, at the end.

        Returns
        -------
        Restored
            The latent plane inside the frame, shape (H, W), float32.
        """


@runtime_checkable
class ColourDeconvolver(Protocol):
    """A deconvolver that restores the three planes together, one from the other."""

    def deconvolve_planes(
        self, blurred: Planes, blurs: Sequence[UniformBlur], sensors: Sequence[Sensor]
    ) -> Solution:
        """Estimate the latent planes inside the frame.

        Parameters
        ----------
        blurred : Planes, shape (3, H, W), float32
            Linear light.
        blurs : sequence of UniformBlur
            One for each channel.
        sensors : sequence of Sensor
            One for each channel.

        Returns
        -------
        Solution
        """


@runtime_checkable
class CoarseMethod(Protocol):
    """A method for cells that are larger than usual, each of one kernel.

    Attributes
    ----------
    cell_factor : int
        Sides of its cells over the usual ones. Mosaics are cut as usual.
    """

    cell_factor: int


@runtime_checkable
class WarpableMethod(Protocol):
    """A method that may want planes whose lateral colour was removed by resampling.

    Attributes
    ----------
    warped : bool
        Whether it does; otherwise the shift is part of the kernels, which avoids the resampling.
    """

    warped: bool


def restore_planes(
    method: Deconvolver, blurred: Planes, blurs: Sequence[UniformBlur], sensors: Sequence[Sensor]
) -> Solution:
    """Restore planes: together if the method can, else one by one.

    Parameters
    ----------
    method : Deconvolver
    blurred : Planes, shape (3, H, W), float32
        Linear light.
    blurs : sequence of UniformBlur
        One for each channel.
    sensors : sequence of Sensor
        One for each channel.

    Returns
    -------
    Solution
    """
    if isinstance(method, ColourDeconvolver):
        return method.deconvolve_planes(blurred, blurs, sensors)
    restored = [
        method.deconvolve(plane, blur, sensor=sensor).plane
        for plane, blur, sensor in zip(blurred, blurs, sensors, strict=True)
    ]
    return Solution(np.stack(restored))
