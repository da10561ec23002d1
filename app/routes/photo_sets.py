"""Several photos at once: name the lens of all that wait for it."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter

from app.errors import InvalidParameterError
from app.http.dependencies import CallDep
from app.routes.common import named_lens, problems
from app.routes.photos import described_photo, find_photo
from app.schemas import PhotoPage, PhotosChange
from app.store.photo_steps import GIVEN_SETTINGS
from app.store.photos import NewCopy

router = APIRouter(tags=["photos"])


@router.patch("/photos", operation_id="changePhotos", responses=problems(404, 409, 422))
def change_photos(change: PhotosChange, call: CallDep) -> PhotoPage:
    """Name the lens of several photos, or correct their settings; a new lens becomes that of them all.

    Each photo changes as by itself; where one is gone or refuses nothing changes.
    """
    if (change.lens_id is None) == (change.new_lens is None) and not change.model_fields_set & {
        *GIVEN_SETTINGS
    }:
        raise InvalidParameterError("send lens_id or new_lens, or the settings of these photos")
    if change.lens_id is not None and change.new_lens is not None:
        raise InvalidParameterError("lens_id and new_lens each name the lens: send one of them")
    if change.lens_id is not None:
        named_lens(call, change.lens_id)
    keys = list(dict.fromkeys(change.photo_ids))
    given: dict[str, Any] = change.model_dump(include=set(GIVEN_SETTINGS), exclude_none=True)
    lens = change.lens_id if change.new_lens is None else NewCopy(change.new_lens.label)
    call.store.photos.change_several(keys, call.owner, given, lens)
    items = [described_photo(call, find_photo(call, key)) for key in keys]
    return PhotoPage(items=items, next=None)
