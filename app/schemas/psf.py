"""PSFs and maps of them as they cross HTTP."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from app.schemas.fields import (
    MAX_VERSION,
    Aperture,
    FocalLength,
    FocusDistance,
    KernelSize,
    Model,
    PsfModel,
    Question,
)
from lensmodel.core.types import Channel


class PsfQuery(Question):
    """Where and how to ask for a PSF."""

    r: float = Field(ge=0, le=1, allow_inf_nan=False, description="half diagonals: 0 centre, 1 corner")
    phi: float = Field(
        0.0, ge=-100, le=100, allow_inf_nan=False, description="radians, counter-clockwise from the right"
    )
    aperture: Aperture | None = None
    channel: Channel = "g"
    size: KernelSize = 55
    focal_length_mm: FocalLength | None = None
    focus_distance_m: FocusDistance | None = None
    pixel_pitch_um: float | None = Field(
        None,
        gt=0.1,
        le=100,
        allow_inf_nan=False,
        description="pixel of the answer; that of most photos by default",
    )
    version: int | None = Field(None, ge=1, le=MAX_VERSION, description="an earlier version of the lens")
    strict: bool = Field(default=False, description="refuse answers outside what the samples cover")


class KernelOut(Model):
    """A kernel: row 0 is the top, the sum is 1, the centre of mass on the middle pixel."""

    shape: tuple[int, int]
    dtype: Literal["float32"]
    data: list[list[float]]


class QueryOut(Model):
    """The question as it was understood."""

    r: float
    phi: float
    aperture: float | None
    channel: Channel
    size: int
    focal_length_mm: float | None
    focus_distance_m: float | None


class Support(Model):
    """What an answer rests on."""

    effective_samples: float
    photos: int
    extrapolated: bool
    beyond: list[str] = Field(
        default_factory=list, description="in which variables it lies outside the samples"
    )
    predicted_error: float | None
    model: PsfModel = Field(default="default", description="the model of the lens that answered")
    answered_by: str = Field(
        description="what made the answer: network, regression, network and regression, or paper; the "
        "numbers here are of that"
    )
    weights: str = Field(default="", description="fingerprint of the network's weights")
    nearest: float = Field(
        default=0.0,
        description="distance to the nearest sample: 1 is a fifth of the half diagonal, a stop, or half an "
        "octave of focal length",
    )


class Units(Model):
    """Units of the answer."""

    r: str = "half-diagonal"
    phi: str = "radian"
    pixel_pitch_um: float | None


class PsfOut(Model):
    """The PSF of a lens at one place and setting."""

    lens_id: str
    version: int
    query: QueryOut
    psf: KernelOut
    support: Support
    bandwidth: dict[str, float]
    units: Units


class FieldQuery(Question):
    """What a field map shows."""

    aperture: Aperture | None = None
    channel: Channel = "g"
    grid: str = Field("9x6", pattern=r"^\d{1,2}x\d{1,2}$", description="columns x rows, at most 25 x 25")
    size: KernelSize = 55
    aspect: float = Field(
        1.5, ge=0.2, le=5, allow_inf_nan=False, description="width over height of the picture"
    )
    view: str = Field(
        "0,0,1,1",
        pattern=r"^(0|1|0?\.\d{1,6})(,(0|1|0?\.\d{1,6})){3}$",
        description="part of the picture that is shown: left, top, width and height as shares of it",
    )
    version: int | None = Field(None, ge=1, le=MAX_VERSION, description="an earlier version of the lens")
    gamma: float = Field(0.5, ge=0.1, le=2, allow_inf_nan=False, description="brightness ~ value^gamma")
    focal_length_mm: FocalLength | None = None
    focus_distance_m: FocusDistance | None = None
