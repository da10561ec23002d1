"""Export and import of the profile of a lens as a file."""

from __future__ import annotations

import io
import re
import zipfile
from typing import Final

from fastapi import APIRouter, Response
from starlette.concurrency import run_in_threadpool

from app.errors import BusyError, ConflictError, MalformedUploadError, TooLargeError, UnknownLensError
from app.http.bodies import CLOSE, within
from app.http.dependencies import Call, CallDep
from app.routes.common import problems
from app.routes.lenses import find_lens, read_lens
from app.schemas import LensOut
from app.store.profile_intake import take_in
from app.ways import configured_way
from lensmodel.core.errors import InvalidInputError
from lensmodel.model.answer import PAPER
from lensmodel.model.profile import LensProfile, read_profile, write_profile

router = APIRouter(tags=["lenses"])

MAX_BYTES: Final = 64 << 20
"""Largest profile that is accepted (chosen): twenty times that of a hundred photos."""

MAX_UNPACKED: Final = 256 << 20
"""Bytes to which a profile may unpack (chosen): kernels of 20,000 samples of 55 pixels, which no lens has."""

_PAGE: Final = 200
"""Photos that are read at once (chosen): bounds the memory that a large lens takes."""

_FILE: Final = {"application/zip": {"schema": {"type": "string", "format": "binary"}}}


@router.get(
    "/lenses/{lens_id}/profile",
    operation_id="getLensProfile",
    response_class=Response,
    responses=problems(404, 409, 422, also={200: {"content": _FILE, "description": "A .lensprofile"}}),
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
    words = lens.label or " ".join(word for word in (lens.maker, lens.model) if word)
    plain = re.sub(r"[^A-Za-z0-9._-]+", "-", words).strip("-") or "lens"
    headers = {
        "Content-Disposition": f'attachment; filename="{plain}.lensprofile"',
        "Cache-Control": "private, no-cache",
        "X-Content-Type-Options": "nosniff",
    }
    return Response(out.getvalue(), media_type="application/zip", headers=headers)


@router.put(
    "/lenses/{lens_id}/profile",
    operation_id="addLensProfile",
    responses=problems(400, 404, 408, 409, 413, 422),
    openapi_extra={"requestBody": {"required": True, "content": _FILE}},
)
async def add_lens_profile(lens_id: str, call: CallDep) -> LensOut:
    """Let what a profile knows join a lens; each of its photos counts as one, without its file.

    The same profile a second time changes nothing. It must have been learned with the model of the lens.
    """
    await run_in_threadpool(find_lens, call, lens_id)
    many = BusyError("too many files are being received: try again in a few seconds", headers=CLOSE)
    with call.services.uploads.take(many):
        async with within(call.settings.upload_seconds):
            data = await _received(call)
        return await run_in_threadpool(_add, lens_id, data, call)


async def _received(call: Call) -> bytes:
    """Return the body, if it is not too long."""
    data, more = bytearray(), True
    while more:
        message = await call.request.receive()
        if message["type"] == "http.disconnect":
            raise MalformedUploadError("the profile ended too early: send it again")
        data += message.get("body", b"")
        more = message.get("more_body", False)
        if len(data) > MAX_BYTES:
            raise TooLargeError(f"the profile is larger than {MAX_BYTES >> 20} MiB: send a smaller one")
    return bytes(data)


def _check_unpacked(data: bytes) -> None:
    """Refuse a profile that unpacks to more than a lens can need, before anything of it is unpacked."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
    except (zipfile.BadZipFile, ValueError, OSError) as error:
        raise MalformedUploadError("this is no lens profile: send one that ends in .lensprofile") from error
    if unpacked > MAX_UNPACKED:
        raise TooLargeError(
            f"the profile unpacks to {unpacked >> 20} MiB, {MAX_UNPACKED >> 20} MiB may be: send less"
        )


def _add(lens_id: str, data: bytes, call: Call) -> LensOut:
    _check_unpacked(data)
    try:
        profile = read_profile(io.BytesIO(data), "This file")
    except InvalidInputError as error:
        raise MalformedUploadError(str(error)) from error
    lens = find_lens(call, lens_id)
    paper_lens, paper_profile = (
        mode == PAPER for mode in (configured_way(call.settings, lens.way).mode, profile.model.settings.mode)
    )
    if paper_lens != paper_profile or lens.way != lens.answering_way:
        raise ConflictError(
            f"the profile was learned with the model {'paper' if paper_profile else 'default'}, "
            f"lens {lens_id} has {lens.way} and answers with {lens.answering_way}: "
            f"PATCH /v1/lenses/{lens_id} with "
            '{"model"}, or wait until it has changed'
        )
    names = {key: name for key, name in profile.photos.items() if name.isprintable()}
    if take_in(call.store.database, lens_id, call.owner, profile.model.samples, names) is None:
        raise UnknownLensError(f"there is no lens {lens_id[:60]}: it may be deleted already")
    return read_lens(lens_id, call)


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
