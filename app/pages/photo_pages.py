"""The pages of a photo and of a correction, and the preview of a part."""

from __future__ import annotations

from collections import Counter
from typing import Final

from fastapi import APIRouter
from fastapi.responses import HTMLResponse
from pydantic import Field

from app.blobs import tiles
from app.errors import InvalidParameterError
from app.http import views
from app.http.dependencies import CallDep, OneSession
from app.jobs.task_files import SHOWN, SIDES
from app.pages import pictures, shown, words
from app.pages.rendering import page
from app.routes import corrections as correction_routes
from app.routes import lenses as lens_routes
from app.routes import photos as photo_routes
from app.schemas import CorrectionIn, Id, PhotoOut, Region
from app.store.database import new_id
from app.store.tables import PhotoRow
from lensmodel.workflow.correcting import SEEN_DB

# Of the nine places of a picture
NAMES: Final = (
    *("upper left", "upper middle", "upper right"),
    *("left", "centre", "right"),
    *("lower left", "lower middle", "lower right"),
)

# Pixels of a preview at most (chosen): a second or two of work while the user waits
MAX_PREVIEW_PIXELS: Final = 1_500_000
router = APIRouter(include_in_schema=False, route_class=OneSession)


def _upright(photo: PhotoOut, row: PhotoRow) -> PhotoOut:
    """Return a photo with its size in upright orientation."""
    if (row.orientation or 1) <= 4:
        return photo
    return photo.model_copy(update={"width": row.height, "height": row.width})


@router.get("/photos/{photo_id}")
def photo_page(photo_id: str, call: CallDep) -> HTMLResponse:
    """Show a photo: how to correct it, and what it taught."""
    row = photo_routes.find_photo(call, photo_id)
    photo = views.photo_out(row)
    patches = call.store.photos.windows(photo_id)
    left_out = Counter(patch.reason for patch in patches if patch.state in {"rejected", "failed"})
    candidates = []
    if photo.lens_id is None:
        candidates = [
            lens for lens in shown.lenses_with_photos(call) if lens.samples or photo.state == "needs_lens"
        ]
    corrections = correction_routes.list_corrections(call, limit=50, photo_id=photo_id).items
    corrections = [correction for correction in corrections if correction.roi is None]
    done = next((correction for correction in corrections if correction.state == "succeeded"), None)
    lens = None if photo.lens_id is None else lens_routes.get_lens(photo.lens_id, call)
    shown_by = "" if done is None else f"/ui/corrections/{done.id}/tiles"
    better = done is not None and not (done.report or {}).get("nothing_to_correct")
    return page(
        "photo.html",
        photo=_upright(photo, row),
        can_look=pictures.exists(call.storage, f"{row.folder}{SHOWN}"),
        gently=row.kind == "jpeg",
        used=sum(patch.state == "done" for patch in patches),
        reasons=left_out.most_common(),
        candidates=candidates,
        known=lens.samples > 0 if lens else bool(candidates),
        group=shown.grouped([row])[0],
        lens=lens,
        corrections=corrections,
        done=done,
        nothing=words.nothing_words(row.kind),
        least=SEEN_DB,
        before=f"/ui/photos/{photo_id}/tiles/before" if done is None else f"{shown_by}/before",
        after=f"{shown_by}/after" if better else None,
        places=[(name, *place) for name, place in zip(NAMES, tiles.PLACES, strict=True)],
    )


class PreviewIn(Region):
    """A part of the upright photo, in its pixels; and the lens, where the photo does not say it.

    With `layers` it is also wanted as the sliders of texture and grain need it.
    """

    method: str = Field(default="standard", max_length=40)
    lens_id: Id | None = None
    layers: bool = False


@router.post("/ui/photos/{photo_id}/preview", status_code=202)
def preview(photo_id: str, part: PreviewIn, call: CallDep) -> dict[str, str]:
    """Begin to correct a part of a photo."""
    row = photo_routes.find_photo(call, photo_id)
    if not row.width or not row.height:
        raise InvalidParameterError("the photo is not read yet: wait a moment")
    if part.width * part.height > MAX_PREVIEW_PIXELS:
        raise InvalidParameterError("the part is too large for a preview: zoom in")
    turned = pictures.in_sensor(part, row.height, row.width, row.orientation or 1)
    request = CorrectionIn.model_validate(
        {
            "photo_id": photo_id,
            "lens_id": part.lens_id,
            "method": part.method,
            "roi": turned.model_dump(),
            "layers": part.layers,
            "output": {"format": "png8", "color_space": "srgb"},
        }
    )
    # not shared: who asks deletes it, while the next page may be asking for the same already
    correction = correction_routes.begin(request, call, look=new_id())
    return {"id": correction.id}


@router.get("/corrections/{correction_id}")
def correction_page(correction_id: str, call: CallDep) -> HTMLResponse:
    """Show a corrected photo beside the original."""
    plan = correction_routes.find_correction(call, correction_id)
    correction = views.correction_out(plan)
    report = correction.report or {}
    audit = report.get("audit") or {}
    photo, row = views.photo_out(plan.photo), plan.photo
    can_look = correction.roi is None and pictures.exists(call.storage, f"{plan.run_folder}{SIDES['after']}")
    changed = not report.get("nothing_to_correct")
    can_look = can_look and changed
    zones, most_gain = words.gain_bars(report.get("zones") or {})
    return page(
        "correction.html",
        correction=correction,
        job=views.job_out(plan),
        photo=_upright(photo, row),
        can_look=can_look,
        zones=zones if changed else [],
        most_gain=most_gain,
        nothing=words.nothing_words(row.kind),
        learned_from=plan.lens.photo_count,
        audit=words.held_back(audit) if changed else None,
        held=words.held_map(audit, row.height or 0, row.width or 0, row.orientation or 1) if can_look else [],
        places=[(name, *place) for name, place in zip(NAMES, tiles.PLACES, strict=True)],
    )
