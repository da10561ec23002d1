"""Data of the pages and their streams, by the same routes as the API."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from app.http.dependencies import Call
from app.routes import corrections as correction_routes
from app.routes import lenses as lens_routes
from app.routes import photos as photo_routes
from app.schemas import LensOut, PhotoOut
from app.store.tables import PhotoRow
from lensmodel.core.names import camera_name, full_name, name_key

PHOTOS: Final = 60  # Photos and lenses of a list (chosen): the newest of them
HOPELESS: Final = frozenset({"failed", "cancelled"})  # States of photos without a result
MAX_WAITING: Final = 1000  # Waiting photos on the page at most: as many as one request can change
NARROWEST_MM: Final = 10.0  # Width of the smallest sensor behind a mount (chosen): one inch has 13.2 mm
# Focal length in mm below which a lens that has no name is no separate one (chosen): fisheyes begin at 8 mm,
# and those that have no contacts do not tell their aperture
SHORTEST_MM: Final = 8.0
CELLS_PX: Final = (9, 15, 25)  # of a map (chosen): in the least a point of a sharp lens fills a quarter
CELL_SHARE: Final = 0.9  # of the light of a point that its cell shows (chosen): tails are too faint to see
# Series of cameras without a mount whose sensors or focal lengths do not give them away
_COMPACTS: Final = re.compile(
    r"powershot|ixus|coolpix|finepix|cybershot|^dsc(rx|hx|wx|h|w|t|p|s)\d|^dmc(f|t|l[cfx])|^dc(f|t|lx)|^x100"
    r"|^x\d0s?$|stylus|optio|ricohgr|^grii|hero\d|iphone|ipad|pixel|^sm[agns]\d|leicaq|^zv1"
)


def photos(call: Call, lens_id: str | None = None) -> tuple[list[PhotoOut], bool]:
    """Return the newest photos, of one lens or of all, and whether there are more."""
    page = photo_routes.list_photos(call, limit=PHOTOS, lens_id=lens_id)
    return page.items, page.next is not None


def lenses_with_photos(call: Call) -> list[LensOut]:
    """Return the newest lenses, except those without samples whose photos all failed or are gone.

    A lens that was given its name before any photo is none of these.
    """
    listed = lens_routes.list_lenses(call, limit=PHOTOS).items
    unknown = [lens.id for lens in listed if not lens.samples]
    hopeful = call.store.lenses.with_photos_beyond(HOPELESS, unknown)
    tried = call.store.lenses.with_photos_beyond(frozenset(), unknown)
    return [
        lens for lens in listed if lens.samples or lens.id in hopeful or (lens.label and lens.id not in tried)
    ]


def counting(call: Call, lens_id: str) -> bool:
    """Whether a worker has yet to measure the newest version of a lens."""
    lens = call.lens(lens_id)
    newest = call.store.lenses.history(lens, after=lens.version - 1)
    return lens.sample_count > 0 and any(event.metrics is None for event in newest)


def next_step(call: Call, listed: Sequence[PhotoOut], lenses: Sequence[LensOut]) -> PhotoOut | None:
    """Return the newest photo that is, or soon can be, corrected; None where it has been already."""
    known = {lens.id for lens in lenses if lens.samples}
    hopeful = [photo for photo in listed if photo.state not in {*HOPELESS, "excluded", "needs_lens"}]
    hopeful = [photo for photo in hopeful if photo.lens_id]  # whose lens is asked for yet may wait for long
    photo = next((each for each in hopeful if each.state != "stored" or each.lens_id in known), None)
    if photo is None:
        return None
    corrections = correction_routes.list_corrections(call, limit=PHOTOS, photo_id=photo.id).items
    return photo if all(correction.roi for correction in corrections) else None  # of a part: a preview


def cell_px(kernels: Sequence[ArrayLike]) -> int:
    """Return the side of the cells of a map in pixels: the least that shows all of these kernels."""

    def fits(side: int) -> bool:
        shown = (np.asarray(kernel) for kernel in kernels)
        margins = ((kernel, max(len(kernel) - side, 0) // 2) for kernel in shown)
        return all(k[m : len(k) - m, m : len(k) - m].sum() >= CELL_SHARE * k.sum() for k, m in margins)

    return next((side for side in CELLS_PX if kernels and fits(side)), CELLS_PX[-1])


def waiting(call: Call) -> list[WaitingGroup]:
    """Group the photos that wait for their owner to say which lens it was."""
    rows = call.store.photos.page(call.owner, before=None, limit=MAX_WAITING, state="needs_lens")
    return grouped([row for row in rows if row.lens_id is None])


@dataclass(frozen=True, slots=True)
class WaitingGroup:
    """Photos that wait for their lens and were probably taken with the same one."""

    camera: str | None
    body: int | None  # which of several bodies of that camera, from 1; None where there is but one
    focal_mm: float | None
    lens_model: str | None  # what the files call the lens, where they do
    needs_aperture: bool  # whether any of the files does not say it
    own_lens: bool  # whether the lens is a part of the camera
    photos: list[PhotoRow]  # newest first

    @property
    def told(self) -> tuple[str, str]:
        """Body and focal length in words, empty where they tell nothing."""
        return f"body {self.body}" if self.body else "", f"{self.focal_mm:g} mm" if self.focal_mm else ""

    @property
    def name(self) -> str:
        """What to call the lens: its own name, else camera and focal length; empty where nothing is known."""
        if self.lens_model:
            maker = self.camera.split()[0] if self.camera else None
            return full_name(maker, self.lens_model) if self.lens_model[0].isdigit() else self.lens_model
        return ", ".join(filter(None, (self.camera, *self.told)))


def has_own_lens(row: PhotoRow) -> bool:
    """Whether the lens of a photo is a part of its camera: by its name, or by the camera."""
    camera = name_key(row.camera_model)
    if not camera or row.lens_model:
        return bool(camera) and camera in name_key(row.lens_model) and not row.lens_serial
    if row.pixel_pitch_um and row.width and row.height:
        small = max(row.width, row.height) * row.pixel_pitch_um / 1000.0 < NARROWEST_MM
    else:
        small = bool(row.aperture) and 0.0 < (row.focal_mm or 0.0) < SHORTEST_MM
    return small or _COMPACTS.search(camera) is not None


def grouped(rows: Sequence[PhotoRow]) -> list[WaitingGroup]:
    """Group photos by body and lens name, those whose lens may be any that has no name by focal length."""
    groups: defaultdict[tuple[str, str, float, str], list[PhotoRow]] = defaultdict(list)
    for row in rows:
        camera = camera_name(row.camera_maker, row.camera_model)
        focal = 0.0 if row.lens_model or has_own_lens(row) else row.focal_mm or 0.0
        groups[camera, row.body_key or "", focal, row.lens_model or ""].append(row)
    bodies: defaultdict[str, list[str]] = defaultdict(list)
    for camera, body, *_ in sorted(groups):
        if body not in bodies[camera]:
            bodies[camera].append(body)
    return [
        WaitingGroup(
            camera=camera or None,
            body=bodies[camera].index(body) + 1 if len(bodies[camera]) > 1 else None,
            focal_mm=focal or None,
            lens_model=model or None,
            needs_aperture=any(row.aperture is None for row in photos),
            own_lens=all(map(has_own_lens, photos)),
            photos=photos,
        )
        for (camera, body, focal, model), photos in sorted(groups.items())
    ]
