"""What workers and their tasks exchange: names of files, and answers.

Answers are checked as untrusted input: a hostile photo may have taken the child over. Numbers are bounded by
what columns and pages can hold, texts are cut, and lists bounded; further fields are dropped. Kernels are
checked by `app.jobs.sample_files`.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import GenericAlias
from typing import Annotated, Any, Final, Literal, TypeAlias, cast

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, create_model

KERNELS: Final = "kernels.npy"  # kernels, one a row: `(n, k, k)`
SAMPLES: Final = "samples.json"  # position, settings, weight and origin of each kernel
ENCODED: Final = "encoded.npy"  # what patches say without a kernel, one a row
CLEANED: Final = "cleaned"  # the file of a photo without the place where it was taken
REPORT: Final = "report.json"  # the report of a lens test
# Small picture of a photo before it is developed; stored ones too
THUMBNAIL: Final = "glance.jpg"
SHOWN: Final = "shown.tiles"  # the developed photo in full size, by `app.blobs.tiles`
# A whole photo before and after its correction, by `app.blobs.tiles`
SIDES: Final[Mapping[str, str]] = {"before": "before.tiles", "after": "after.tiles"}
# A part of a photo before and after its correction; for sliders also without texture or grain
LAYER_FILES: Final[Mapping[str, str]] = {
    "before": "before.png",
    "after": "after.png",
    "smooth": "smooth.png",
    "clean": "clean.png",
}
# Ending of a corrected file, by its format
SUFFIX: Final[Mapping[str, str]] = {
    "tiff16": ".tif",
    "png16": ".png",
    "png8": ".png",
    "jpeg": ".jpg",
    "dng": ".dng",
}

Text = Annotated[str, BeforeValidator(lambda text: text[:200] if isinstance(text, str) else text)]
Quantity = Annotated[float, Field(ge=0, le=1e9)]
Share = Annotated[float, Field(ge=0, le=1.0001)]
Count = Annotated[int, Field(ge=0, le=10_000_000)]
Side = Annotated[int, Field(ge=1, le=1_000_000)]
Pixel = Annotated[int, Field(ge=-100_000, le=1_000_000)]
Zone = Literal["center", "mid", "corner"]
Polynomial = Annotated[list[float], Field(min_length=4, max_length=4)]
Answer: TypeAlias = type[BaseModel]


class JobFailedError(Exception):
    """A job cannot be done, and a retry would not help: a fixed code and a sentence for its owner."""

    def __init__(self, code: str, detail: str) -> None:
        super().__init__(detail)
        self.code, self.detail = code, detail


class NotWantedError(Exception):
    """The job was cancelled, or its photo deleted or started anew: stop, and change nothing."""


class _Strict(BaseModel):
    """JSON of exactly the declared types."""

    model_config = ConfigDict(strict=True, frozen=True, extra="ignore", allow_inf_nan=False)


def _answer(name: str, **fields: Any) -> Any:  # noqa: ANN401 - a type that is made here
    """Make a type from its fields: of each the type, and in a pair with it the value where it is left out."""
    declared = {key: kind if isinstance(kind, tuple) else (kind, ...) for key, kind in fields.items()}
    return create_model(name, __base__=_Strict, **cast("dict[str, Any]", declared))


def _text(length: int) -> Any:  # noqa: ANN401 - as above
    return Annotated[str, Field(max_length=length)]


def _several(length: int, *kinds: Any) -> Any:  # noqa: ANN401 - as above
    """Make a list of a kind, or a dictionary of kinds of keys and values, of at most that length."""
    holder = GenericAlias(list if len(kinds) == 1 else dict, kinds)
    return Annotated[holder, Field(max_length=length)]


_LENS = _answer(
    "Lens",
    **dict.fromkeys(("maker", "model", "serial"), Text | None),
    serial_source=Literal["exif", "makernote", "xmp", "user", "none"],
)
_METADATA = _answer(
    "Metadata",
    **dict.fromkeys(("camera_maker", "camera_model"), Text | None),
    **dict.fromkeys(("aperture", "focal_mm", "pixel_pitch_um"), Quantity | None),
    body_serial=(Text | None, None),
    lens=_LENS,
    focus_m=Annotated[float, Field(ge=-1, le=1e9)] | None,
    orientation=Annotated[int, Field(ge=1, le=8)],
)
LOCATED: Answer = _answer("Search", location=Literal["none", "removed", "unknown"])
INSPECTED: Answer = _answer("Header", kind=_text(20), width=Side, height=Side, metadata=_METADATA)

_WINDOW: dict[str, Any] = {
    **dict.fromkeys(("row", "col"), Pixel),
    "size": Annotated[int, Field(ge=1, le=10_000)],
    "r": Annotated[float, Field(ge=0, le=2)],
    "phi": Annotated[float, Field(ge=-4, le=4)],
}
_PATCH = _answer(
    "Patch",
    **_WINDOW,
    score=Annotated[float, Field(ge=-1e9, le=1e9)],
    cell=Annotated[int, Field(ge=0, le=100_000)],
)
_REJECTED = _answer("Rejected", **_WINDOW, reason=_text(60))
_LATERAL = _answer(
    "Lateral",
    **dict.fromkeys(("red", "blue"), Polynomial),
    **dict.fromkeys(("red_points", "blue_points"), Count),
    half_diagonal=Quantity,
)
SELECTED: Answer = _answer(
    "Selection",
    patches=_several(2000, _PATCH),
    rejected=_several(100_000, _REJECTED),
    lateral=_LATERAL | None,
)

_GAIN = _answer(
    "ZoneGain",
    **dict.fromkeys(("cells", "left"), (Count, 0)),
    **dict.fromkeys(("expected_gain_db", "psf_error"), (float | None, None)),
)
_AUDIT = _answer("Audit", held_back=Share, checks=_several(20, Text, Share))
_REPORT = _answer(
    "Report", zones=_several(3, Zone, _GAIN), nothing_to_correct=(bool, False), audit=(_AUDIT | None, None)
)
CORRECTED: Answer = _answer(
    "Correction", file=Text, report=_REPORT
)  # the file is looked for by its name alone

MEASURED: Answer = _answer(
    "Measurement", error=dict[Zone, float | None] | None, coverage=dict[Zone, Count] | None
)
READ_PROFILE: Answer = _answer(
    "Profile",
    mode=_text(20),
    samples=Annotated[int, Field(ge=1, le=200_000)],
    photos=_several(100_000, Text, Text),
    lens=_several(100, Text, Text),
    cameras=_several(2, Text),
)


def checked(kind: Answer, answer: Any) -> dict[str, Any]:  # noqa: ANN401 - a child's JSON
    """Return the answer of a task as JSON of this kind."""
    try:
        return kind.model_validate(answer).model_dump(exclude_unset=True)
    except (ValidationError, RecursionError) as error:
        where = error.errors(include_input=False)[0]["loc"] if isinstance(error, ValidationError) else ()
        place = ".".join(map(str, where))[:100]
        text = f"the work gave no {kind.__name__.lower()} (at {place or 'its top'}); report the file"
        raise JobFailedError("internal_error", text) from error
