"""Lenses: what is known of each copy, what its owner does with it, its profile and its report as files."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from statistics import median
from typing import Annotated, Final, Literal

from fastapi import APIRouter, Query, Response
from starlette.concurrency import run_in_threadpool

from app.errors import ConflictError, InvalidParameterError, NotReadyError, UnknownError
from app.http import upload, views
from app.http.dependencies import Call, CallDep, OneSession
from app.routes import common
from app.routes.common import Cursor, Limit, OnlyName
from app.routes.photos import MAX_PHOTOS, receiving, recorded
from app.schemas import MAX_VERSION, CalibrationOut, JobOut, LateralOut, LensChange, LensOut, NewLens, Page
from app.store.lenses import report_key
from app.store.tables import LensRow
from lensmodel.core.errors import NoSamplesError
from lensmodel.core.files import from_json, to_json
from lensmodel.core.names import camera_name, full_name
from lensmodel.model.profile import LensProfile, write_profile
from lensmodel.report.export import to_csv
from lensmodel.report.lens_report import LensReport, provenance

router = APIRouter(tags=["lenses"], route_class=OneSession)

_PROFILE: Final = {"application/zip": {"schema": {"type": "string", "format": "binary"}}}
# Photos whose names a report looks at, at most (chosen): it lists some, and says how many more there are
_NAMED: Final = 1000
Form = Literal["json", "csv", "pdf"]
FORMS: Final[dict[Form, str]] = {
    "json": "application/json",
    "csv": "text/csv; charset=utf-8",
    "pdf": "application/pdf",
}
_REPORT: Final = {kind.partition(";")[0]: {"schema": {"type": "string"}} for kind in FORMS.values()}


@router.get("/lenses")
def list_lenses(
    call: CallDep, limit: Limit = 50, cursor: Cursor = None, model: OnlyName = None, serial: OnlyName = None
) -> Page[LensOut]:
    """List lenses, newest first, optionally of one model or serial."""
    rows = call.store.lenses.page(call.owner, before=cursor, limit=limit + 1, model=model, serial=serial)
    coverage = call.store.lenses.coverage_of(rows)
    return call.page(rows, limit, lambda row: _lens_out(row, *coverage[row.id]))


@router.get("/lenses/{lens_id}")
def get_lens(lens_id: str, call: CallDep) -> LensOut:
    """Return one lens."""
    lens = call.lens(lens_id)
    return _lens_out(lens, *call.store.lenses.coverage_of([lens])[lens.id])


def _lens_out(row: LensRow, apertures: list[float], focals: list[float]) -> LensOut:
    return LensOut.of(row, apertures=apertures, focal_lengths_mm=focals)


@router.post("/lenses", status_code=201)
def create_lens(new: NewLens, call: CallDep) -> LensOut:
    """Create a lens, to add a profile to; photos create theirs by themselves."""
    return get_lens(call.store.lenses.create(call.owner, new.label), call)


@router.patch("/lenses/{lens_id}")
def change_lens(lens_id: str, change: LensChange, call: CallDep) -> LensOut:
    """Rename a lens, or merge it into another.

    Merged, its photos teach the other lens, which is returned, and it is forgotten; lenses that seem to be
    two are merged only with `any_lens`.
    """
    lens = call.lens(lens_id)
    if len(change.model_fields_set - {"any_lens"}) != 1:
        raise InvalidParameterError("send label or merge_into")
    if change.merge_into is None:
        call.store.lenses.rename(lens_id, call.owner, change.label)
        return get_lens(lens_id, call)
    target = call.lens(change.merge_into)
    if target.id == lens.id:
        raise InvalidParameterError("merge_into names the lens itself: name the other one")
    if not change.any_lens:
        common.check_same_lens(call, target, lens, "the two seem to be different lenses")
    if not call.store.lenses.merge(lens_id, change.merge_into, call.owner):
        raise ConflictError(f"lens {lens_id} still learns from photos: wait for their jobs, then merge")
    return get_lens(change.merge_into, call)


@router.delete("/lenses/{lens_id}", status_code=204)
def delete_lens(lens_id: str, call: CallDep) -> None:
    """Delete a lens with its serial and all that was learned of it; its photos stay and can be corrected."""
    if not call.store.lenses.delete(lens_id, call.owner):
        raise UnknownError("lens", lens_id)


@router.get("/lenses/{lens_id}/calibrations")
def list_calibrations(
    lens_id: str,
    call: CallDep,
    limit: Limit = 200,
    cursor: Annotated[int, Query(ge=0, le=MAX_VERSION, description="from `next` of the page before")] = 0,
) -> Page[CalibrationOut]:
    """Return the history of a lens, oldest first: one item for each version."""
    rows = call.store.lenses.history(call.lens(lens_id), after=cursor, limit=limit + 1)
    return call.page(rows, limit, CalibrationOut.of, lambda row: str(row.version))


@router.get("/lenses/{lens_id}/lateral-colour")
def get_lateral_colour(lens_id: str, call: CallDep) -> LateralOut:
    """Return the lateral colour shift, which the kernels do not contain.

    The median over the counted photos, coefficient by coefficient: one photo without edges near
    the corners cannot spoil it.
    """
    lens = call.lens(lens_id)
    shifts = call.store.lenses.lateral_of(lens)
    # of photos with measured points: those of the others are zero by default
    known = {
        colour: [shift[colour] for shift in shifts if shift[f"{colour}_points"] > 0]
        for colour in ("red", "blue")
    }
    if not all(known.values()):
        raise NoSamplesError(
            f"lens {lens_id} has no photo whose lateral colour could be measured: "
            "upload one in colour with detail near its corners"
        )
    middles = {
        colour: [median(terms) for terms in zip(*those, strict=True)] for colour, those in known.items()
    }
    about = {"lens_id": lens_id, "version": lens.version, "photos": min(map(len, known.values()))}
    return LateralOut.model_validate({**about, **middles})


# --- profiles -----------------------------------------------------------------------------------------


@router.get(
    "/lenses/{lens_id}/profile",
    response_class=Response,
    responses=common.file_answer("application/zip", "A .lensprofile"),
)
def get_lens_profile(lens_id: str, call: CallDep) -> Response:
    """Return all that was learned of a lens as one file, which the command line reads too."""
    lens = call.lens(lens_id)
    model = call.models.get(lens_id).model
    rows = call.store.photos.page(call.owner, before=None, limit=MAX_PHOTOS, lens_id=lens_id)
    learned = {sample.photo for sample in model.samples}
    photos = {row.public_id: row.filename for row in rows if row.public_id in learned}
    out = io.BytesIO()
    write_profile(out, LensProfile(model, lens.names, photos))
    name = lens.label or full_name(lens.maker, lens.model) or "lens"
    headers = common.file_headers(f"{name}.lensprofile")
    return Response(out.getvalue(), media_type="application/zip", headers=headers)


@router.put(
    "/lenses/{lens_id}/profile",
    status_code=202,
    openapi_extra={"requestBody": {"required": True, "content": _PROFILE}},
)
async def add_lens_profile(
    lens_id: str,
    call: CallDep,
    any_lens: Annotated[bool, Query(description="also where it seems to be of another lens")] = False,
    rename: Annotated[bool, Query(description="call the lens as the profile does, if it does")] = False,
) -> JobOut:
    """Let what a profile knows join a lens; each of its photos counts as one, without its file.

    A worker reads it, whose job is returned. The same profile a second time changes nothing. It must have
    been learned with the model of the lens.
    """
    await run_in_threadpool(call.lens, lens_id)
    async with receiving(call) as (public_id, key):
        uploaded = await upload.receive_profile(call.request, call.storage, key, lens_id)
    said = {"any_lens": any_lens, "rename": rename}
    job = views.job_out((await run_in_threadpool(recorded, call, public_id, key, uploaded, **said)).photo)
    call.response.headers["Location"] = job.links["self"] or ""
    return job


# --- reports ------------------------------------------------------------------------------------------


def stored_report(call: Call, lens: LensRow) -> LensReport:
    """Return the report of the newest version of a lens, which a worker has made."""
    if lens.sample_count == 0:
        raise NoSamplesError(f"lens {lens.public_id} has no samples yet: upload photos taken with it")
    try:
        stored = call.storage.get(report_key(lens.public_id, lens.version, lens.rebuild_epoch))
    except FileNotFoundError as error:
        raise NotReadyError(
            f"the report of version {lens.version} is not made yet: it comes when that version is measured",
            headers={"Retry-After": "2"},
        ) from error
    return from_json(LensReport, json.loads(stored))


@router.get(
    "/lenses/{lens_id}/report.{form}",
    response_class=Response,
    responses={200: {"content": _REPORT, "description": "Report"}, **common.NOT_CHANGED},
)
def get_lens_report(lens_id: str, form: Form, call: CallDep) -> Response:
    """Return the test of a lens: its first sentence is for photographers, the rest what testers expect."""
    lens = call.lens(lens_id)
    test = stored_report(call, lens)
    tag = f'"{lens.public_id}-v{lens.version}-e{lens.rebuild_epoch}-r-{form}"'
    headers = {"ETag": tag, **common.file_headers(f"{test.name}-report.{form}", inline=form == "pdf")}
    if call.knows(tag):
        return Response(status_code=304, headers=headers)
    photos = call.store.photos.page(call.owner, before=None, limit=_NAMED, lens_id=lens_id, state="counted")
    cameras = [camera_name(photo.camera_maker, photo.camera_model) for photo in photos]
    details = provenance(lens.serial, cameras, [photo.filename for photo in photos])
    test = replace(test, details=details)
    if form == "pdf":
        from lensmodel.report.plots import document  # noqa: PLC0415 - matplotlib is slow to import

        return Response(document(test, form), media_type=FORMS[form], headers=headers)
    text = to_csv(test) if form == "csv" else json.dumps(to_json(test))
    return Response(text, media_type=FORMS[form], headers=headers)
