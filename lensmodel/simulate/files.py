"""Simulated photos as files that any raw converter reads."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import numpy as np

from lensmodel.photo.dng import ShotInfo, write_bayer_dng, write_linear_dng
from lensmodel.simulate.camera import SimulatedPhoto

_BASE_ISO_ELECTRONS = 40000.0  # full well at ISO 100


def shot_info(photo: SimulatedPhoto, *, taken_at: datetime | None = None, orientation: int = 1) -> ShotInfo:
    """Metadata of a simulated photo as its camera would write it.

    Parameters
    ----------
    photo : SimulatedPhoto
    taken_at : datetime, optional
    orientation : int
        EXIF orientation, 1 to 8.

    Returns
    -------
    ShotInfo
    """
    truth = photo.truth
    lens, camera, settings = truth.lens, truth.camera, truth.settings
    widest = lens.widest(lens.focal_mm[0]), lens.widest(lens.focal_mm[-1])
    return ShotInfo(
        camera_maker=camera.maker,
        camera_model=camera.model,
        body_serial=camera.serial,
        lens_maker=lens.maker,
        lens_model=lens.model,
        lens_serial=lens.serial,
        aperture=round(lens.f_number(settings), 2),
        focal_mm=settings.focal_mm if settings.focal_mm is not None else lens.focal_mm[0],
        focal_range_mm=(lens.focal_mm[0], lens.focal_mm[-1]),
        widest_aperture=widest,
        focus_m=settings.focus_m,
        iso=max(round(100.0 * _BASE_ISO_ELECTRONS / camera.full_well_electrons), 1),
        exposure_s=1.0 / 125.0,
        taken_at=taken_at,
        pixel_pitch_um=camera.pitch_um,
        orientation=orientation,
    )


def write_photo(
    path: str | Path,
    photo: SimulatedPhoto,
    *,
    demosaiced: bool = False,
    taken_at: datetime | None = None,
    orientation: int = 1,
) -> None:
    """Write a simulated photo as DNG: its mosaic, or its three full planes as a linear DNG.

    Parameters
    ----------
    path : str or Path
        Where to; written whole or not at all.
    photo : SimulatedPhoto
    demosaiced : bool
        Write the planes instead of the mosaic: a sensor that sees every colour everywhere.
    taken_at : datetime, optional
        When it was taken.
    orientation : int
        EXIF orientation, 1 to 8.
    """
    camera = photo.truth.camera
    info = shot_info(photo, taken_at=taken_at, orientation=orientation)
    if demosaiced:
        write_linear_dng(
            path,
            np.clip(np.rint(photo.planes * np.float32(65535.0)), 0, 65535).astype(np.uint16),
            color_matrix=camera.color_matrix,
            as_shot_neutral=camera.as_shot_neutral,
            shot=info,
        )
        return
    write_bayer_dng(
        path,
        photo.mosaic,
        black=camera.black,
        white=camera.white,
        pattern=camera.pattern,
        color_matrix=camera.color_matrix,
        as_shot_neutral=camera.as_shot_neutral,
        shot=info,
    )
