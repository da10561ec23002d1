"""The page of a lens, and its charts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Final
from urllib.parse import urlencode

from fastapi import APIRouter, Query
from fastapi.responses import HTMLResponse
from pydantic import BeforeValidator, TypeAdapter

from app.errors import NotReadyError
from app.http.dependencies import Call, CallDep, OneSession
from app.pages import shown, words
from app.pages.rendering import page
from app.routes import lenses as lens_routes
from app.routes.common import find_lens
from app.routes.lenses import stored_report
from app.schemas import Aperture, CalibrationOut, blank_is_none
from app.store.tables import LensRow
from lensmodel.core.errors import NoSamplesError
from lensmodel.core.types import ZONES
from lensmodel.report import LensReport, Side, Unit, compare
from lensmodel.report.tables import place_table

if TYPE_CHECKING:
    from lensmodel.report.plots import Chart

SHOWN_VERSIONS: Final = 200  # Versions of the history on the page (chosen): the newest of them
# Width over height before there are photos: that of a full-frame sensor, 36 x 24 mm
DEFAULT_ASPECT: Final = 1.5
_APERTURE: Final = TypeAdapter[float](Aperture)
ChosenAperture = Annotated[Aperture | None, BeforeValidator(blank_is_none), Query()]  # of a form
router = APIRouter(include_in_schema=False, route_class=OneSession)


@router.get("/lenses/{lens_id}")
def lens_page(lens_id: str, call: CallDep, aperture: ChosenAperture = None) -> HTMLResponse:
    """Show what a lens does to pictures, whether it is a good copy, and which photo would help."""
    lens, row = lens_routes.get_lens(lens_id, call), find_lens(call, lens_id)
    photos, more = shown.photos(call, lens_id)
    aspect, test = _aspect(call, row), _test(call, row)
    apertures = lens.apertures if test is None else [number for number in test.apertures if number]
    chosen = aperture or (apertures[0] if apertures else None)
    question = {"size": 25, "aspect": aspect} | ({} if chosen is None else {"aperture": chosen})

    def map_of(cells: int) -> str:
        rows = max(2, round(math.sqrt(cells / aspect)))
        grid = f"{max(2, round(rows * aspect))}x{rows}"
        return f"/v1/lenses/{lens_id}/field.png?{urlencode({'grid': grid, **question})}"

    return page(
        "lens.html",
        lens=lens,
        counting=shown.counting(call, lens_id),
        photos=photos,
        more=more,
        others=[other for other in shown.lenses_with_photos(call) if other.id != lens_id],
        aspect=aspect,
        apertures=apertures,
        aperture=chosen,
        map_of=map_of,
        test=test,
        found=None if test is None else test.at(chosen),
    )


@router.get("/lenses/{lens_id}/tests")
def lens_tests(lens_id: str, call: CallDep) -> HTMLResponse:
    """Show what testers and researchers ask of a lens: charts, its blur at any point, its versions."""
    lens, row = lens_routes.get_lens(lens_id, call), find_lens(call, lens_id)
    before = max(lens.version - SHOWN_VERSIONS, 0)  # the newest are shown
    history = lens_routes.list_calibrations(lens_id, call, limit=SHOWN_VERSIONS, cursor=before).items
    photos, _ = shown.photos(call, lens_id)
    aspect, test = _aspect(call, row), _test(call, row)
    gone = max((event.version for event in history if event.kind != "photo_added"), default=0)
    return page(
        "lens_tests.html",
        lens=lens,
        counting=shown.counting(call, lens_id),
        history=history,
        curve=_error_history(history),
        versions=[e.version for e in reversed(history) if e.version >= max(gone, 1) and e.samples],
        names={photo.id: photo.filename for photo in photos},
        aspect=aspect,
        comparable=[other for other in shown.lenses(call) if other.id != lens_id and other.samples],
        test=test,
        **({} if test is None else _charts(test, None, "c/px")),
    )


@router.get("/ui/lenses/{lens_id}/charts")
def lens_charts(
    lens_id: str,
    call: CallDep,
    aperture: ChosenAperture = None,
    unit: Unit = "c/px",
    against: Annotated[str, Query(max_length=60)] = "",
) -> HTMLResponse:
    """Show the charts of one aperture, or two lenses or apertures in one."""
    from lensmodel.report.plots import comparison_charts  # noqa: PLC0415 - matplotlib is slow to import

    test = stored_report(call, find_lens(call, lens_id))
    at = _APERTURE.validate_python(against.removeprefix("at ")) if against.startswith("at ") else None
    if not against or (at is not None and at == aperture):
        return page("_charts.html", **_charts(test, aperture, unit))
    if at is not None:  # two apertures of one lens
        sides = [Side(words.f_stop(number or 0.0), test.at(number)) for number in (aperture, at)]
    else:
        other = stored_report(call, find_lens(call, against))
        same = aperture if aperture in other.apertures else None
        sides = [Side(test.name, test.at(aperture)), Side(other.name, other.at(same))]
    comparison = compare(*sides)
    return page("_charts.html", comparison=comparison, charts=comparison_charts(comparison))


def _charts(test: LensReport, aperture: float | None, unit: Unit) -> dict[str, Any]:
    from lensmodel.report.plots import charts  # noqa: PLC0415 - as above

    return {"charts": charts(test, aperture, unit), "table": place_table(test)}


def _error_history(history: Sequence[CalibrationOut]) -> Chart | None:
    """Draw the errors of versions that were measured; None where one point would be no curve."""
    from lensmodel.report.plots import error_history  # noqa: PLC0415 - as above

    measured = [(event.version, event.error) for event in history if isinstance(event.error, Mapping)]
    if len(measured) < 2:
        return None
    errors = {zone: [error.get(zone) for _, error in measured] for zone in ZONES}
    return error_history([version for version, _ in measured], errors)


def _test(call: Call, lens: LensRow) -> LensReport | None:
    try:
        return stored_report(call, lens)
    except (NotReadyError, NoSamplesError):
        return None


def _aspect(call: Call, lens: LensRow) -> float:
    """Return the commonest width over height of the photos of a lens, in sensor orientation."""
    shape = call.store.lenses.shape_of(lens)
    return DEFAULT_ASPECT if shape is None else round(shape[1] / shape[0], 4)
