"""What tasks answer, checked as untrusted input: a hostile photo may have taken the child over.

Numbers are bounded by what columns and pages can hold, texts are cut, and lists bounded. Kernels are checked
by `app.jobs.sample_files`.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from app.jobs.context import JobFailedError

Text = Annotated[str, BeforeValidator(lambda text: text[:200] if isinstance(text, str) else text)]
Quantity = Annotated[float, Field(ge=0, le=1e9)]
Share = Annotated[float, Field(ge=0, le=1.0001)]
Count = Annotated[int, Field(ge=0, le=10_000_000)]
Pixel = Annotated[int, Field(ge=-100_000, le=1_000_000)]
Zone = Literal["center", "mid", "corner"]
Polynomial = Annotated[list[float], Field(min_length=4, max_length=4)]
A = TypeVar("A", bound="Answer")


class Answer(BaseModel):
    """Common to all: JSON of exactly these types; further fields are dropped."""

    model_config = ConfigDict(strict=True, frozen=True, extra="ignore", allow_inf_nan=False)


class Lens(Answer):
    """Which lens a header names."""

    maker: Text | None
    model: Text | None
    serial: Text | None
    serial_source: Literal["exif", "makernote", "xmp", "user", "none"]


class Metadata(Answer):
    """What a header says."""

    camera_maker: Text | None
    camera_model: Text | None
    body_serial: Text | None = None
    lens: Lens
    aperture: Quantity | None
    focal_mm: Quantity | None
    focus_m: Annotated[float, Field(ge=-1, le=1e9)] | None
    orientation: Annotated[int, Field(ge=1, le=8)]
    pixel_pitch_um: Quantity | None


class Inspected(Answer):
    """Answer of `inspect`."""

    kind: Annotated[str, Field(max_length=20)]
    width: Annotated[int, Field(ge=1, le=1_000_000)]
    height: Annotated[int, Field(ge=1, le=1_000_000)]
    metadata: Metadata


class Window(Answer):
    """A square of a photo, in pixels and as a field position."""

    row: Pixel
    col: Pixel
    size: Annotated[int, Field(ge=1, le=10_000)]
    r: Annotated[float, Field(ge=0, le=2)]
    phi: Annotated[float, Field(ge=-4, le=4)]


class ChosenPatch(Window):
    """A patch to estimate."""

    score: Annotated[float, Field(ge=-1e9, le=1e9)]
    cell: Annotated[int, Field(ge=0, le=100_000)]


class RejectedWindow(Window):
    """A window that was looked at and left out, and why."""

    rejected: Annotated[str, Field(max_length=60)]


class Lateral(Answer):
    """Lateral colour."""

    red: Polynomial
    blue: Polynomial
    half_diagonal: Quantity
    red_points: Count
    blue_points: Count


class Selected(Answer):
    """Answer of `select`."""

    patches: Annotated[list[ChosenPatch], Field(max_length=2000)]
    rejected: Annotated[list[RejectedWindow], Field(max_length=100_000)]
    lateral: Lateral | None


class ZoneGain(Answer):
    """What a correction is expected to have done in one zone."""

    cells: Count = 0
    expected_gain_db: float | None = None
    psf_error: float | None = None
    left: Count = 0
    held_back: Share = 0.0
    reasons: Annotated[list[Text], Field(max_length=20)] = []


class ZoneAudit(Answer):
    """What the audit held back in one zone."""

    tiles: Count
    tiles_held: Count
    held_back: Share
    checks: Annotated[dict[Text, Share], Field(max_length=20)]


class Held(Answer):
    """A tile with something held back."""

    row: Pixel
    col: Pixel
    held_back: Share


class Audit(Answer):
    """What the audit held back, and where."""

    zones: dict[Zone, ZoneAudit]
    tiles: Annotated[list[Held], Field(max_length=100_000)] = []
    tile_side: Count = 0


class Report(Answer):
    """Report of a correction."""

    zones: dict[Zone, ZoneGain]
    nothing_to_correct: bool = False
    audit: Audit | None = None


class Corrected(Answer):
    """Answer of `correct`; the file is looked for by its name alone."""

    file: Text
    report: Report


class Measured(Answer):
    """Answer of `measure`."""

    error: dict[Zone, float | None] | None
    coverage: dict[Zone, Count] | None


class ReadProfile(Answer):
    """Answer of `profile`."""

    mode: Annotated[str, Field(max_length=20)]
    samples: Annotated[int, Field(ge=1, le=200_000)]
    photos: Annotated[dict[Text, Text], Field(max_length=100_000)]
    lens: Annotated[dict[Text, Text], Field(max_length=100)]


def checked(kind: type[A], answer: Any) -> dict[str, Any]:  # noqa: ANN401 - a child's JSON
    """Return the answer of a task as JSON of this kind."""
    try:
        return kind.model_validate(answer).model_dump(exclude_unset=True)
    except (ValidationError, RecursionError) as error:
        where = error.errors(include_input=False)[0]["loc"] if isinstance(error, ValidationError) else ()
        place = ".".join(map(str, where))[:100]
        text = f"the work gave no {kind.__name__.lower()} photo (at {place or 'its top'}); report the file"
        raise JobFailedError("internal_error", text) from error
