"""The page of a lens, and its charts."""

from __future__ import annotations

import math
from typing import Annotated, Any, Final
from urllib.parse import urlencode

from fastapi import APIRouter, Query
from fastapi.responses import HTMLResponse
from pydantic import TypeAdapter, ValidationError

from app.errors import InvalidParameterError, NotReadyError
from app.http.dependencies import Call, CallDep
from app.pages import shown, words
from app.pages.rendering import page
from app.routes import lenses as lens_routes
from app.routes.lens_reports import stored_report
from app.schemas import PhotoOut
from app.schemas.fields import Aperture
from app.store.tables import LensRow
from lensmodel.core.errors import NoSamplesError
from lensmodel.core.types import FieldPosition
from lensmodel.report.charts import apertures_chart, charts_of, lateral_chart
from lensmodel.report.comparison import Side, compare
from lensmodel.report.documents import error_words, zone_table
from lensmodel.report.lens_test import LensTest
from lensmodel.report.units import Unit

SHOWN_VERSIONS: Final = 200
DEFAULT_ASPECT: Final = 1.5
_APERTURE: Final = TypeAdapter[float](Aperture)

router = APIRouter(include_in_schema=False)


@router.get("/lenses/{lens_id}")
def lens_page(lens_id: str, call: CallDep) -> HTMLResponse:
    """Show a lens: its field of blur, its charts, its history, its photos."""
    lens = lens_routes.read_lens(lens_id, call)
    row = lens_routes.find_lens(call, lens_id)
    before = max(lens.version - SHOWN_VERSIONS, 0)  # the newest are shown
    history = lens_routes.list_calibrations(lens_id, call, limit=SHOWN_VERSIONS, cursor=before).items
    photos, more = shown.photos(call, lens_id)
    seen = _seen(call, photos)
    newest = next((event.coverage for event in reversed(history) if event.coverage), None)
    aspect = _aspect(call, row)
    test = _test(call, row)
    gone = max((event.version for event in history if event.kind != "photo_added"), default=0)
    return page(
        "lens.html",
        lens=lens,
        counting=shown.counting(call, lens_id),
        anew=shown.anew(call, lens_id),
        history=history,
        versions=[e.version for e in reversed(history) if e.version >= max(gone, 1) and e.samples],
        names={photo.id: photo.filename for photo in photos},
        coverage=words.coverage_bars(newest),
        seen=seen,
        aspect=aspect,
        spots=_spots(seen, aspect),
        photos=photos,
        more=more,
        others=[other for other in shown.lenses(call) if other.id != lens_id],
        comparable=[other for other in shown.lenses(call) if other.id != lens_id and other.samples],
        test=test,
        centring=None if test is None else test.tested[0].report.decentring,
        **({} if test is None else _charts(test, None, "c/px")),
    )


@router.get("/ui/lenses/{lens_id}/charts")
def lens_charts(
    lens_id: str,
    call: CallDep,
    aperture: Annotated[str, Query(max_length=20)] = "",
    unit: Unit = "c/px",
    against: Annotated[str, Query(max_length=60)] = "",
) -> HTMLResponse:
    """Show the charts of one aperture, or two lenses or apertures in one."""
    test = stored_report(call, lens_routes.find_lens(call, lens_id))
    chosen = _aperture(aperture)
    with_itself = against.startswith("at ") and _aperture(against.removeprefix("at ")) == chosen
    if not against or with_itself:
        return page("_charts.html", **_charts(test, chosen, unit))
    if against.startswith("at "):
        other = test
        other_aperture = _aperture(against.removeprefix("at "))
        query = {"aperture": aperture, "against_aperture": against.removeprefix("at ")}
    else:
        other = stored_report(call, lens_routes.find_lens(call, against))
        other_aperture = chosen if chosen in other.apertures else None
        query = {"aperture": aperture, "against": against}
    one, two = test.at(chosen), other.at(other_aperture)
    sides = [
        Side(name if other is not test else words.f_stop(tested.report.settings.aperture or 0.0), tested)
        for name, tested in ((test.name, one), (other.name, two))
    ]
    return page(
        "_charts.html",
        comparison=compare(*sides),
        comparison_link=f"/v1/lenses/{lens_id}/report",
        comparison_query=urlencode({name: value for name, value in query.items() if value}),
    )


def _aperture(text: str) -> float | None:
    """Return the f-number that a form sends; None where it sends nothing.

    Raises
    ------
    InvalidParameterError
        If it is no f-number.
    """
    try:
        return _APERTURE.validate_python(text) if text else None
    except ValidationError as error:
        raise InvalidParameterError(
            f"aperture must be an f-number between 0.5 and 128, got {text!r}"
        ) from error


def _charts(test: LensTest, aperture: float | None, unit: Unit) -> dict[str, Any]:
    charts = [
        *charts_of(test, aperture, unit),
        *(chart for chart in (apertures_chart(test, unit), lateral_chart(test)) if chart is not None),
    ]
    return {
        "charts": charts,
        "table": zone_table(test),
        "error_note": error_words(test.at(aperture)),
    }


def _test(call: Call, lens: LensRow) -> LensTest | None:
    try:
        return stored_report(call, lens)
    except (NotReadyError, NoSamplesError):
        return None


def _aspect(call: Call, lens: LensRow) -> float:
    """Width over height of most photos of a lens, as the sensor has them."""
    shape = call.store.lenses.shape_of(lens)
    return DEFAULT_ASPECT if shape is None else round(shape[1] / shape[0], 4)


def _spots(seen: list[FieldPosition], aspect: float) -> list[tuple[float, float]]:
    """Return where places lie in a picture, as shares of its width and height from the top left."""
    corner = math.hypot(aspect, 1.0)
    return [
        (
            0.5 + corner * p.r * math.cos(p.phi) / (2.0 * aspect),
            0.5 - corner * p.r * math.sin(p.phi) / 2.0,
        )
        for p in seen
    ]


def _seen(call: Call, photos: list[PhotoOut]) -> list[FieldPosition]:
    """Return where patches of counted photos gave a PSF."""
    return [
        FieldPosition(patch.r, patch.phi)
        for photo in photos
        if photo.state == "counted"
        for patch in call.store.patches.all_of(photo.id)
        if patch.state == "done"
    ]
