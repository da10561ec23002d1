"""What an owner does with a lens as a whole: names it, joins it with another, goes back."""

from __future__ import annotations

from fastapi import APIRouter
from pydantic import Field

from app.errors import ConflictError, InvalidParameterError
from app.http.dependencies import CallDep
from app.routes.common import problems
from app.routes.lenses import find_lens, read_lens
from app.schemas import LensOut
from app.schemas.fields import MAX_VERSION, Id, Name, Question

router = APIRouter(tags=["lenses"])


class LensChange(Question):
    """What to change about a lens: one of these."""

    label: Name | None = Field(None, description="what its owner calls it; null takes the name away")
    merge_into: Id | None = Field(None, description="the lens that this one is a part of")
    back_to: int | None = Field(
        None, ge=1, le=MAX_VERSION, description="a version: photos that joined later are left out"
    )


@router.patch("/lenses/{lens_id}", operation_id="changeLens", responses=problems(404, 409, 422))
def change_lens(lens_id: str, change: LensChange, call: CallDep) -> LensOut:
    """Rename a lens, merge it into another, or go back to an earlier version.

    Merged, its photos teach the other lens, which is returned, and it is forgotten. Going back leaves out
    the photos that joined later; they stay, and can be included again.
    """
    lens = find_lens(call, lens_id)
    if len(change.model_fields_set) != 1:
        raise InvalidParameterError("send one of label, merge_into and back_to")
    changes = call.store.lens_changes
    if change.merge_into is not None:
        target = find_lens(call, change.merge_into)
        if target.id == lens.id:
            raise InvalidParameterError("merge_into names the lens itself: name the other one")
        if not changes.merge(lens_id, change.merge_into, call.owner):
            raise ConflictError(f"lens {lens_id} still learns from photos: wait for their jobs, then merge")
        return read_lens(change.merge_into, call)
    if change.back_to is not None:
        if change.back_to >= lens.version:
            raise InvalidParameterError(f"back_to must be below {lens.version}, the newest version")
        changes.go_back(lens_id, call.owner, change.back_to)
        return read_lens(lens_id, call)
    changes.rename(lens_id, call.owner, change.label)
    return read_lens(lens_id, call)
