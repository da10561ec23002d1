"""Whether a photo or a profile seems to be of another lens than the one that is named for it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

from lensmodel.core.names import name_key, serial_key

REMEDY: Final = "choose its own lens, or send any_lens=true if it is the same"

_SPAN: Final = 1.1  # ratio of focal lengths up to which they are taken for one (chosen: files round them)


@dataclass(frozen=True, slots=True)
class Described:
    """What is known of a lens, by itself or by a photo: as far as it is known."""

    maker: str | None = None
    model: str | None = None
    serial: str | None = None
    cameras: Collection[str] = ()
    focals_mm: Collection[float] = ()


def difference(lens: Described, other: Described) -> str | None:
    """Say what speaks against one lens, as a clause; None where nothing does."""
    # What both name must agree. Where one of them names no model, the camera tells lenses apart: that of a
    # compact is part of it. Focal lengths far from all that the lens was seen at are of another one.
    if lens.serial and other.serial and serial_key(lens.serial) != serial_key(other.serial):
        return f"its serial number is {other.serial}, that of the lens {lens.serial}"
    if lens.model and other.model and name_key(lens.model) != name_key(other.model):
        return f"it is of the {other.model}, and the lens is the {lens.model}"
    if lens.maker and other.maker and lens.model and name_key(lens.maker) != name_key(other.maker):
        return f"it is of a lens of {other.maker}, and this one is of {lens.maker}"
    if not (lens.model and other.model) and lens.cameras and other.cameras:
        known = {name_key(camera) for camera in lens.cameras}
        if not known & {name_key(camera) for camera in other.cameras}:
            cameras = [" and ".join(sorted(each.cameras)) for each in (other, lens)]
            return f"it was taken with a {cameras[0]}, and the photos of the lens with a {cameras[1]}"
    if lens.focals_mm and other.focals_mm:
        low, high = min(other.focals_mm), max(other.focals_mm)
        if low > _SPAN * max(lens.focals_mm) or high < min(lens.focals_mm) / _SPAN:
            return f"it is of {_span(other.focals_mm)}, and the photos of the lens of {_span(lens.focals_mm)}"
    return None


def _span(focals_mm: Collection[float]) -> str:
    low, high = min(focals_mm), max(focals_mm)
    return f"{low:g} mm" if low == high else f"{low:g} to {high:g} mm"
