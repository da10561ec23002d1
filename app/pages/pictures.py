"""Pictures for the pages, as children have made them: the API hands out their bytes and decodes none."""

from __future__ import annotations

from contextlib import suppress
from typing import Annotated, Final, Literal

from fastapi import APIRouter, Depends, Path, Response
from fastapi.responses import StreamingResponse

from app.blobs import tiles
from app.blobs.storage import Storage
from app.errors import NotReadyError
from app.http.dependencies import Call, CallDep, OneSession
from app.jobs.answers import LAYER_FILES, SHOWN, SIDES, THUMBNAIL
from app.store.tables import CorrectionRow

Half = Annotated[int, Path(ge=0, le=12)]  # 2^12 tiles of 512 pixels: more than any photo
Number = Annotated[int, Path(ge=0, le=10_000)]
Kind = Literal["photos", "corrections"]
Which = Literal["before", "after"]  # a photo by itself is as it was before

# Placeholder until there is a picture
NOTHING: Final = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 3 2">'
    '<rect width="3" height="2" fill="#8882"/></svg>'
)

router = APIRouter(include_in_schema=False, route_class=OneSession)


_KEPT: Final = {"Cache-Control": "private, max-age=3600"}


def _picture(data: bytes) -> Response:
    return Response(data, media_type="image/jpeg", headers=_KEPT)


def _file(storage: Storage, key: str, media_type: str) -> Response:
    """Send a file that a child has written, in pieces; FileNotFoundError where there is none."""
    body = storage.stream(key, 0, storage.size(key))
    return StreamingResponse(body, media_type=media_type, headers=_KEPT)


@router.get("/ui/photos/{photo_id}/thumbnail.jpg")
def photo_thumbnail(photo_id: str, call: CallDep) -> Response:
    """Show a photo as small as a list needs it: also before it is developed, and nothing where nothing is."""
    folder = call.photo(photo_id).folder
    with suppress(FileNotFoundError):
        return _file(call.storage, f"{folder}{THUMBNAIL}", "image/jpeg")
    with suppress(NotReadyError):
        return _picture(tiles.whole(call.storage, f"{folder}{SHOWN}"))
    return Response(NOTHING, media_type="image/svg+xml", headers={"Cache-Control": "no-store"})


def _tiles_of(call: CallDep, kind: Kind, subject: str, which: Which) -> str:
    """Return the key of the tiles of a photo, or of one side of a correction."""
    if kind == "photos":
        return f"{call.photo(subject).folder}{SHOWN}"
    return f"{_compared(call, subject).run_folder}{SIDES[which]}"


Tiles = Annotated[str, Depends(_tiles_of)]


@router.get("/ui/{kind}/{subject}/tiles/{which}/whole.jpg")
def whole_picture(call: CallDep, key: Tiles) -> Response:
    """Show a photo as large as most screens are."""
    return _picture(tiles.whole(call.storage, key))


@router.get("/ui/{kind}/{subject}/tiles/{which}/places/{place}.jpg")
def place_of_picture(call: CallDep, key: Tiles, place: Number) -> Response:
    """Show a part of a photo, 1:1."""
    return _picture(tiles.part(call.storage, key, place))


@router.get("/ui/{kind}/{subject}/tiles/{which}/{half}/{col}_{row}.jpg")
def tile_of_picture(call: CallDep, key: Tiles, half: Half, col: Number, row: Number) -> Response:
    """Show a tile of a photo, halved `half` times."""
    return _picture(tiles.tile(call.storage, key, half, col, row))


def _compared(call: Call, correction_id: str) -> CorrectionRow:
    row = call.correction(correction_id)
    if row.state != "succeeded":
        raise NotReadyError(f"correction {correction_id} is {row.state}: wait for its job")
    return row


@router.get("/ui/corrections/{correction_id}/layer/{name}")
def correction_layer(
    correction_id: str, name: Literal["before", "after", "smooth", "clean"], call: CallDep
) -> Response:
    """Show a part of a photo as the sliders of a preview mix it."""
    key = f"{_compared(call, correction_id).run_folder}{LAYER_FILES[name]}"
    try:
        return _file(call.storage, key, "image/png")
    except FileNotFoundError as error:
        text = f"correction {correction_id} has no layer {name}: it is of a whole photo, or without layers"
        raise NotReadyError(text) from error


def exists(storage: Storage, key: str) -> bool:
    """Say whether a picture is stored."""
    try:
        storage.size(key)
    except FileNotFoundError:
        return False
    return True
