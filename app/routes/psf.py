"""The PSF of a lens at a place of the field, and maps of the whole field."""

from __future__ import annotations

import hashlib
from typing import Annotated, Final, Literal

from fastapi import APIRouter, Query, Response, status

from app.errors import InvalidParameterError, ServiceError
from app.http import psf_formats
from app.http.dependencies import Call, CallDep, OneSession
from app.http.model_cache import Fitted
from app.routes.common import NOT_CHANGED, Answers, file_answer, found, matches_tag, problems
from app.schemas import FieldQuery, PsfOut, PsfQuery
from lensmodel.core.errors import OutsideSupportError
from lensmodel.core.types import FieldPosition, LensSettings

router = APIRouter(tags=["psf"], route_class=OneSession)

Format = Literal["json", "png", "npy", "tiff"]
MEDIA_TYPES: Final[dict[Format, str]] = {
    "json": "application/json",
    "png": "image/png",
    "npy": "application/x-npy",
    "tiff": "image/tiff",
}
MAX_GRID: Final = 25  # columns and rows of a map at most (chosen): more kernels are too small to be looked at
# Pixels of all kernels of a map (chosen): 25 x 25 kernels of 55 pixels; with 255 pixels a map took 8.5 s
# (measured once, no command repeats it)
MAX_FIELD_PIXELS: Final = 2_000_000
_CONTENT = {
    name: {"schema": {"type": "string", "format": "binary"}}
    for name in MEDIA_TYPES.values()
    if "json" not in name
}
_HEADERS = {
    name: {"description": text, "schema": {"type": "string"}} for name, text in psf_formats.HEADERS.items()
}
_ANSWERS: Final[Answers] = {
    200: {"model": PsfOut, "content": _CONTENT, "description": "The PSF", "headers": _HEADERS},
    **NOT_CHANGED,
}


_PROPERTIES: Final = PsfQuery.model_json_schema()["properties"]
# Read by the route itself: for so many parameters FastAPI takes a third of the time of a request
_QUERY: Final = {
    "parameters": [
        {"name": name, "in": "query", "required": field.is_required(), "schema": _PROPERTIES[name]}
        for name, field in PsfQuery.model_fields.items()
    ]
}


@router.get(
    "/lenses/{lens_id}/psf",
    operation_id="getPsf",
    response_class=Response,
    responses=problems(406, also=_ANSWERS),
    openapi_extra=_QUERY,
)
def read_psf(lens_id: str, call: CallDep) -> Response:
    """Return the PSF in the format that `Accept` asks for; JSON by default."""
    return read_psf_as(lens_id, accepted(call.request.headers.get("accept", "*/*")), call)


@router.get(
    "/lenses/{lens_id}/psf.{suffix}",
    operation_id="getPsfAs",
    response_class=Response,
    responses=_ANSWERS,
    openapi_extra=_QUERY,
)
def read_psf_as(lens_id: str, suffix: Format, call: CallDep) -> Response:
    """Return the PSF in the format of the suffix."""
    at = PsfQuery.model_validate(dict(call.request.query_params))
    fitted, headers = _fitted(lens_id, at, call, suffix)
    if fitted is None:
        return Response(status_code=status.HTTP_304_NOT_MODIFIED, headers=headers)
    answer = fitted.model.query(
        FieldPosition(at.r, at.phi), _setting(at), at.size, pitch_um=at.pixel_pitch_um
    )
    if at.strict and answer.extrapolated:
        raise OutsideSupportError(
            f"r={at.r}, phi={at.phi}, aperture={at.aperture} lies outside what the samples of lens {lens_id} "
            "cover: upload photos that do, or ask without strict"
        )
    pitch = at.pixel_pitch_um or fitted.model.pitch_um
    body, more = psf_formats.psf(
        suffix, answer.kernel, psf_formats.describe(lens_id, fitted, at, answer, pitch)
    )
    return Response(body, media_type=MEDIA_TYPES[suffix], headers={**headers, **more})


def accepted(header: str) -> Format:
    """Return the format that an Accept header prefers."""
    preferences: list[tuple[float, str]] = []
    for preference in header.split(","):
        media, *parameters = (part.strip().lower() for part in preference.split(";"))
        quality = next((p.removeprefix("q=") for p in parameters if p.startswith("q=")), "1")
        preferences.append((float(quality) if quality.replace(".", "", 1).isdecimal() else 0.0, media))
    for weight, media in sorted(preferences, key=lambda preference: -preference[0]):
        for name, kind in MEDIA_TYPES.items():
            if weight > 0 and media in {"*/*", kind, f"{kind.partition('/')[0]}/*"}:
                return name
    raise ServiceError(
        f"Accept: {header[:200]!r} names none of {', '.join(MEDIA_TYPES.values())}", code="not_acceptable"
    )


def _fitted(
    lens_id: str, at: PsfQuery | FieldQuery, call: Call, form: str = ""
) -> tuple[Fitted | None, dict[str, str]]:
    """Return the model that answers, None where the browser has its answer already; and the headers."""
    state = found("lens", lens_id, call.store.lenses.state_of(lens_id, call.owner))
    fitted = call.models.get(lens_id, at.version, state=state)
    tag = etag(fitted, f"{at.model_dump_json()}{form}")
    fresh = "no-cache" if at.version is None else "max-age=3600"
    headers = {"ETag": tag, "Cache-Control": f"private, {fresh}", "Vary": "Accept"}
    return (None if matches_tag(call, tag) else fitted), headers


def _setting(at: PsfQuery | FieldQuery) -> LensSettings:
    return LensSettings(at.aperture, at.focal_length_mm, at.focus_distance_m, at.channel)


def etag(fitted: Fitted, question: str) -> str:
    """Return a strong tag: the same query to the same samples and weights has the same answer."""
    digest = hashlib.sha256(f"{question}{fitted.model.weights}".encode()).hexdigest()[:12]
    return f'"{fitted.lens_id}-v{fitted.state.version}-e{fitted.state.rebuild_epoch}-{digest}"'


@router.get(
    "/lenses/{lens_id}/field.png",
    operation_id="getFieldMap",
    response_class=Response,
    responses={200: file_answer("image/png", "Map")[200] | {"headers": _HEADERS}, **NOT_CHANGED},
)
def read_field(lens_id: str, at: Annotated[FieldQuery, Query()], call: CallDep) -> Response:
    """Return a picture of the kernels all over the field, each scaled to its own peak."""
    columns, rows = (int(count) for count in at.grid.split("x"))
    if not (1 <= columns <= MAX_GRID and 1 <= rows <= MAX_GRID):
        raise InvalidParameterError(f"grid {at.grid}: columns and rows must lie in 1..{MAX_GRID}, as in 9x6")
    pixels = columns * rows * at.size**2
    if pixels > MAX_FIELD_PIXELS:
        raise InvalidParameterError(
            f"grid {at.grid} of size {at.size} are {pixels / 1e6:.1f} million pixels, "
            f"{MAX_FIELD_PIXELS / 1e6:g} may be: ask for fewer or smaller kernels"
        )
    fitted, headers = _fitted(lens_id, at, call)
    if fitted is None:
        return Response(status_code=status.HTTP_304_NOT_MODIFIED, headers=headers)
    setting, query = _setting(at), fitted.model.query
    picture, more = psf_formats.field_map(
        lambda place: query(place, setting, at.size),
        columns=columns,
        rows=rows,
        size=at.size,
        aspect=at.aspect,
    )
    return Response(picture, media_type="image/png", headers={**headers, **more})
