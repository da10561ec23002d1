"""Pictures for the pages: small ones, tiles of whole photos, crops, and the layers of a preview."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from fastapi import APIRouter, Path, Query, Response

from app.errors import InvalidParameterError, NotReadyError
from app.http.dependencies import Call, CallDep
from app.jobs.task_files import AFTER, BEFORE, LAYERS, PREVIEW, R_MAP, SHOWN, THUMBNAIL
from app.pages import pictures
from app.routes import corrections as correction_routes
from app.routes import photos as photo_routes
from app.store.corrections import CorrectionPlan, run_folder
from app.store.photo_steps import photo_folder

Share = Annotated[float, Query(ge=0, le=1, allow_inf_nan=False)]
Side = Annotated[int, Query(ge=16, le=2000)]
Half = Annotated[int, Path(ge=0, le=12)]  # 2^12 tiles of 512 pixels: more than any photo
Number = Annotated[int, Path(ge=0, le=10_000)]
Which = Literal["before", "after"]

WHOLE: Final = 1600
"""Longer side in pixels of the picture that is shown until the tiles are loaded (chosen):
that of a preview."""

NOTHING: Final = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 3 2">'
    '<rect width="3" height="2" fill="#8882"/></svg>'
)
"""Placeholder until there is a picture."""

_OF: Final = {"before": BEFORE, "after": AFTER, "smooth": LAYERS[0], "clean": LAYERS[1]}

router = APIRouter(include_in_schema=False)


def _picture(data: bytes, media_type: str = "image/jpeg") -> Response:
    return Response(data, media_type=media_type, headers={"Cache-Control": "private, max-age=3600"})


# --- a photo -------------------------------------------------------------------------------------


@router.get("/ui/photos/{photo_id}/thumbnail.jpg")
def photo_thumbnail(photo_id: str, call: CallDep) -> Response:
    """Show a photo as small as a list needs it: also before it is developed, and nothing where nothing is."""
    folder = photo_folder(photo_routes.find_photo(call, photo_id))
    for name in (THUMBNAIL, PREVIEW):
        if pictures.exists(call.storage, f"{folder}{name}"):
            return _picture(pictures.shrunk_preview(pictures.stored(call.storage, f"{folder}{name}"), 480))
    return Response(NOTHING, media_type="image/svg+xml", headers={"Cache-Control": "no-store"})


@router.get("/ui/photos/{photo_id}/preview.jpg")
def photo_preview(photo_id: str, call: CallDep, size: Side = 1200) -> Response:
    """Show a photo in small."""
    key = f"{photo_folder(photo_routes.find_photo(call, photo_id))}{PREVIEW}"
    return _picture(pictures.shrunk_preview(pictures.stored(call.storage, key), size))


@router.get("/ui/photos/{photo_id}/r-map.png")
def photo_r_map(photo_id: str, call: CallDep, size: Side = 1200) -> Response:
    """Show where the edges of a photo tell about the blur."""
    key = f"{photo_folder(photo_routes.find_photo(call, photo_id))}{R_MAP}"
    return _picture(pictures.shrunk_preview(pictures.stored(call.storage, key), size), "image/png")


def _shown(call: Call, photo_id: str, half: int) -> pictures.Picture:
    photo = photo_routes.find_photo(call, photo_id)
    key = f"{photo_folder(photo)}{SHOWN}"
    return pictures.level(call.storage, key, "image/jpeg", photo.orientation or 1, half)


@router.get("/ui/photos/{photo_id}/tiles/whole.jpg")
def photo_whole(photo_id: str, call: CallDep) -> Response:
    """Show a developed photo as large as most screens are."""
    return photo_preview(photo_id, call, WHOLE)


@router.get("/ui/photos/{photo_id}/tiles/{half}/{col}_{row}.jpg")
def photo_tile(photo_id: str, half: Half, col: Number, row: Number, call: CallDep) -> Response:
    """Show a tile of a developed photo, halved `half` times."""
    return _picture(pictures.tile(_shown(call, photo_id, half), col, row))


@router.get("/ui/photos/{photo_id}/crop.png")
def photo_crop(
    photo_id: str, call: CallDep, row: Share, col: Share, width: Side = 640, height: Side = 420
) -> Response:
    """Show a part of a developed photo, 1:1."""
    return _picture(pictures.crop(_shown(call, photo_id, 0), row, col, height, width), "image/png")


# --- a correction --------------------------------------------------------------------------------


def _compared(call: Call, correction_id: str) -> CorrectionPlan:
    plan = correction_routes.find_plan(call, correction_id)
    if plan.correction.state != "succeeded":
        raise NotReadyError(f"correction {correction_id} is {plan.correction.state}: wait for its job")
    return plan


def _side(call: Call, correction_id: str, which: Which, half: int) -> pictures.Picture:
    plan = _compared(call, correction_id)
    key = f"{run_folder(plan.correction)}{_OF[which]}"
    return pictures.level(call.storage, key, "image/jpeg", plan.photo.orientation or 1, half)


@router.get("/ui/corrections/{correction_id}/tiles/{which}/whole.jpg")
def correction_whole(correction_id: str, which: Which, call: CallDep) -> Response:
    """Show a photo before or after a correction as large as most screens are."""
    half = 0
    while max(_side(call, correction_id, which, half).shape[:2]) > WHOLE:
        half += 1
    return _picture(pictures.jpeg(_side(call, correction_id, which, half)))


@router.get("/ui/corrections/{correction_id}/tiles/{which}/{half}/{col}_{row}.jpg")
def correction_tile(
    correction_id: str, which: Which, half: Half, col: Number, row: Number, call: CallDep
) -> Response:
    """Show a tile of a photo before or after a correction, halved `half` times."""
    return _picture(pictures.tile(_side(call, correction_id, which, half), col, row))


@router.get("/ui/corrections/{correction_id}/crop.png")
def correction_crop(
    correction_id: str, call: CallDep, row: Share, col: Share, width: Side = 640, height: Side = 420
) -> Response:
    """Show a part of the corrected photo, 1:1."""
    return _picture(
        pictures.crop(_side(call, correction_id, "after", 0), row, col, height, width), "image/png"
    )


@router.get("/ui/corrections/{correction_id}/layer/{name}")
def correction_layer(
    correction_id: str, name: Literal["before", "after", "smooth", "clean"], call: CallDep
) -> Response:
    """Show a part of a photo as the sliders of a preview mix it."""
    plan = _compared(call, correction_id)
    if name in {"smooth", "clean"} and not plan.correction.params.get("layers"):
        raise InvalidParameterError(f"correction {correction_id} has no layers")
    key = f"{run_folder(plan.correction)}{_OF[name]}"
    media_type = "image/jpeg" if name in {"before", "after"} else "image/png"
    picture = pictures.decoded(call.storage, key, media_type, plan.photo.orientation or 1)
    return _picture(pictures.png(picture), "image/png")
