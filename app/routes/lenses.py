"""Lenses: what is known of each copy, and its history."""

from __future__ import annotations

from statistics import median
from typing import Annotated, Any

from fastapi import APIRouter, Query, status

from app.errors import UnknownLensError
from app.http import views
from app.http.dependencies import Call, CallDep
from app.routes.common import Cursor, Limit, OnlyName, cut, next_link, problems
from app.schemas import MAX_VERSION, CalibrationPage, LateralOut, LensOut, LensPage
from app.store.tables import LensRow
from lensmodel.core.errors import NoSamplesError

router = APIRouter(tags=["lenses"])


def find_lens(call: Call, lens_id: str) -> LensRow:
    """Return a lens of the owner."""
    lens = call.store.lenses.get(lens_id, call.owner)
    if lens is None:
        raise UnknownLensError(f"there is no lens {lens_id[:60]}: GET /v1/lenses lists those there are")
    return lens


@router.get("/lenses", operation_id="listLenses", responses=problems(422))
def list_lenses(
    call: CallDep,
    limit: Limit = 50,
    cursor: Cursor = None,
    model: OnlyName = None,
    serial: OnlyName = None,
) -> LensPage:
    """List lenses, newest first, optionally of one model or serial."""
    rows = call.store.lenses.page(call.owner, before=cursor, limit=limit + 1, model=model, serial=serial)
    page, following = cut(rows, limit)
    coverage = call.store.lenses.coverage_of(page)
    items = [views.lens_out(row, *coverage[row.id]) for row in page]
    return LensPage(items=items, next=next_link(call, following))


@router.get("/lenses/{lens_id}", operation_id="getLens", responses=problems(404, 422))
def read_lens(lens_id: str, call: CallDep) -> LensOut:
    """Return one lens."""
    lens = find_lens(call, lens_id)
    return views.lens_out(lens, *call.store.lenses.coverage_of([lens])[lens.id])


@router.delete(
    "/lenses/{lens_id}",
    operation_id="deleteLens",
    status_code=status.HTTP_204_NO_CONTENT,
    responses=problems(404, 422),
)
def delete_lens(lens_id: str, call: CallDep) -> None:
    """Delete a lens with its serial and all that was learned of it; its photos stay and can be corrected."""
    if not call.store.removal.lens(lens_id, call.owner):
        raise UnknownLensError(f"there is no lens {lens_id[:60]}: it may be deleted already")


@router.get("/lenses/{lens_id}/calibrations", operation_id="listCalibrations", responses=problems(404, 422))
def list_calibrations(
    lens_id: str,
    call: CallDep,
    limit: Limit = 200,
    cursor: Annotated[int, Query(ge=0, le=MAX_VERSION, description="from `next` of the page before")] = 0,
) -> CalibrationPage:
    """Return the history of a lens, oldest first: one item for each version."""
    lens = find_lens(call, lens_id)
    rows = call.store.lenses.history(lens, after=cursor, limit=limit + 1)
    following = str(rows[limit - 1].version) if len(rows) > limit else None
    items = [views.calibration_out(row) for row in rows[:limit]]
    return CalibrationPage(items=items, next=next_link(call, following))


@router.get(
    "/lenses/{lens_id}/lateral-colour", operation_id="getLateralColour", responses=problems(404, 409, 422)
)
def read_lateral_colour(lens_id: str, call: CallDep) -> LateralOut:
    """Return the lateral colour shift, which the kernels do not contain.

    The median over the counted photos, coefficient by coefficient: one photo without edges near
    the corners cannot spoil it.
    """
    lens = find_lens(call, lens_id)
    lateral = call.store.lenses.lateral_of(lens)
    red, blue = (_measured(lateral, colour) for colour in ("red", "blue"))
    if not red or not blue:
        raise NoSamplesError(
            f"lens {lens_id} has no photo whose lateral colour could be measured: "
            "upload one in colour with detail near its corners"
        )
    return LateralOut(
        lens_id=lens.public_id,
        version=lens.version,
        photos=min(len(red), len(blue)),
        red=_middle(red),
        blue=_middle(blue),
    )


def _measured(entries: list[dict[str, Any]], colour: str) -> list[list[float]]:
    """Return the polynomials of photos with measured points; those of the others are zero by default."""
    return [entry[colour] for entry in entries if entry[f"{colour}_points"] > 0]


def _middle(polynomials: list[list[float]]) -> tuple[float, float, float, float]:
    a, b, c, v = (median(terms) for terms in zip(*polynomials, strict=True))
    return a, b, c, v
