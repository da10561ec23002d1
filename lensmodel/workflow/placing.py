"""Which part of what a lens draws a photo shows."""

from __future__ import annotations

from dataclasses import replace

from lensmodel.core.errors import OutsideSupportError
from lensmodel.model import LensModel
from lensmodel.model.circle import ALIKE, circle_mm
from lensmodel.photo import LinearPhoto
from lensmodel.photo.values import remarks_log


def placed(developed: LinearPhoto, model: LensModel) -> LinearPhoto:
    """Count the places of a photo in the half diagonal of the largest frame that its lens was seen on.

    A frame in crop mode is the middle of the sensor. Where the pixel pitch is unknown the photo is taken for
    a whole frame, and that is told where its size is another.

    Raises
    ------
    OutsideSupportError
        If it reaches beyond what is known of the lens, or was cut so that nobody can tell from where.
    """
    frame, info = developed.frame, developed.info
    pitch, circle = info.metadata.pixel_pitch_um, circle_mm(model.samples)
    if circle is None or frame.circle_px is not None:
        return developed
    if pitch is None:
        pixels = {round(sample.half_diagonal_px) for sample in model.samples if sample.half_diagonal_px}
        if pixels and not any(abs(frame.half_diagonal / size - 1.0) < ALIKE for size in pixels):
            remarks_log.warning(
                "its pixel pitch is unknown: %d x %d pixels are taken for the whole frame of %.1f mm",
                frame.width,
                frame.height,
                2.0 * circle,
            )
        return developed
    own = frame.half_diagonal * pitch / 1000.0
    sizes = f"{2.0 * own:.1f} mm diagonal, and its lens is known on a frame of {2.0 * circle:.1f} mm"
    if own > (1.0 + ALIKE) * circle:
        raise OutsideSupportError(
            f"it shows a frame of {sizes}: nothing is known of what lies beyond; calibrate the lens with "
            "photos of the larger frame"
        )
    if own > (1.0 - ALIKE) * circle:
        return developed
    if not info.centred:
        raise OutsideSupportError(
            f"it was cut to {sizes}: nobody can tell from which part; correct the whole photo, then cut it"
        )
    return replace(developed, frame=replace(frame, circle_px=circle * 1000.0 / pitch))
