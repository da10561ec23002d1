"""What several questions and answers have in common: names, ids, quantities with their bounds, problems."""

from __future__ import annotations

from typing import Annotated, Final, Literal, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
)

MAX_PSF_SIZE = 255
"""Side of a kernel in pixels at most (chosen): that of a profile."""

MAX_VERSION: Final = 2**31 - 1
"""The largest number of an INTEGER column of PostgreSQL."""


def blank_is_none(value: object) -> object:
    """Take an empty field of a form for one that was left out."""
    return None if isinstance(value, str) and not value.strip() else value


def _printable(value: str) -> str:
    if not value.isprintable():
        raise ValueError("must not hold control characters")
    return value.strip()


def _odd(value: int) -> int:
    if value % 2 == 0:
        raise ValueError(f"must be odd, so that there is a middle pixel: {value - 1} or {value + 1}")
    return value


PsfModel = Literal["default", "paper"]
"""How a lens is learned and its photos are corrected: names of `lensmodel.workflow.sampling`."""


Name = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_printable)]


OptionalName = Annotated[Name | None, BeforeValidator(blank_is_none)]


Id = Annotated[str, Field(min_length=1, max_length=40, pattern=r"^[A-Za-z0-9_-]+$")]


OptionalId = Annotated[Id | None, BeforeValidator(blank_is_none)]


Aperture = Annotated[float, Field(ge=0.5, le=128, allow_inf_nan=False, description="f-number")]


FocalLength = Annotated[float, Field(ge=0.1, le=20000, allow_inf_nan=False, description="mm")]


FocusDistance = Annotated[float, Field(ge=0.001, le=1e9, allow_inf_nan=False, description="m")]


PixelPitch = Annotated[float, Field(gt=0.1, le=1000, allow_inf_nan=False, description="micrometres")]


KernelSize = Annotated[
    int, Field(ge=3, le=MAX_PSF_SIZE, description="odd side in pixels"), AfterValidator(_odd)
]


class Model(BaseModel):
    """Common to what we send."""

    model_config = ConfigDict(frozen=True, ser_json_inf_nan="null", protected_namespaces=())


class Question(BaseModel):
    """Common to what we are sent: a name that we do not know is an error, and not ignored."""

    model_config = ConfigDict(frozen=True, extra="forbid", protected_namespaces=())

    @field_validator("*", mode="before")
    @classmethod
    def _true_is_no_number(cls, value: object, info: ValidationInfo) -> object:
        kind = cls.model_fields[str(info.field_name)].annotation
        if isinstance(value, bool) and bool not in {kind, *get_args(kind)}:
            raise ValueError(f"{str(value).lower()} is no value of this field")
        return value


class FieldError(Model):
    """One offending field."""

    field: str
    message: str
    value: str | None = None


class Problem(Model):
    """Why something did not work (RFC 9457)."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    code: str = Field(description="Fixed word by which programs tell the cases apart.")
    instance: str | None = None
    errors: list[FieldError] = []
    request_id: str | None = None
    candidates: list[str] | None = Field(default=None, description="Lenses that the photo may belong to.")
