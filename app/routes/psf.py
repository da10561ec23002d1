"""The PSF of a lens at a place of the field, in four formats, and pictures of the whole field."""

from __future__ import annotations

import hashlib
import io
import math
from typing import Annotated, Final, Literal

import numpy as np
import tifffile
from fastapi import APIRouter, Query, Response
from PIL import Image

from app.errors import InvalidParameterError, ServiceError
from app.http.dependencies import Call, CallDep, OneSession, found
from app.http.model_cache import Fitted
from app.routes.common import NOT_CHANGED, Answers, file_answer
from app.schemas import FieldQuery, KernelOut, PsfOut, PsfQuery, Setting, Support, Units
from lensmodel.core.errors import OutsideSupportError
from lensmodel.core.types import FieldPosition, Kernel, LensSettings
from lensmodel.report.lens_report import UNKNOWN, grid

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
DIGITS: Final = 10  # decimals of kernels, whose sum is 1, in JSON (chosen): float32 resolves no more of 0.001
GAP_PX: Final = 2  # pixels between the kernels of a map (chosen for looks)
HATCH_PX: Final = 7  # pixels between the strokes over a cell that is not known (chosen for looks)
SCALE: Final = "X-PSF-Scale"
_HEADERS: Final = {SCALE: {"schema": {"type": "string"}, "description": "of PNG: value of white, and gamma"}}
_FILES: Final = {name: {"schema": {"type": "string", "format": "binary"}} for name in MEDIA_TYPES.values()}
_ANSWERS: Final[Answers] = {
    200: {
        "model": PsfOut,
        "content": {name: file for name, file in _FILES.items() if "json" not in name},
        "description": "The PSF",
        "headers": _HEADERS,
    },
    **NOT_CHANGED,
}
_MAP: Final = {**file_answer("image/png", "Map"), **NOT_CHANGED}
_PROPERTIES: Final = PsfQuery.model_json_schema()["properties"]
# Read by the route itself: for so many parameters FastAPI takes a third of the time of a request
_QUERY: Final = {
    "parameters": [
        {"name": name, "in": "query", "required": field.is_required(), "schema": _PROPERTIES[name]}
        for name, field in PsfQuery.model_fields.items()
    ]
}


@router.get("/lenses/{lens_id}/psf", response_class=Response, responses=_ANSWERS, openapi_extra=_QUERY)
def get_psf(lens_id: str, call: CallDep) -> Response:
    """Return the PSF in the format that `Accept` asks for; JSON by default."""
    return get_psf_as(lens_id, accepted(call.request.headers.get("accept", "*/*")), call)


@router.get(
    "/lenses/{lens_id}/psf.{suffix}", response_class=Response, responses=_ANSWERS, openapi_extra=_QUERY
)
def get_psf_as(lens_id: str, suffix: Format, call: CallDep) -> Response:
    """Return the PSF in the format of the suffix."""
    at = PsfQuery.model_validate(dict(call.request.query_params))
    fitted, headers = _fitted(lens_id, at, call, suffix)
    if fitted is None:
        return Response(status_code=304, headers=headers)
    place = FieldPosition(at.r, at.phi)
    answer = fitted.model.query(place, _setting(at), at.size, pitch_um=at.pixel_pitch_um)
    if at.strict and answer.extrapolated:
        raise OutsideSupportError(
            f"r={at.r}, phi={at.phi}, aperture={at.aperture} lies outside what the samples of lens {lens_id} "
            "cover: upload photos that do, or ask without strict"
        )
    once_round = at.phi if -math.pi < at.phi <= math.pi else place.phi
    told = PsfOut(
        lens_id=lens_id,
        version=fitted.state.version,
        query=at.model_copy(update={"phi": once_round}),
        psf=KernelOut(shape=(at.size, at.size), dtype="float32", data=[]),
        support=Support.of(answer),
        units=Units(pixel_pitch_um=at.pixel_pitch_um or fitted.model.pitch_um),
    )
    body, more = encoded(suffix, answer.kernel, told)
    return Response(body, media_type=MEDIA_TYPES[suffix], headers={**more, **headers})


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


