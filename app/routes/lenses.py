"""Lenses: what is known of each copy, its history, and what its owner does with it as a whole."""

from __future__ import annotations

from statistics import median
from typing import Annotated, Any

from fastapi import APIRouter, Query, status
from pydantic import Field

from app.errors import ConflictError, InvalidParameterError, UnknownError
from app.http import views
from app.http.dependencies import CallDep, OneSession
from app.other_lens import REMEDY, difference
from app.routes.common import Cursor, Limit, OnlyName, described_lens, find_lens, next_link, paged
from app.schemas import MAX_VERSION, CalibrationOut, Id, LateralOut, LensOut, Name, Page, Question
from lensmodel.core.errors import NoSamplesError

router = APIRouter(tags=["lenses"], route_class=OneSession)


@router.get("/lenses", operation_id="listLenses")
def list_lenses(
    call: CallDep, limit: Limit = 50, cursor: Cursor = None, model: OnlyName = None, serial: OnlyName = None
) -> Page[LensOut]:
    """List lenses, newest first, optionally of one model or serial."""
    rows = call.store.lenses.page(call.owner, before=cursor, limit=limit + 1, model=model, serial=serial)
    coverage = call.store.lenses.coverage_of(rows)
    return paged(call, rows, limit, lambda row: views.lens_out(row, *coverage[row.id]))


@router.get("/lenses/{lens_id}", operation_id="getLens")
def read_lens(lens_id: str, call: CallDep) -> LensOut:
    """Return one lens."""
    lens = find_lens(call, lens_id)
    return views.lens_out(lens, *call.store.lenses.coverage_of([lens])[lens.id])


class LensChange(Question):
    """What to change about a lens: one of these."""

    label: Name | None = Field(None, description="what its owner calls it; null takes the name away")
    merge_into: Id | None = Field(None, description="the lens that this one is a part of")
    any_lens: bool = Field(default=False, description="merge lenses too that seem to be two")


class LensIn(Question):
    """A lens of which nothing is known yet but its name."""

    label: Name = Field(description="what its owner calls it")


@router.post("/lenses", operation_id="createLens", status_code=status.HTTP_201_CREATED)
def create_lens(new: LensIn, call: CallDep) -> LensOut:
    """Create a lens, to add a profile to; photos create theirs by themselves."""
    return read_lens(call.store.lenses.create(call.owner, new.label), call)


@router.patch("/lenses/{lens_id}", operation_id="changeLens")
def change_lens(lens_id: str, change: LensChange, call: CallDep) -> LensOut:
    """Rename a lens, or merge it into another.

    Merged, its photos teach the other lens, which is returned, and it is forgotten; lenses that seem to be
    two are merged only with `any_lens`.
    """
    lens = find_lens(call, lens_id)
    if len(change.model_fields_set - {"any_lens"}) != 1:
        raise InvalidParameterError("send label or merge_into")
    lenses = call.store.lenses
    if change.merge_into is not None:
        target = find_lens(call, change.merge_into)
        if target.id == lens.id:
            raise InvalidParameterError("merge_into names the lens itself: name the other one")
        why = (
            None if change.any_lens else difference(described_lens(call, target), described_lens(call, lens))
        )
        if why is not None:
            raise ConflictError(f"the two seem to be different lenses: {why}; {REMEDY}", code="other_lens")
        if not lenses.merge(lens_id, change.merge_into, call.owner):
            raise ConflictError(f"lens {lens_id} still learns from photos: wait for their jobs, then merge")
        return read_lens(change.merge_into, call)
    lenses.rename(lens_id, call.owner, change.label)
    return read_lens(lens_id, call)


@router.delete("/lenses/{lens_id}", operation_id="deleteLens", status_code=status.HTTP_204_NO_CONTENT)
def delete_lens(lens_id: str, call: CallDep) -> None:
    """Delete a lens with its serial and all that was learned of it; its photos stay and can be corrected."""
    if not call.store.lenses.delete(lens_id, call.owner):
        raise UnknownError("lens", lens_id)


@router.get("/lenses/{lens_id}/calibrations", operation_id="listCalibrations")
def list_calibrations(
    lens_id: str,
    call: CallDep,
    limit: Limit = 200,
    cursor: Annotated[int, Query(ge=0, le=MAX_VERSION, description="from `next` of the page before")] = 0,
) -> Page[CalibrationOut]:
    """Return the history of a lens, oldest first: one item for each version."""
    lens = find_lens(call, lens_id)
    rows = call.store.lenses.history(lens, after=cursor, limit=limit + 1)
    following = str(rows[limit - 1].version) if len(rows) > limit else None
    items = [views.calibration_out(row) for row in rows[:limit]]
    return Page[CalibrationOut](items=items, next=next_link(call, following))


@router.get("/lenses/{lens_id}/lateral-colour", operation_id="getLateralColour")
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
