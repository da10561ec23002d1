"""Photos as they cross HTTP."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from app.schemas.fields import (
    Aperture,
    FocalLength,
    FocusDistance,
    Id,
    Model,
    Name,
    OptionalId,
    OptionalName,
    PixelPitch,
    Problem,
    PsfModel,
    Question,
    blank_is_none,
)

MeasurementKind = Literal["target", "pair", "points", "edges"]
PhotoState = Literal[
    "received",
    "inspecting",
    "developing",
    "selecting",
    "estimating",
    "counted",
    "stored",
    "needs_lens",
    "excluded",
    "failed",
    "cancelled",
]


class UploadFields(Question):
    """What an owner may say about a photo.

    The lens that it names goes before that of the file; a setting counts where the file says none.
    """

    calibrate: bool = Field(default=True, description="false only stores the photo to correct it")
    kind: Annotated[MeasurementKind | None, BeforeValidator(blank_is_none)] = Field(
        default=None, description="what a photo made to measure the lens shows; nothing for ordinary photos"
    )
    reference_id: OptionalId = Field(default=None, description="of a pair: the photo closed to about f/8")
    model: Annotated[PsfModel | None, BeforeValidator(blank_is_none)] = Field(
        default=None,
        description="of a new lens: how it is learned, default or the paper's own way; a lens that is there "
        "must have it already",
    )
    selector: OptionalName = Field(
        default=None,
        description="who chooses its patches, one of GET /v1/formats; else whom the service has",
    )
    lens_id: OptionalId = None
    lens_serial: OptionalName = None
    lens_model: OptionalName = None
    lens_maker: OptionalName = None
    aperture: Annotated[Aperture | None, BeforeValidator(blank_is_none)] = None
    focal_length_mm: Annotated[FocalLength | None, BeforeValidator(blank_is_none)] = None
    focus_distance_m: Annotated[FocusDistance | None, BeforeValidator(blank_is_none)] = None
    pixel_pitch_um: Annotated[PixelPitch | None, BeforeValidator(blank_is_none)] = None


class NewLens(Question):
    """A lens that only its owner can tell from others."""

    label: Name


class PhotoChange(Question):
    """What to change about a photo; at least one field. It goes before what the file says."""

    lens_id: Id | None = None
    lens_serial: Name | None = None
    lens_model: Name | None = None
    lens_maker: Name | None = None
    new_lens: NewLens | None = None
    aperture: Aperture | None = None
    focal_length_mm: FocalLength | None = None
    focus_distance_m: FocusDistance | None = None
    pixel_pitch_um: PixelPitch | None = None
    excluded: bool | None = None
    calibrate: bool | None = Field(
        None, description="true: learn the lens from a photo that was stored without"
    )


class PhotosChange(Question):
    """What to say of several photos at once: which lens it was, and at which settings."""

    photo_ids: list[Id] = Field(min_length=1, max_length=1000)
    lens_id: Id | None = None
    new_lens: NewLens | None = None
    aperture: Aperture | None = None
    focal_length_mm: FocalLength | None = None


class PatchCounts(Model):
    """How far the patches of a photo are."""

    total: int
    done: int
    rejected: int


class PhotoLinks(Model):
    """Where to go from a photo."""

    self: str
    job: str
    lens: str | None


class PhotoOut(Model):
    """A photo."""

    id: str
    filename: str
    sha256: str
    state: PhotoState
    calibrate: bool
    lens_id: str | None
    aperture: float | None
    focal_length_mm: float | None
    focus_distance_m: float | None
    pixel_pitch_um: float | None
    camera: str | None
    lens_model: str | None
    width: int | None
    height: int | None
    kind: MeasurementKind | None = Field(
        default=None, description="what a photo made to measure the lens shows"
    )
    reference_id: str | None = Field(default=None, description="of a pair: the photo closed to about f/8")
    patches: PatchCounts
    error: Problem | None
    created_at: datetime
    links: PhotoLinks


class PatchOut(Model):
    """One window of a photo, used or rejected."""

    index: int
    row: int
    col: int
    size: int
    r: float
    phi: float
    score: float | None
    state: str
    reason: str | None


class PhotoPage(Model):
    """Some photos, newest first."""

    items: list[PhotoOut]
    next: str | None


class PatchPage(Model):
    """The patches of a photo."""

    items: list[PatchOut]
    next: str | None = None
