"""What every non-blind deconvolver takes and returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import NoiseModel, Plane, Planes
from lensmodel.correction.blur import Mask, Real, UniformBlur


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
    edges : tuple of bool
        Which sides of the plane (top, bottom, left, right) are sides of the frame. At the others a rim as
        wide as the reach of the blur will be cut off: what lies beyond them need not be solved for.

    Raises
    ------
    InvalidInputError
        If `clip` is no positive level.
    """

    noise: NoiseModel = field(default_factory=lambda: NoiseModel.white(0.005))
    clip: float = float("inf")
    measured: Mask | None = None
    edges: tuple[bool, bool, bool, bool] = (True, True, True, True)

    def __post_init__(self) -> None:
        if not self.clip > 0.0:
            raise InvalidInputError(f"clip must be a positive level, got {self.clip}")

    @property
    def surrounded(self) -> bool:
        """Whether no side of the plane is one of the frame."""
        return not any(self.edges)

    def variance(self, plane: NDArray[np.floating]) -> Real:
        """Variance of the noise at each pixel of linear light."""
        return self.noise.variance(plane).astype(np.float32)


class Deconvolver(Protocol):
    """Non-blind deconvolution of one plane: step 3 of Hirsch and Schölkopf (ICCV 2015, section 7)."""

    def deconvolve(self, blurred: Plane, blur: UniformBlur, *, sensor: Sensor) -> Plane:
        """Estimate the latent plane.

        Parameters
        ----------
        blurred : Plane, shape (H, W), float32
            Linear light, as the photo shows it.
        blur : UniformBlur
            From the latent plane, which is wider than the frame by the reach of the blur, onto the frame.
        sensor : Sensor
            Noise, clipping, and which pixels were measured.

        Returns
        -------
        Plane, shape (H, W), float32
            The latent plane inside the frame, in linear light.
        """


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Planes that were restored together, and the light that a prior took of the data, if there is one."""

    planes: Planes
    unexplained: Planes | None = None


@runtime_checkable
class ColourDeconvolver(Protocol):
    """A deconvolver that restores the three planes together, one from the other."""

    def deconvolve_planes(
        self, blurred: Planes, blurs: Sequence[UniformBlur], sensors: Sequence[Sensor]
    ) -> Solution:
        """Estimate the latent planes inside the frame, with a blur and a sensor for each channel."""


def restore_planes(
    method: Deconvolver, blurred: Planes, blurs: Sequence[UniformBlur], sensors: Sequence[Sensor]
) -> Solution:
    """Restore planes: together if the method can, else one by one."""
    if isinstance(method, ColourDeconvolver):
        return method.deconvolve_planes(blurred, blurs, sensors)
    colours = zip(blurred, blurs, sensors, strict=True)
    return Solution(np.stack([method.deconvolve(y, blur, sensor=sensor) for y, blur, sensor in colours]))
