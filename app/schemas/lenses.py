"""Lenses as they cross HTTP."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from app.schemas.fields import Model, PsfModel

SerialSource = Literal["exif", "makernote", "xmp", "user", "none"]


class LensLinks(Model):
    """Where to go from a lens."""

    self: str
    psf: str
    field: str
    calibrations: str
    lateral_colour: str
    photos: str


class LensOut(Model):
    """One copy of a lens and what is known of it."""

    id: str
    maker: str | None
    model: str | None
    serial: str | None
    serial_source: SerialSource
    label: str | None
    psf_model: PsfModel = Field(
        default="default",
        description="how it is learned and its photos are corrected, as `PATCH` with `model` chooses",
    )
    answering_model: PsfModel = Field(
        default="default",
        description="the one that answers now: that of before until all photos are estimated anew",
    )
    version: int
    photos: int
    samples: int
    apertures: list[float]
    focal_lengths_mm: list[float]
    created_at: datetime
    links: LensLinks


class CalibrationOut(Model):
    """One version of a lens: what changed, and how good the model was then."""

    version: int
    kind: str
    photo_id: str | None
    samples_added: int
    samples: int
    photos: int
    model: PsfModel = Field(default="default", description="the one that this version answers with")
    error: dict[str, Any] | float | None = Field(description="held-out error; null until it is measured")
    coverage: dict[str, Any] | None
    created_at: datetime


class LateralOut(Model):
    """Lateral colour of a lens: what a point shown by green at r is shown at by red and blue.

    The polynomials are (a, b, c, v) of r_src = r (v + c r + b r^2 + a r^3), with r in half
    diagonals; (0, 0, 0, 1) is no shift.
    """

    lens_id: str
    version: int
    photos: int
    red: tuple[float, float, float, float]
    blue: tuple[float, float, float, float]


class LensPage(Model):
    """Some lenses, newest first."""

    items: list[LensOut]
    next: str | None


class CalibrationPage(Model):
    """Some versions of a lens, oldest first."""

    items: list[CalibrationOut]
    next: str | None
