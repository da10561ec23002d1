"""Export and import of the profile of a lens as a file."""

from __future__ import annotations

import asyncio
import hashlib
import io
import time
from typing import Annotated, Final

from fastapi import APIRouter, Query, Response, status
from starlette.concurrency import run_in_threadpool

from app.errors import ServiceError
from app.http import upload
from app.http.dependencies import Call, CallDep, OneSession
from app.routes import jobs
from app.routes.common import file_answer, file_headers, find_lens, problems
from app.routes.lenses import read_lens
from app.routes.photos import delete_photo, receiving, recorded
from app.schemas import V1, LensOut
from app.store.tables import PHOTO_FINAL, PROFILE_FILE, PhotoRow
from lensmodel.core.names import full_name
from lensmodel.model.profile import LensProfile, write_profile

router = APIRouter(tags=["lenses"], route_class=OneSession)

_PAGE: Final = 200  # photos that are read at once (chosen): bounds the memory that a large lens takes
_FILE: Final = {"application/zip": {"schema": {"type": "string", "format": "binary"}}}
# Codes with which the reading of a profile is refused as such; all others are conflicts
_REFUSALS: Final = frozenset({"malformed_upload", "image_too_large", "unknown_lens", "other_lens"})


@router.get(
    "/lenses/{lens_id}/profile",
    operation_id="getLensProfile",
    response_class=Response,
    responses=file_answer("application/zip", "A .lensprofile"),
)
def read_lens_profile(lens_id: str, call: CallDep) -> Response:
    """Return all that was learned of a lens as one file, which the command line reads too."""
    lens = find_lens(call, lens_id)
    model = call.models.get(lens_id).model
    named = {"maker": lens.maker, "model": lens.model, "serial": lens.serial, "label": lens.label}
    profile = LensProfile(
        model,
        {name: value for name, value in named.items() if value},
        _photos(call, lens_id, {sample.photo for sample in model.samples}),
    )
    out = io.BytesIO()
    write_profile(out, profile)
    name = lens.label or full_name(lens.maker, lens.model) or "lens"
    headers = file_headers(f"{name}.lensprofile")
    return Response(out.getvalue(), media_type="application/zip", headers=headers)


@router.put(
    "/lenses/{lens_id}/profile",
    operation_id="addLensProfile",
    responses=problems(
        400,
        408,
        413,
        507,
        also={202: {"model": LensOut, "description": "Still being read: `Location` is its job"}},
    ),
    openapi_extra={"requestBody": {"required": True, "content": _FILE}},
)
async def add_lens_profile(
    lens_id: str,
    call: CallDep,
    any_lens: Annotated[bool, Query(description="also where it seems to be of another lens")] = False,
) -> LensOut:
    """Let what a profile knows join a lens; each of its photos counts as one, without its file.

    A worker reads it: the answer is the lens with it, or 202 where that takes longer than a long poll.
    The same profile a second time changes nothing. It must have been learned with the model of the lens.
    """
    await run_in_threadpool(find_lens, call, lens_id)
    async with receiving(call) as (public_id, key):
        digest, size = await upload.receive_profile(call.request, call.storage, key)
    file = await run_in_threadpool(_record, call, lens_id, any_lens, public_id, key, digest, size)
    end = time.monotonic() + jobs.LONG_POLL_S
    while file is not None and file.state not in PHOTO_FINAL and time.monotonic() < end:
        await asyncio.sleep(jobs.LOOK_S)
        file = await run_in_threadpool(call.store.photos.get, file.public_id, call.owner)
    if file is not None and file.state in {"failed", "cancelled"}:
        await run_in_threadpool(delete_photo, file.public_id, call)
        code = "image_too_large" if file.error_code == "memory_limit" else file.error_code
        detail = file.error_detail or "the reading of the profile was cancelled: send it again"
        raise ServiceError(detail, code=code if code in _REFUSALS else "conflict")
    if file is not None and file.state not in PHOTO_FINAL:
        call.response.status_code = status.HTTP_202_ACCEPTED
        call.response.headers["Location"] = f"{V1}/jobs/{file.public_id}"
    return await run_in_threadpool(read_lens, lens_id, call)


def _record(
    call: Call, lens_id: str, any_lens: bool, public_id: str, key: str, digest: str, size: int
) -> PhotoRow | None:
    """Store the file of a profile like that of a photo; another lens may be sent the same."""
    name = f"{lens_id}.lensprofile"
    same = hashlib.sha256(f"{name}|{digest}".encode()).hexdigest()
    return recorded(
        call,
        public_id,
        key,
        sha256=same,
        filename=name,
        kind=PROFILE_FILE,
        byte_size=size,
        calibrate=True,
        given={"lens_id": lens_id} | ({"any_lens": True} if any_lens else {}),
    ).photo


def _photos(call: Call, lens_id: str, wanted: set[str]) -> dict[str, str]:
    """Return the file names of the photos that a lens learned from, by id."""
    filenames: dict[str, str] = {}
    before = None
    while True:
        rows = call.store.photos.page(call.owner, before=before, limit=_PAGE, lens_id=lens_id)
        filenames |= {row.public_id: row.filename for row in rows if row.public_id in wanted}
        if len(rows) < _PAGE:
            return filenames
        before = rows[-1].public_id
