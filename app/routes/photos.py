"""Photos: send one, see how it fares, say what its file did not, delete it."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, status
from starlette.concurrency import run_in_threadpool

from app import upload, views
from app.bodies import CLOSE
from app.dependencies import Call, CallDep
from app.errors import (
    BusyError,
    ConflictError,
    InvalidParameterError,
    QuotaError,
    StorageFullError,
    UnknownLensError,
    UnknownPhotoError,
)
from app.ids import new_id
from app.routes.common import Cursor, Limit, OnlyId, cut, next_link, problems
from app.schemas import PatchPage, PhotoChange, PhotoOut, PhotoPage, PhotoState
from app.settings import MIB
from app.store import LensName
from app.store.photos import GIVEN_SETTINGS
from app.tables import PhotoRow

router = APIRouter(tags=["photos"])
GIB = 1024 * MIB

_UPLOAD_BODY = {
    "required": True,
    "content": {
        "multipart/form-data": {
            "schema": {
                "type": "object",
                "required": ["file"],
                "properties": {
                    "file": {"type": "string", "contentMediaType": "application/octet-stream"},
                    "calibrate": {"type": "boolean", "default": True},
                    "lens_id": {"type": "string"},
                    "lens_serial": {"type": "string"},
                    "lens_model": {"type": "string"},
                    "lens_maker": {"type": "string"},
                    "aperture": {"type": "number", "minimum": 0.5, "maximum": 128},
                    "focal_length_mm": {"type": "number", "minimum": 0.1, "maximum": 20000},
                    "focus_distance_m": {"type": "number", "exclusiveMinimum": 0},
                    "pixel_pitch_um": {"type": "number", "exclusiveMinimum": 0.1},
                },
            }
        },
        "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
    },
}


@router.post(
    "/photos",
    operation_id="createPhoto",
    status_code=status.HTTP_202_ACCEPTED,
    response_model=PhotoOut,
    responses=problems(
        400,
        403,
        404,
        408,
        413,
        415,
        422,
        429,
        507,
        also={200: {"model": PhotoOut, "description": "The same bytes are known"}},
    ),
    openapi_extra={"requestBody": _UPLOAD_BODY},
)
async def create_photo(call: CallDep) -> PhotoOut:
    """Store a photo, and calibrate its lens with it unless `calibrate=false`.

    The fields may stand in the form or in the query. What they say goes before the file's own
    metadata.
    """
    limits = call.settings
    many = BusyError(
        f"{limits.max_uploads} photos are being received, more may not be: try again in a few seconds",
        headers={"Retry-After": "5", **CLOSE},
    )
    with call.services.uploads.one(many):
        await run_in_threadpool(_admit, call)
        public_id = new_id()
        prefix = f"photos/{public_id}/"
        key = f"{prefix}original"
        await run_in_threadpool(call.store.photos.expect, prefix)
        uploaded = await upload.receive(
            call.request,
            call.storage,
            key,
            limit=limits.max_upload_bytes,
            patience_s=limits.stall_seconds,
        )
    photo, fresh = await run_in_threadpool(_record, call, public_id, uploaded, prefix)
    call.response.status_code = status.HTTP_202_ACCEPTED if fresh else status.HTTP_200_OK
    call.response.headers["Location"] = photo.links.self
    return photo


def _admit(call: Call) -> None:
    """Refuse before the body is read what cannot be taken anyway."""
    limits = call.settings
    free = call.storage.free_bytes()
    coming = min(upload.declared_length(call.request), limits.max_upload_bytes)
    if free is not None and free - coming < limits.min_free_mb * MIB:
        raise StorageFullError(
            f"{free // MIB} MiB are free where photos are kept, {limits.min_free_mb} MiB must stay so, and "
            f"{coming / MIB:.1f} MiB are to come: delete photos, or make room on the disk"
        )
    unfinished, stored = call.store.photos.load_of(call.owner)
    if unfinished >= limits.max_queued_photos:
        raise QuotaError(
            f"{unfinished} photos are being worked on, {limits.max_queued_photos} may be: "
            "wait for some to finish",
            headers={"Retry-After": "30"},
        )
    if stored >= limits.max_stored_gb * GIB:
        raise QuotaError(
            f"{stored / GIB:.1f} GiB of photos are stored, {limits.max_stored_gb} GiB may be: delete some"
        )


def _record(call: Call, public_id: str, uploaded: upload.Uploaded, prefix: str) -> tuple[PhotoOut, bool]:
    fields = uploaded.fields
    given = fields.model_dump(exclude={"calibrate"}, exclude_none=True)
    if fields.lens_id is not None and call.store.lenses.get(fields.lens_id, call.owner) is None:
        call.storage.delete(prefix)
        raise UnknownLensError(f"lens_id {fields.lens_id}: there is no such lens; GET /v1/lenses lists them")
    received = call.store.photos.receive(
        call.owner,
        public_id=public_id,
        sha256=uploaded.sha256,
        filename=uploaded.filename,
        kind=uploaded.kind,
        byte_size=uploaded.size,
        blob_key=f"{prefix}original",
        calibrate=fields.calibrate,
        given=given,
    )
    if received.photo.public_id != public_id:
        call.storage.delete(prefix)  # the same bytes are there already
    return describe(call, received.photo), received.fresh


def describe(call: Call, photo: PhotoRow) -> PhotoOut:
    """Describe a photo with its lens, or with the lenses that may be its."""
    lens = call.store.photos.lens_of(photo)
    return views.photo_out(photo, None if lens is None else lens.public_id, candidates(call, photo))


def candidates(call: Call, photo: PhotoRow) -> list[str]:
    """Return the lenses that a waiting photo may belong to."""
    if photo.state != "needs_lens" or photo.lens_id is not None:
        return []
    return [lens.public_id for lens in call.store.lenses.candidates(photo)]


def find_photo(call: Call, photo_id: str) -> PhotoRow:
    """Return a photo of the owner."""
    photo = call.store.photos.get(photo_id, call.owner)
    if photo is None:
        raise UnknownPhotoError(f"there is no photo {photo_id[:60]}: GET /v1/photos lists those there are")
    return photo


@router.get("/photos", operation_id="listPhotos", responses=problems(422))
def list_photos(
    call: CallDep,
    limit: Limit = 50,
    cursor: Cursor = None,
    lens_id: OnlyId = None,
    state: PhotoState | None = None,
) -> PhotoPage:
    """List photos, newest first."""
    rows = call.store.photos.page(call.owner, before=cursor, limit=limit + 1, lens_id=lens_id, state=state)
    page, following = cut(rows, limit)
    lenses = call.store.photos.lens_ids(page)
    items = [views.photo_out(row, lenses.get(row.lens_id or 0)) for row in page]
    return PhotoPage(items=items, next=next_link(call, following))


@router.get("/photos/{photo_id}", operation_id="getPhoto", responses=problems(404, 422))
def read_photo(photo_id: str, call: CallDep) -> PhotoOut:
    """Return one photo."""
    return describe(call, find_photo(call, photo_id))


@router.get("/photos/{photo_id}/patches", operation_id="listPatches", responses=problems(404, 422))
def list_patches(photo_id: str, call: CallDep) -> PatchPage:
    """Return where PSFs were estimated in a photo, and which windows were rejected and why."""
    photo = find_photo(call, photo_id)
    return PatchPage(items=[views.patch_out(row) for row in call.store.patches.listed(photo.public_id)])


@router.delete(
    "/photos/{photo_id}",
    operation_id="deletePhoto",
    status_code=status.HTTP_204_NO_CONTENT,
    responses=problems(404, 422),
)
def delete_photo(photo_id: str, call: CallDep) -> None:
    """Delete a photo with its file, samples and corrections."""
    prefix = call.services.reserve.spend(lambda: call.store.photos.delete(photo_id, call.owner))
    if prefix is None:
        raise UnknownPhotoError(f"there is no photo {photo_id[:60]}: it may be deleted already")
    call.storage.delete(prefix)


@router.patch("/photos/{photo_id}", operation_id="changePhoto", responses=problems(404, 409, 422))
def change_photo(photo_id: str, change: PhotoChange, call: CallDep) -> PhotoOut:
    """Name the lens, correct the settings, or take the photo out of its lens's model.

    A photo that waited for its lens, or was still being worked on, starts again with what is
    now known. A counted one changes its lens's model at once.
    """
    photo = find_photo(call, photo_id)
    if not change.model_fields_set:
        raise InvalidParameterError(
            "nothing to change: send lens_id, new_lens, aperture, excluded or another field"
        )
    given: dict[str, Any] = change.model_dump(include=set(GIVEN_SETTINGS), exclude_none=True)
    lens = _target_lens(call, photo, change)
    done = call.store.photos.change(photo_id, call.owner, given, lens=lens, excluded=change.excluded)
    photo = find_photo(call, photo_id)
    if not done:
        raise ConflictError(
            f"excluded={change.excluded}: a photo in state {photo.state} does not count; "
            "only counted ones can be excluded"
        )
    return describe(call, photo)


def _target_lens(call: Call, photo: PhotoRow, change: PhotoChange) -> LensName | str | None:
    ways = (change.lens_id, change.lens_serial, change.new_lens)
    if sum(way is not None for way in ways) > 1:
        raise InvalidParameterError("lens_id, lens_serial and new_lens each name the lens: send one of them")
    if change.lens_id is not None:
        if call.store.lenses.get(change.lens_id, call.owner) is None:
            raise UnknownLensError(
                f"lens_id {change.lens_id}: there is no such lens; GET /v1/lenses lists them"
            )
        return change.lens_id
    maker, model = change.lens_maker or photo.lens_maker, change.lens_model or photo.lens_model
    if change.new_lens is not None:
        return LensName(maker, model, None, label=change.new_lens.label)
    if change.lens_serial is not None:
        return LensName(maker, model, change.lens_serial)
    if change.lens_model is not None or change.lens_maker is not None:
        raise InvalidParameterError("lens_model alone does not tell copies apart: send lens_serial with it")
    return None
