"""Reports of lenses, which workers make of each version, in the formats that people and programs read."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Final, Literal

from fastapi import APIRouter, Response, status

from app.errors import NotReadyError
from app.http.dependencies import Call, CallDep, OneSession
from app.routes.common import NOT_CHANGED, file_headers, find_lens, matches_tag
from app.store.lenses import report_key
from app.store.tables import LensRow
from lensmodel.core.codec import from_json, to_json
from lensmodel.core.errors import NoSamplesError
from lensmodel.core.names import camera_name
from lensmodel.report import LensReport, provenance
from lensmodel.report.tables import to_csv

router = APIRouter(tags=["lenses"], route_class=OneSession)

MOST: Final = 1000
"""Photos whose names a report looks at, at most: it lists some, and says how many more there are."""

Form = Literal["json", "csv", "pdf"]
MEDIA_TYPES: Final[dict[Form, str]] = {
    "json": "application/json",
    "csv": "text/csv; charset=utf-8",
    "pdf": "application/pdf",
}
_CONTENT: Final = {kind.partition(";")[0]: {"schema": {"type": "string"}} for kind in MEDIA_TYPES.values()}


def stored_report(call: Call, lens: LensRow) -> LensReport:
    """Return the report of the newest version of a lens."""
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
    operation_id="getLensReport",
    response_class=Response,
    responses={200: {"content": _CONTENT, "description": "Report"}, **NOT_CHANGED},
)
def read_report(
    lens_id: str,
    form: Form,
    call: CallDep,
) -> Response:
    """Return the test of a lens: its first sentence is for photographers, the rest what testers expect."""
    lens = find_lens(call, lens_id)
    test = stored_report(call, lens)
    tag = f'"{lens.public_id}-v{lens.version}-e{lens.rebuild_epoch}-r-{form}"'
    headers = {"ETag": tag, **file_headers(f"{test.name}-report.{form}", inline=form == "pdf")}
    if matches_tag(call, tag):
        return Response(status_code=status.HTTP_304_NOT_MODIFIED, headers=headers)
    photos = call.store.photos.page(call.owner, before=None, limit=MOST, lens_id=lens_id, state="counted")
    details = provenance(
        lens.serial,
        [camera_name(photo.camera_maker, photo.camera_model) for photo in photos],
        [photo.filename for photo in photos],
    )
    body = _written(replace(test, details=details), form)
    return Response(body, media_type=MEDIA_TYPES[form], headers=headers)


def _written(test: LensReport, form: Form) -> bytes:
    if form == "json":
        return json.dumps(to_json(test)).encode()
    if form == "csv":
        return to_csv(test).encode()
    from lensmodel.report.plots import pages, to_pdf  # noqa: PLC0415 - matplotlib is slow to import

    return to_pdf(pages(test))
