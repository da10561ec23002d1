"""Corrections as they cross HTTP."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from app.schemas.fields import MAX_VERSION, Id, Model, Problem, Question

CorrectionState = Literal["queued", "running", "succeeded", "failed", "cancelled"]


OutputFormat = Literal["tiff16", "png16", "png8", "jpeg", "dng"]


ColorSpace = Literal["same", "srgb", "camera-linear"]


class OutputOptions(Question):
    """How a corrected photo is written."""

    format: OutputFormat = "tiff16"
    color_space: ColorSpace = "same"
    quality: int = Field(default=95, ge=1, le=100, description="of JPEG")


class Region(Question):
    """A part of a photo in pixels of the sensor orientation."""

    x: int = Field(ge=0)
    y: int = Field(ge=0)
    width: int = Field(ge=1)
    height: int = Field(ge=1)


class CorrectionIn(Question):
    """What to correct, with what, into what."""

    photo_id: Id
    lens_id: Id | None = Field(None, description="default: the lens of the photo")
    lens_version: int | None = Field(None, ge=1, le=MAX_VERSION, description="default: the newest")
    any_lens: bool = Field(default=False, description="also where the photo seems to be of another lens")
    method: str | None = Field(
        None,
        min_length=1,
        max_length=60,
        description="default: standard, and paper where the model of the lens is that of the paper",
    )
    strength: float = Field(1.0, ge=0, le=1, allow_inf_nan=False)
    halo: float | None = Field(
        None,
        ge=0,
        allow_inf_nan=False,
        description="how far beside edges to leave the range of light around; default: by the model's error",
    )
    texture: float = Field(
        1.0, ge=0, le=1, allow_inf_nan=False, description="how much of its faint texture the photo keeps"
    )
    denoise: float = Field(
        0.0, ge=0, le=1, allow_inf_nan=False, description="how much of the photo's grain to take away"
    )
    output: OutputOptions = OutputOptions()
    roi: Region | None = None
    layers: bool = Field(
        default=False,
        description="with roi: keep it without faint texture and without grain as well, for a preview to mix",
    )


class CorrectionLinks(Model):
    """Where to go from a correction."""

    self: str
    job: str
    result: str | None


class CorrectionOut(Model):
    """A correction."""

    id: str
    photo_id: str
    lens_id: str
    lens_version: int
    state: CorrectionState
    method: str
    strength: float
    output: dict[str, Any]
    roi: dict[str, Any] | None
    report: dict[str, Any] | None
    error: Problem | None
    created_at: datetime
    finished_at: datetime | None
    links: CorrectionLinks


class CorrectionPage(Model):
    """Some corrections, newest first."""

    items: list[CorrectionOut]
    next: str | None