def encoded(form: Format, kernel: Kernel, told: PsfOut) -> tuple[bytes, dict[str, str]]:
    """Encode a kernel and what is told of it; return the bytes and the headers that describe them."""
    if form == "json":
        values = np.round(kernel, DIGITS).tolist()
        full = told.model_copy(update={"psf": told.psf.model_copy(update={"data": values})})
        return full.model_dump_json().encode(), {}
    at, buffer = told.query, io.BytesIO()
    aperture = "" if at.aperture is None else f"-f{at.aperture:g}"
    name = f"psf-v{told.version}-r{at.r:.3f}-phi{at.phi:.3f}{aperture}-{at.channel}.{form}"
    headers = {"Content-Disposition": f'inline; filename="{name}"'}
    if form == "npy":
        np.save(buffer, kernel.astype("<f4"), allow_pickle=False)
    elif form == "tiff":
        text = told.model_dump_json(exclude={"psf"})  # tifffile would interpret a "shape" in it
        pixels = kernel.astype(np.float32)
        tifffile.imwrite(buffer, pixels, photometric="minisblack", description=text, metadata=None)
    else:
        peak = float(kernel.max())
        headers[SCALE] = f"max={peak:.9g}; gamma=1"
        Image.fromarray(np.round(kernel / peak * 65535).astype(np.uint16)).save(buffer, "PNG")
    return buffer.getvalue(), headers


def _fitted(lens_id: str, at: Setting, call: Call, form: str = "") -> tuple[Fitted | None, dict[str, str]]:
    """Return the model that answers, None where the browser has its answer already; and the headers."""
    state = found("lens", lens_id, call.store.lenses.state_of(lens_id, call.owner))
    fitted = call.models.get(lens_id, at.version, state=state)
    # a strong tag: the same query to the same samples and weights has the same answer
    question = f"{at.model_dump_json()}{form}{fitted.model.weights}"
    digest = hashlib.sha256(question.encode()).hexdigest()[:12]
    tag = f'"{fitted.lens_id}-v{fitted.state.version}-e{fitted.state.rebuild_epoch}-{digest}"'
    fresh = "no-cache" if at.version is None else "max-age=3600"
    headers = {"ETag": tag, "Cache-Control": f"private, {fresh}", "Vary": "Accept"}
    return (None if call.knows(tag) else fitted), headers


def _setting(at: Setting) -> LensSettings:
    return LensSettings(at.aperture, at.focal_length_mm, at.focus_distance_m, at.channel)


@router.get("/lenses/{lens_id}/field.png", response_class=Response, responses=_MAP)
def get_field_map(lens_id: str, at: Annotated[FieldQuery, Query()], call: CallDep) -> Response:
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
        return Response(status_code=304, headers=headers)
    pitch, setting = at.size + GAP_PX, _setting(at)
    sheet = np.full((rows * pitch + GAP_PX, columns * pitch + GAP_PX), 40, dtype=np.uint8)
    # where too little is known the cell is hatched, as in reports
    hatched = np.where(np.add.outer(np.arange(at.size), np.arange(at.size)) % HATCH_PX < 2, 110, 40)
    for cell, place in enumerate(grid(rows, columns, at.aspect)):
        row, column = divmod(cell, columns)
        answer = fitted.model.query(place, setting, at.size)
        top, left = row * pitch + GAP_PX, column * pitch + GAP_PX
        known = answer.predicted_error < UNKNOWN and not answer.extrapolated
        bright = np.round(np.sqrt(answer.kernel / answer.kernel.max()) * 255)
        sheet[top : top + at.size, left : left + at.size] = bright if known else hatched
    buffer = io.BytesIO()
    Image.fromarray(sheet).save(buffer, "PNG")
    return Response(buffer.getvalue(), media_type="image/png", headers=headers)
