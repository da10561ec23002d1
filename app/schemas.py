"""What crosses HTTP: one model for each question and answer; units and bounds sit in the fields."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Final, Generic, Literal, Self, TypeVar, get_args

from pydantic import (
    AfterValidator,
    AliasPath,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    computed_field,
    field_validator,
)

from app.distances import INFINITY
from lensmodel.core.types import Channel

V1: Final = "/v1"
Links = dict[str, str | None]  # addresses by what is there
T = TypeVar("T")

MAX_PSF_SIZE = 255  # side of a kernel in pixels at most (chosen): that of a profile
MAX_VERSION: Final = 2**31 - 1  # the largest number of an INTEGER column of PostgreSQL


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


Name = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_printable)]
OptionalName = Annotated[Name | None, BeforeValidator(blank_is_none)]
Id = Annotated[str, Field(min_length=1, max_length=40, pattern=r"^[A-Za-z0-9_-]+$")]
Aperture = Annotated[float, Field(ge=0.5, le=128, description="f-number")]
FocalLength = Annotated[float, Field(ge=0.1, le=20000, description="mm")]
FocusDistance = Annotated[float, Field(ge=0.001, le=1e9, description="m")]
PixelPitch = Annotated[float, Field(gt=0.1, le=1000, description="micrometres")]
KernelSize = Annotated[int, Field(ge=3, le=MAX_PSF_SIZE, description="odd side"), AfterValidator(_odd)]


# Where the row of a table has what we send: under its own name unless an alias says otherwise
PublicId = Annotated[str, Field(validation_alias="public_id")]
FocusM = Annotated[float | None, BeforeValidator(lambda stored: None if stored == INFINITY else stored)]


class Model(BaseModel):
    """Common to what we send: made of a row of a table, by the service, or of JSON, by its client."""

    model_config = ConfigDict(
        frozen=True,
        from_attributes=True,
        validate_by_alias=True,
        validate_by_name=True,
        json_schema_serialization_defaults_required=True,
        ser_json_inf_nan="null",
        protected_namespaces=(),
    )

    @classmethod
    def of(cls, row: object, **more: object) -> Self:
        """Describe a row; `more` is what no column says."""
        return cls.model_validate(row, by_name=False).model_copy(update=more)


class Page(Model, Generic[T]):
    """Some of many, and where the next ones are."""

    items: list[T]
    next: str | None = None


class Question(BaseModel):
    """Common to what we are sent: a name that we do not know is an error, and not ignored."""

    model_config = ConfigDict(frozen=True, extra="forbid", protected_namespaces=(), allow_inf_nan=False)

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


MeasurementKind = Literal["target", "pair", "points", "edges"]
Working = Literal["received", "inspecting", "developing", "selecting", "estimating"]
Ended = Literal["counted", "stored", "excluded", "failed", "cancelled"]
PhotoState = Literal[Working, "needs_lens", Ended]


class Taken(Question):
    """With which lens a photo was taken, and at which settings."""

    aperture: Aperture | None = None
    focal_length_mm: FocalLength | None = None
    focus_distance_m: FocusDistance | None = None
    pixel_pitch_um: PixelPitch | None = None
    lens_id: Id | None = None
    lens_serial: Name | None = None
    lens_model: Name | None = None
    lens_maker: Name | None = None


class UploadFields(Taken):
    """What an owner may say of a photo: its lens goes before that of the file, settings after them."""

    calibrate: bool = Field(default=True, description="false only stores the photo to correct it")
    kind: MeasurementKind | None = Field(
        None, description="what it shows, if it was made to measure the lens"
    )
    reference_id: Id | None = Field(None, description="of a pair: the photo closed to about f/8")
    selector: Name | None = Field(None, description="who chooses its patches: one of GET /v1/formats")

    @field_validator("*", mode="before")
    @classmethod
    def _left_out_if_blank(cls, value: object) -> object:
        return blank_is_none(value)


class NewLens(Question):
    """A lens that only its owner can tell from others."""

    label: Name = Field(description="what its owner calls it")


class PhotoChange(Taken):
    """What to change about a photo; at least one field. It goes before what the file says."""

    new_lens: NewLens | None = None
    excluded: bool | None = None
    calibrate: bool | None = Field(None, description="true: learn the lens from a photo that was only stored")


class PhotosChange(Taken):
    """What to say of several photos at once: which lens it was, and at which settings."""

    photo_ids: list[Id] = Field(min_length=1, max_length=1000)
    new_lens: NewLens | None = None


class PatchCounts(Model):
    """How far the patches of a photo are."""

    total: int = 0
    done: int = 0
    rejected: int = 0


class PhotoOut(Model):
    """A photo."""

    id: PublicId
    filename: str
    sha256: str
    state: PhotoState
    calibrate: bool
    lens_id: str | None = Field(None, validation_alias=AliasPath("lens", "public_id"))
    aperture: float | None
    focal_length_mm: float | None = Field(validation_alias="focal_mm")
    focus_distance_m: FocusM = Field(validation_alias="focus_m")
    pixel_pitch_um: float | None
    lens_model: str | None
    width: int | None
    height: int | None
    kind: MeasurementKind | None = Field(None, validation_alias=AliasPath("given", "kind"))
    reference_id: str | None = Field(None, validation_alias=AliasPath("given", "reference_id"))
    patches: PatchCounts = PatchCounts()
    error: Problem | None = None
    created_at: datetime = Field(validation_alias="received_at")

    @computed_field  # type: ignore[prop-decorator]  # as pydantic documents it
    @property
    def links(self) -> Links:
        """Where to go from here."""
        lens = None if self.lens_id is None else f"{V1}/lenses/{self.lens_id}"
        return {"self": f"{V1}/photos/{self.id}", "job": f"{V1}/jobs/{self.id}", "lens": lens}


class PatchOut(Model):
    """A window of a photo, used or not: top left pixel and side; its middle in half diagonals and radians."""

    index: int = Field(validation_alias="idx")
    row: int
    col: int
    size: int
    r: float
    phi: float
    score: float | None
    state: str
    reason: str | None


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
    method: str = Field("standard", min_length=1, max_length=60)
    strength: float = Field(1.0, ge=0, le=1)
    halo: float | None = Field(None, ge=0, description="how far edges may overshoot; default: by the lens")
    texture: float = Field(1.0, ge=0, le=1, description="how much of its faint texture the photo keeps")
    denoise: float = Field(0.0, ge=0, le=1, description="how much of the photo's grain to take away")
    output: OutputOptions = OutputOptions()
    roi: Region | None = None
    layers: bool = Field(default=False, description="of a roi: without texture and grain too, for a preview")
    nonce: Id | None = Field(
        None, description="any word: with another one, the request is another correction"
    )


class CorrectionOut(Model):
    """A correction."""

    id: PublicId
    photo_id: str = Field(validation_alias=AliasPath("photo", "public_id"))
    lens_id: str = Field(validation_alias="lens_public_id")
    lens_version: int
    state: CorrectionState
    method: str = Field(validation_alias=AliasPath("params", "method"))
    strength: float = Field(validation_alias=AliasPath("params", "strength"))
    output: dict[str, Any] = Field(validation_alias=AliasPath("params", "output"))
    roi: dict[str, Any] | None = Field(validation_alias=AliasPath("params", "roi"))
    report: dict[str, Any] | None
    error: Problem | None = None
    created_at: datetime
    finished_at: datetime | None

    @computed_field  # type: ignore[prop-decorator]  # as pydantic documents it
    @property
    def links(self) -> Links:
        """Where to go from here."""
        own = f"{V1}/corrections/{self.id}"
        result = f"{own}/result" if self.state == "succeeded" else None
        return {"self": own, "job": f"{V1}/jobs/{self.id}", "result": result}


JobState = Literal["queued", "running", "waiting", "succeeded", "failed", "cancelled"]


class JobProgress(Model):
    """How far a job is."""

    done: int
    total: int
    unit: str


class JobOut(Model):
    """Background work: of a photo or of a correction; its id is that of what it makes."""

    id: str
    kind: Literal["photo", "correction", "rebuild"]
    state: JobState
    stage: str | None
    progress: JobProgress
    eta_seconds: float | None
    attempt: int
    error: Problem | None
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    links: Links


SerialSource = Literal["exif", "makernote", "xmp", "user", "none"]


class LensOut(Model):
    """One copy of a lens and what is known of it."""

    id: PublicId
    maker: str | None
    model: str | None
    serial: str | None
    serial_source: SerialSource
    label: str | None
    version: int
    photos: int = Field(validation_alias="photo_count")
    samples: int = Field(validation_alias="sample_count")
    apertures: list[float] = []
    focal_lengths_mm: list[float] = []
    created_at: datetime

    @computed_field  # type: ignore[prop-decorator]  # as pydantic documents it
    @property
    def links(self) -> Links:
        """Where to go from here."""
        own, photos = f"{V1}/lenses/{self.id}", f"{V1}/photos?lens_id={self.id}"
        parts = {"psf": "psf", "field": "field.png", "calibrations": "calibrations"}
        parts["lateral_colour"] = "lateral-colour"
        return {"self": own, **{name: f"{own}/{part}" for name, part in parts.items()}, "photos": photos}


class LensChange(Question):
    """What to change about a lens: one of these."""

    label: Name | None = Field(None, description="what its owner calls it; null takes the name away")
    merge_into: Id | None = Field(None, description="the lens that this one is a part of")
    any_lens: bool = Field(default=False, description="merge lenses too that seem to be two")


class CalibrationOut(Model):
    """One version of a lens: what changed, and the held-out error of its model once that is measured."""

    version: int
    kind: str
    photo_id: str | None = Field(validation_alias="photo_public_id")
    samples_added: int
    samples: int
    photos: int
    error: dict[str, Any] | None = Field(None, validation_alias=AliasPath("metrics", "error"))
    coverage: dict[str, Any] | None = Field(None, validation_alias=AliasPath("metrics", "coverage"))
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


class Setting(Question):
    """At which settings, in which colour and of which version PSFs are asked for, and how large."""

    aperture: Aperture | None = None
    channel: Channel = "g"
    size: KernelSize = 55
    focal_length_mm: FocalLength | None = None
    focus_distance_m: FocusDistance | None = None
    version: int | None = Field(None, ge=1, le=MAX_VERSION, description="an earlier version of the lens")


class PsfQuery(Setting):
    """Where and how to ask for a PSF."""

    r: float = Field(ge=0, le=1, description="half diagonals: 0 centre, 1 corner")
    phi: float = Field(0.0, ge=-100, le=100, description="radians, counter-clockwise from the right")
    pixel_pitch_um: float | None = Field(None, gt=0.1, le=100, description="default: that of most photos")
    strict: bool = Field(default=False, description="refuse answers outside what the samples cover")


class KernelOut(Model):
    """A kernel: row 0 is the top, the sum is 1, the centre of mass on the middle pixel."""

    shape: tuple[int, int]
    dtype: Literal["float32"]
    data: list[list[float]]


class Support(Model):
    """What an answer rests on."""

    effective_samples: float
    photos: int
    extrapolated: bool
    predicted_error: float | None
    weights: str = Field("", description="fingerprint of the network's weights, empty where none took part")


class Units(Model):
    """Units of the answer."""

    r: str = "half-diagonal"
    phi: str = "radian"
    pixel_pitch_um: float | None


class PsfOut(Model):
    """The PSF of a lens at one place and setting."""

    lens_id: str
    version: int
    query: PsfQuery = Field(description="the question as it was understood")
    psf: KernelOut
    support: Support
    units: Units


class FieldQuery(Setting):
    """What a field map shows."""

    grid: str = Field("9x6", pattern=r"^\d{1,2}x\d{1,2}$", description="columns x rows, at most 25 x 25")
    aspect: float = Field(1.5, ge=0.2, le=5, description="width over height of the picture")


class Readiness(Model):
    """Whether work can be taken, and what is missing."""

    status: Literal["ready", "not ready"]
    checks: dict[str, str]
    sandbox: dict[str, bool] = Field(description="which measures confine what decodes photos")


class SignIn(Question):
    """The key with which a browser signs in."""

    key: Annotated[str, Field(min_length=1, max_length=200)]


class AccountOut(Model):
    """Who asks, what he may and has, and may have."""

    owner: str
    scopes: list[Literal["read", "write", "admin"]]
    signed_in: bool = Field(description="whether by a key: nobody needs one on a service of one owner")
    photos: int
    max_photos: int
    stored_bytes: int
    max_stored_bytes: int
    lenses: int
    corrections: int
    created_at: datetime | None
