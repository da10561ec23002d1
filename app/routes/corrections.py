"""Corrections: ask for one, see how it fares, fetch the file."""

from __future__ import annotations

import re
from typing import Final

from fastapi import APIRouter, Response
from starlette.responses import StreamingResponse

from app.errors import ConflictError, InvalidParameterError, NotReadyError
from app.http import views
from app.http.dependencies import Call, CallDep, OneSession, found
from app.http.model_cache import check_version
from app.routes import common
from app.routes.common import Cursor, Limit, OnlyId
from app.routes.photos import SEND_AGAIN, check_usage
from app.schemas import V1, CorrectionIn, CorrectionOut, Page, Region
from app.store.lenses import LensState
from app.store.photos import stored_settings
from app.store.tables import LensRow, PhotoRow
from lensmodel.core.errors import InvalidInputError, MetadataMissingError, NoSamplesError
from lensmodel.correction import deconvolvers

router = APIRouter(tags=["corrections"], route_class=OneSession)
_RESULT: Final[common.Answers] = {
    **common.file_answer("image/*", "The file"),
    **common.file_answer("image/*", "A part", 206),
    **common.NOT_CHANGED,
}
_RANGE: Final = re.compile(r"bytes=(\d{0,18})-(\d{0,18})", re.ASCII)


@router.post(
    "/corrections",
    status_code=202,
    responses={200: {"model": CorrectionOut, "description": "The same correction is finished"}},
)
def create_correction(options: CorrectionIn, call: CallDep) -> CorrectionOut:
    """Correct a photo with the model of its lens, or of another; the same request is the same correction."""
    photo = call.photo(options.photo_id)
    if options.method not in deconvolvers:
        raise InvalidInputError(f"no method {options.method!r}; known: {', '.join(deconvolvers)}")
    _check_photo(photo, options.roi)
    lens = _lens_for(call, photo, options.lens_id)
    if not options.any_lens and lens.id != photo.lens_id:
        common.check_same_lens(call, lens, photo, f"{photo.filename} seems to be of another lens")
    version = _version_for(call, lens, options.lens_version)
    asked = options.model_dump(mode="json", exclude={"photo_id", "lens_id", "lens_version", "any_lens"})
    # with other settings of the photo the same request is a new correction
    params = asked | {"settings": stored_settings(photo)}
    if not call.store.jobs.is_known(photo, lens, version, params):
        check_usage(call, "corrections")
    row, created = call.store.jobs.correct(photo, lens, version, params)
    call.response.status_code = 200 if not created and row.state == "succeeded" else 202
    call.response.headers["Location"] = f"{V1}/corrections/{row.public_id}"
    return views.correction_out(row)


def _check_photo(photo: PhotoRow, roi: Region | None) -> None:
    """Check that the file was inspected, as its size and settings are part of the request, and the region."""
    if photo.file_gone_at is not None:
        raise ConflictError(f"the file of photo {photo.public_id} is no longer kept: {SEND_AGAIN}")
    if photo.width is None or photo.height is None:
        if photo.state in {"received", "inspecting"}:
            text = f"photo {photo.public_id} is still being read ({photo.state}): wait for its job"
            raise NotReadyError(text, headers={"Retry-After": "1"})
        raise ConflictError(f"photo {photo.public_id} could not be read ({photo.state}): send it again")
    if roi is not None and (roi.x + roi.width > photo.width or roi.y + roi.height > photo.height):
        raise InvalidParameterError(
            f"roi {roi.x},{roi.y} {roi.width}x{roi.height} reaches beyond the photo of "
            f"{photo.width}x{photo.height} pixels: draw it in"
        )


def _lens_for(call: Call, photo: PhotoRow, lens_id: str | None) -> LensRow:
    if lens_id is not None:
        return call.lens(lens_id)
    lens = photo.lens or call.store.lenses.by_identity(photo)
    if lens is not None:
        return lens
    raise MetadataMissingError(
        f"photo {photo.public_id} does not say which lens it was taken with: send lens_id"
    )


def _version_for(call: Call, lens: LensRow, wanted: int | None) -> int:
    state = LensState(lens.version, lens.rebuild_epoch)
    if wanted is not None and wanted != lens.version:
        check_version(call.store, lens.public_id, wanted, state)
        return wanted
    if lens.sample_count == 0:
        raise NoSamplesError(
            f"lens {lens.public_id} has no samples yet: "
            "upload photos taken with it and wait until they are counted"
        )
    return lens.version


@router.get("/corrections")
def list_corrections(
    call: CallDep, limit: Limit = 50, cursor: Cursor = None, photo_id: OnlyId = None
) -> Page[CorrectionOut]:
    """List corrections, newest first, optionally of one photo."""
    photo = None if photo_id is None else call.photo(photo_id)
    rows = call.store.jobs.page(call.owner, before=cursor, limit=limit + 1, photo=photo)
    return call.page(rows, limit, views.correction_out)


@router.get("/corrections/{correction_id}")
def get_correction(correction_id: str, call: CallDep) -> CorrectionOut:
    """Return one correction."""
    return views.correction_out(call.correction(correction_id))


@router.delete("/corrections/{correction_id}", status_code=204)
def delete_correction(correction_id: str, call: CallDep) -> None:
    """Delete a correction with its file; a running one stops."""
    prefix = call.store.jobs.delete(correction_id, call.owner)
    call.storage.delete(found("correction", correction_id, prefix))


@router.get("/corrections/{correction_id}/result", response_class=Response, responses=_RESULT)
def get_correction_result(correction_id: str, call: CallDep) -> Response:
    """Return the corrected photo, whole or in part."""
    row = call.correction(correction_id)
    if row.state != "succeeded":
        raise NotReadyError(
            f"correction {correction_id} is {row.state}: "
            + ("wait for its job" if row.state in {"queued", "running"} else "ask for it again"),
            headers={"Retry-After": "1"} if row.state in {"queued", "running"} else {},
        )
    assert row.result_key is not None
    assert row.result_bytes is not None
    tag = f'"{row.result_etag}"'
    headers = {"ETag": tag, "Accept-Ranges": "bytes", **common.file_headers(row.result_name or "corrected")}
    if call.knows(tag):
        return Response(status_code=304, headers=headers)
    part = call.request.headers.get("range")
    if call.request.headers.get("if-range", tag) != tag:
        part = None  # the file has changed since the first part: send all of it
    start, end = byte_range(part, row.result_bytes)
    headers["Content-Length"] = str(end - start)
    code = 200
    if (start, end) != (0, row.result_bytes):
        code = 206
        headers["Content-Range"] = f"bytes {start}-{end - 1}/{row.result_bytes}"
    body = call.storage.stream(row.result_key, start, end)
    return StreamingResponse(body, code, headers, row.result_media_type)


def byte_range(header: str | None, size: int) -> tuple[int, int]:
    """Return the part of a file that a Range header asks for, its end excluded."""
    match = _RANGE.fullmatch(header.strip()) if header else None
    first, last = match.groups() if match else ("", "")
    if not (first or last) or (first and last and int(last) < int(first)):
        return 0, size  # anything but one plain range asks for all of it, as RFC 9110 (14.2) allows
    start = int(first) if first else max(size - int(last), 0)
    end = min(int(last) + 1, size) if first and last else size
    if start >= end:
        raise InvalidParameterError(
            f"range {header!r} lies beyond the {size} bytes of the file",
            headers={"Content-Range": f"bytes */{size}"},
            status=416,
        )
    return start, end
