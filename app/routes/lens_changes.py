"""What an owner does with a lens as a whole: names it, joins it with another, goes back."""

from __future__ import annotations

from fastapi import APIRouter, status
from pydantic import Field

from app.errors import ConflictError, InvalidParameterError
from app.http.dependencies import Call, CallDep
from app.routes.common import problems
from app.routes.lenses import find_lens, read_lens
from app.schemas import LensOut
from app.schemas.fields import MAX_VERSION, Id, Name, PsfModel, Question
from app.store.tables import LensRow

router = APIRouter(tags=["lenses"])


class LensChange(Question):
    """What to change about a lens: one of these."""

    label: Name | None = Field(None, description="what its owner calls it; null takes the name away")
    model: PsfModel | None = Field(
        None, description="how it is learned: default, or the paper's own way", examples=["paper"]
    )
    merge_into: Id | None = Field(None, description="the lens that this one is a part of")
    back_to: int | None = Field(
        None, ge=1, le=MAX_VERSION, description="a version: photos that joined later are left out"
    )


class LensIn(Question):
    """A lens of which nothing is known yet but its name."""

    label: Name = Field(description="what its owner calls it")


@router.post(
    "/lenses", operation_id="createLens", status_code=status.HTTP_201_CREATED, responses=problems(422)
)
def create_lens(new: LensIn, call: CallDep) -> LensOut:
    """Create a lens, to add a profile to; photos create theirs by themselves."""
    return read_lens(call.store.lens_changes.create(call.owner, new.label), call)


@router.patch("/lenses/{lens_id}", operation_id="changeLens", responses=problems(404, 409, 422))
def change_lens(lens_id: str, change: LensChange, call: CallDep) -> LensOut:
    """Rename a lens, change its model, merge it into another, or go back to an earlier version.

    With another model all its photos are estimated anew in the background; until they are it answers as
    before, and can be changed back at once. Merged, its photos teach the other lens, which is returned, and
    it is forgotten. Going back leaves out the photos that joined later; they stay, and can be included again.
    """
    lens = find_lens(call, lens_id)
    if len(change.model_fields_set) != 1:
        raise InvalidParameterError("send one of label, model, merge_into and back_to")
    changes = call.store.lens_changes
    if "model" in change.model_fields_set:
        _change_model(lens, change.model, call)
        return read_lens(lens_id, call)
    if change.merge_into is not None:
        target = find_lens(call, change.merge_into)
        if target.id == lens.id:
            raise InvalidParameterError("merge_into names the lens itself: name the other one")
        if len({lens.way, lens.answering_way, target.way, target.answering_way}) > 1:
            raise ConflictError(
                f"lens {lens_id} has the model {lens.way}, and {change.merge_into} {target.way}: PATCH one "
                'of them with {"model"}, wait until its photos are estimated anew, then merge'
            )
        if not changes.merge(lens_id, change.merge_into, call.owner):
            raise ConflictError(f"lens {lens_id} still learns from photos: wait for their jobs, then merge")
        return read_lens(change.merge_into, call)
    if change.back_to is not None:
        if change.back_to >= lens.version:
            raise InvalidParameterError(f"back_to must be below {lens.version}, the newest version")
        if changes.go_back(lens_id, call.owner, change.back_to) is None:
            raise ConflictError(
                f"photos of lens {lens_id} are being estimated anew for the model {lens.way}: wait for them, "
                f'or PATCH {{"model": "{lens.answering_way}"}} to give that up, then go back'
            )
        return read_lens(lens_id, call)
    changes.rename(lens_id, call.owner, change.label)
    return read_lens(lens_id, call)


def _change_model(lens: LensRow, model: PsfModel | None, call: Call) -> None:
    if model is None:
        raise InvalidParameterError("model=null: send default or paper")
    missing = call.store.lens_changes.choose_way(lens.public_id, call.owner, model)
    if missing:
        raise ConflictError(
            f"{missing} of the photos that lens {lens.public_id} counts cannot be estimated anew: their "
            "files are not kept; send them again, or leave them out (PATCH /v1/photos/{id} with "
            "excluded=true)"
        )
