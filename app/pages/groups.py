"""Photos that wait for their lens, in groups that were probably taken with the same one."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

from app.store.tables import PhotoRow
from lensmodel.core.names import camera_name, full_name


@dataclass(frozen=True, slots=True)
class WaitingGroup:
    """Photos that wait for their lens and were probably taken with the same one.

    Parameters
    ----------
    camera : str or None
    body : int or None
        Which of several bodies of that camera, counted from 1; None where there is but one.
    focal_mm : float or None
    lens_model : str or None
        What the files call the lens, where they do.
    needs_aperture : bool
        Whether any of the files does not say its aperture.
    photos : list of PhotoRow
        Newest first.
    """

    camera: str | None
    body: int | None
    focal_mm: float | None
    lens_model: str | None
    needs_aperture: bool
    photos: list[PhotoRow]

    @property
    def name(self) -> str:
        """What to call the lens: its own name, else camera and focal length; empty where nothing is known."""
        parts = [self.camera] if self.camera else []
        if self.lens_model:
            maker = self.camera.split()[0] if self.camera else None
            return full_name(maker, self.lens_model) if self.lens_model[0].isdigit() else self.lens_model
        parts += [f"body {self.body}"] if self.body else []
        return ", ".join([*parts, *([f"{self.focal_mm:g} mm"] if self.focal_mm else [])])

    @property
    def key(self) -> str:
        """A key that stays the same while photos join and leave."""
        first = self.photos[0]
        identity = f"{self.camera}|{first.body_key}|{self.focal_mm}|{self.lens_model}"
        return hashlib.sha256(identity.encode()).hexdigest()[:12]


def grouped(rows: Sequence[PhotoRow]) -> list[WaitingGroup]:
    """Group photos by body and lens name, those that name no lens by focal length."""
    groups: defaultdict[tuple[str, str, float, str], list[PhotoRow]] = defaultdict(list)
    for row in rows:
        camera = camera_name(row.camera_maker, row.camera_model)
        focal = 0.0 if row.lens_model else row.focal_mm or 0.0
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
            photos=photos,
        )
        for (camera, body, focal, model), photos in sorted(groups.items())
    ]
