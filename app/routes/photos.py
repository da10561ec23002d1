"""Photos: send one, see how it fares, say what its file did not, delete it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from datetime import timedelta
from typing import Any, Final, Literal

from fastapi import APIRouter
from starlette.concurrency import run_in_threadpool
from structlog.contextvars import bind_contextvars

from app.errors import BusyError, ConflictError, InvalidParameterError, QuotaError, ServiceError
from app.http import middleware, upload, views
from app.http.dependencies import Call, CallDep, OneSession, found
from app.http.middleware import CLOSE
from app.routes.common import Answers, Cursor, Limit, OnlyId
from app.runtime.settings import MIB, Settings
from app.schemas import V1, Page, PatchOut, PhotoChange, PhotoOut, PhotosChange, PhotoState, UploadFields
from app.store import LensName
from app.store.accounts import Usage
from app.store.database import new_id
from app.store.photos import GIVEN_SETTINGS, Received
from app.store.tables import PhotoRow
from lensmodel.patches import selectors

router = APIRouter(tags=["photos"], route_class=OneSession)
GIB = 1024 * MIB  # bytes
# Longest that a photo may be on its way to us in seconds (chosen): 512 MiB come within it at 1.2 Mbit/s
UPLOAD_S: Final = 3600.0
# Files that are received at once (chosen): each takes a connection and a file, and hardly any memory
MAX_UPLOADS: Final = 8
# Photos, and corrections, of one owner, unless his keys say another number of photos (chosen): all that one
# photographer has
MAX_PHOTOS: Final = 100_000
# Photos, and corrections, of one owner that wait or are worked on (chosen): a day's work of one machine
MAX_UNFINISHED: Final = 500
SEND_AGAIN = "send the same file again, and ask then (LENS_KEEP_PHOTOS says how long files stay)"

_FIELDS: Final = {
    name: next(kind for kind in field.get("anyOf", [field]) if kind.get("type") != "null")
    for name, field in UploadFields.model_json_schema()["properties"].items()
}
_FILE: Final = {"type": "string", "contentMediaType": "application/octet-stream"}
_FORM: Final = {"type": "object", "required": ["file"], "properties": {"file": _FILE, **_FIELDS}}
_BODY: Final = {
    "multipart/form-data": {"schema": _FORM},
    "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
}
_UPLOAD: Final = {"requestBody": {"required": True, "content": _BODY}}

_RECEIVED: Final[Answers] = {200: {"model": PhotoOut, "description": "The same bytes are known"}}


@router.post("/photos", status_code=202, responses=_RECEIVED, openapi_extra=_UPLOAD)
async def create_photo(call: CallDep) -> PhotoOut:
    """Store a photo, and calibrate its lens with it unless `calibrate=false`.

    The fields may stand in the form or in the query. The lens that they name goes before that of the file.
    Aperture, focal length, focus distance and pixel pitch are taken where the file does not say its own;
    `PATCH /v1/photos/{id}` corrects a file that says them wrongly.

    With `kind` the photo was made to measure the lens: a `target`, `points`, `edges`, or the open
    photo of a `pair`, whose closed one was sent before with `calibrate=false` and is its `reference_id`.
    `selector` names who chooses its patches, of those that `GET /v1/formats` lists; bytes that are known keep
    the patches they have.
    """
    return await _received(call)


@router.post("/lenses/{lens_id}/measurements", status_code=202, responses=_RECEIVED, openapi_extra=_UPLOAD)
async def create_measurement(lens_id: str, call: CallDep) -> PhotoOut:
    """Store a photo made to measure a lens that is known, and measure it; `kind` says what it shows."""
    await run_in_threadpool(call.lens, lens_id)
    return await _received(call, lens_id)


@asynccontextmanager
async def receiving(call: Call) -> AsyncIterator[tuple[str, str]]:
    """Admit an upload, whose body comes in the block; give the id of its row and the key of its blob."""
    if call.uploads.locked():
        text = f"{MAX_UPLOADS} files are being received, more may not be: try again in a few seconds"
        raise BusyError(text, headers={"Retry-After": "5", **CLOSE})
    async with call.uploads:
        # before the body is read
        coming = middleware.declared_length(call.request.headers)
        await run_in_threadpool(check_usage, call, "photos", coming)
        public_id = new_id()
        bind_contextvars(photo_id=public_id)
        prefix, span = f"photos/{public_id}/", timedelta(seconds=UPLOAD_S)
        await run_in_threadpool(call.store.photos.expect, prefix, within=span)
        try:
            async with asyncio.timeout(UPLOAD_S) as limit:
                yield public_id, f"{prefix}original"
        except TimeoutError as error:
            if not limit.expired():
                raise
            text = f"the body did not come within {UPLOAD_S:g} s: send it again over a faster connection"
            raise ServiceError(text, headers=CLOSE, code="too_slow") from error


async def _received(call: Call, lens_id: str | None = None) -> PhotoOut:
    """Receive a photo; with a lens, it must be a measurement of that lens."""
    async with receiving(call) as (public_id, key):
        uploaded = await upload.receive(call.request, call.storage, key, lens_id)
    return await run_in_threadpool(_take, call, public_id, uploaded, key, lens_id is not None)


def _take(call: Call, public_id: str, uploaded: upload.Uploaded, key: str, measured: bool) -> PhotoOut:
    """Create a photo from an upload, or find that of the same bytes."""
    fields = uploaded.fields
    try:
        _check_kind(call, fields, measured=measured)
        if fields.lens_id is not None:
            call.lens(fields.lens_id)
        received = recorded(call, public_id, key, uploaded)
    except ServiceError:  # before there was a photo: afterwards nothing is refused
        call.storage.delete(f"photos/{public_id}/")
        raise
    call.response.status_code = 202 if received.fresh else 200
    call.response.headers["Location"] = f"{V1}/photos/{received.photo.public_id}"
    return views.photo_out(received.photo)


def _check_kind(call: Call, fields: UploadFields, *, measured: bool) -> None:
    """Refuse contradictory fields of a photo made to measure a lens."""
    selector, pair = fields.selector, fields.kind == "pair"
    contradictions = {
        "kind is missing: send target, pair, points or edges": measured and fields.kind is None,
        "calibrate=false and kind exclude each other: leave one out": fields.kind and not fields.calibrate,
        "a pair needs kind=pair and reference_id together: send the photo at about f/8 first, with "
        "calibrate=false, and its id as reference_id with the open one": pair != bool(fields.reference_id),
        "selector and kind exclude each other: leave one out": selector and fields.kind,
        f"no selector {selector!r:.60}; known: {', '.join(selectors)}": selector
        and selector not in selectors,
    }
    for why, holds in contradictions.items():
        if holds:
            raise InvalidParameterError(why)
    if fields.reference_id is not None:
        call.photo(fields.reference_id)


def check_usage(call: Call, what: Literal["photos", "corrections"], coming: int = 0) -> None:
    """Refuse more where the disk is full, or an owner stores, or has in work, as much as he may."""
    limits, free = call.settings, call.storage.free_bytes()
    if free is not None and free - coming < limits.min_free_mb * MIB:
        raise QuotaError(
            f"{max(free - coming, 0) // MIB} MiB would be left where photos are kept, and "
            f"{limits.min_free_mb} MiB must be: delete photos, or make room on the disk",
            status=507,
        )
    usage = call.store.accounts.usage(call.owner)
    max_bytes, may = most(limits, usage)
    working, kept = usage.working_photos, usage.photos
    if what == "corrections":
        working, kept, may = usage.working_corrections, usage.corrections, MAX_PHOTOS
    if working >= MAX_UNFINISHED:
        text = f"{working} {what} are being worked on, {MAX_UNFINISHED} may be: wait for some to finish"
        raise QuotaError(text, headers={"Retry-After": "30"})
    text = f"{kept} {what} are stored, and {may} are allowed" if kept >= may else ""
    if usage.stored_bytes >= max_bytes:
        stored = f"{usage.stored_bytes / GIB:.1f} GiB of photos and results"
        text = f"{stored} are stored, {max_bytes / GIB:g} GiB may be"
    if text:
        raise QuotaError(f"{text}: delete some", headers={"Retry-After": "3600"})


def most(settings: Settings, usage: Usage) -> tuple[int, int]:
    """Return how many bytes and how many photos an owner may have."""
    return (
        int(settings.max_stored_gb * GIB) if usage.quota_bytes is None else usage.quota_bytes,
        MAX_PHOTOS if usage.quota_photos is None else usage.quota_photos,
    )


def recorded(call: Call, public_id: str, key: str, file: upload.Uploaded, **more: object) -> Received:
    """Create the row of an upload, or find that of the same bytes; return it as it is then."""
    received = call.store.photos.receive(
        call.owner,
        public_id=public_id,
        blob_key=key,
        may_be_new=call.who.key_id is None,
        sha256=file.sha256,
        filename=file.filename,
        kind=file.kind,
        byte_size=file.byte_size,
        calibrate=file.fields.calibrate,
        given=file.fields.model_dump(exclude={"calibrate"}, exclude_none=True) | more,
    )
    if received.photo.blob_key != key:
        call.storage.delete(f"photos/{public_id}/")  # the same bytes are stored already
    # another request may have deleted it meanwhile: then it is told as it was received
    photo = call.store.photos.get(received.photo.public_id, call.owner) or received.photo
    return replace(received, photo=photo)


@router.get("/photos")
def list_photos(
    call: CallDep,
    limit: Limit = 50,
    cursor: Cursor = None,
    lens_id: OnlyId = None,
    state: PhotoState | None = None,
) -> Page[PhotoOut]:
    """List photos, newest first."""
    rows = call.store.photos.page(call.owner, before=cursor, limit=limit + 1, lens_id=lens_id, state=state)
    return call.page(rows, limit, views.photo_out)


@router.get("/photos/{photo_id}")
def get_photo(photo_id: str, call: CallDep) -> PhotoOut:
    """Return one photo."""
    return views.photo_out(call.photo(photo_id))


@router.get("/photos/{photo_id}/patches")
def list_patches(photo_id: str, call: CallDep) -> Page[PatchOut]:
    """Return where PSFs were estimated in a photo, and which windows were rejected and why."""
    photo = call.photo(photo_id)
    return Page[PatchOut](items=[PatchOut.of(row) for row in call.store.photos.windows(photo.public_id)])


@router.delete("/photos/{photo_id}", status_code=204)
def delete_photo(photo_id: str, call: CallDep) -> None:
    """Delete a photo with its file, samples and corrections."""
    call.storage.delete(found("photo", photo_id, call.store.photos.delete(photo_id, call.owner)))


@router.patch("/photos/{photo_id}")
def change_photo(photo_id: str, change: PhotoChange, call: CallDep) -> PhotoOut:
    """Name the lens, correct the settings, take the photo out of its lens's model, or let it teach that.

    A photo that waited for its lens, or was still being worked on, starts again with what is
    now known. A counted one changes its lens's model at once.
    """
    photo = call.photo(photo_id)
    asked = _asked(call, photo, change)
    if change.calibrate is False:
        raise InvalidParameterError("calibrate=false: send excluded=true to take a photo out of its lens")
    if change.calibrate and photo.file_gone_at is not None:
        raise ConflictError(f"the file of photo {photo_id} is no longer kept: {SEND_AGAIN}")
    done = call.store.photos.change(
        [photo_id], call.owner, **asked, excluded=change.excluded, calibrate=bool(change.calibrate)
    )
    photo = call.photo(photo_id)
    if not done:
        raise ConflictError(
            f"excluded={change.excluded}: a photo in state {photo.state} does not count; "
            "only counted ones can be excluded"
        )
    return views.photo_out(photo)


@router.patch("/photos")
def change_photos(change: PhotosChange, call: CallDep) -> Page[PhotoOut]:
    """Name the lens of several photos, or correct their settings; a new lens becomes that of them all.

    Each photo changes as by itself; where one is gone nothing changes.
    """
    keys = list(dict.fromkeys(change.photo_ids))
    call.store.photos.change(keys, call.owner, **_asked(call, call.photo(keys[0]), change))
    return Page[PhotoOut](items=[views.photo_out(call.photo(key)) for key in keys])


def _asked(call: Call, photo: PhotoRow, change: PhotoChange | PhotosChange) -> dict[str, Any]:
    """Return the settings and the lens that a change names, the lens as one like that of `photo`."""
    if not change.model_fields_set - {"photo_ids"}:
        raise InvalidParameterError("nothing to change: send lens_id, new_lens, aperture or another field")
    if sum(way is not None for way in (change.lens_id, change.lens_serial, change.new_lens)) > 1:
        raise InvalidParameterError("lens_id, lens_serial and new_lens each name the lens: send one of them")
    maker, model = change.lens_maker or photo.lens_maker, change.lens_model or photo.lens_model
    lens: LensName | str | None = None
    if change.lens_id is not None:
        lens = call.lens(change.lens_id).public_id
    elif change.new_lens is not None:
        lens = LensName(maker, model, None, label=change.new_lens.label)
    elif change.lens_serial is not None:
        lens = LensName(maker, model, change.lens_serial)
    elif change.lens_model is not None or change.lens_maker is not None:
        raise InvalidParameterError("lens_model alone does not tell copies apart: send lens_serial with it")
    return {"given": change.model_dump(include=set(GIVEN_SETTINGS), exclude_none=True), "lens": lens}
