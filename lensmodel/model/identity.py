"""Whether a photo or another lens can be of the same lens, by what they say of themselves."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Final

from lensmodel.core.names import name_key, serial_key
from lensmodel.photo import PhotoMetadata

SAME_FOCAL: Final = 1.19  # ratio of focal lengths that count as one: a quarter of an octave, as of the model
# focal lengths below are of compacts, whose zooms are one lens (chosen: of fisheyes)
_COMPACT_MM: Final = 8.0

_NAMED: Final[Mapping[str, tuple[Callable[[str | None], str], str]]] = {
    "serial": (serial_key, "its serial number is {theirs}, that of the lens {ours}"),
    "model": (name_key, "it is of the {theirs}, and the lens is the {ours}"),
    "maker": (name_key, "it is of a lens of {theirs}, and this one is of {ours}"),
}


@dataclass(frozen=True, slots=True)
class Camera:
    """A body that photos of a lens were taken with; the lens may be part of it."""

    maker: str | None = None  # as the photos say; None where they do not
    model: str | None = None
    serial: str | None = None

    def same_model(self, other: Camera) -> bool:
        """Whether both are of one model, which makers write with their name or without; they share none."""
        a, b = name_key(self.model), name_key(other.model)
        return bool(a) and bool(b) and (a.endswith(b) or b.endswith(a))


@dataclass(frozen=True, slots=True)
class Identity:
    """What a photo or a lens says of itself, as far as it is known."""

    names: Mapping[str, str] = field(default_factory=dict)  # maker, model, serial; of a lens also its label
    cameras: Collection[Camera] = ()  # bodies that it was seen on whose model is known
    focals_mm: Collection[float] = ()  # of the photos

    @classmethod
    def of(cls, metadata: PhotoMetadata) -> Identity:
        """Take from a photo's metadata what tells of its lens and its camera."""
        lens = metadata.lens
        names = {"maker": lens.maker, "model": lens.model, "serial": lens.serial}
        camera = Camera(metadata.camera_maker, metadata.camera_model, metadata.body_serial)
        return cls(
            {name: value for name, value in names.items() if value},
            (camera,) if camera.model else (),
            (metadata.focal_mm,) if metadata.focal_mm else (),
        )

    @property
    def names_lens(self) -> bool:
        """Whether there is more than a maker, which says nothing of the lens."""
        return bool(self.names.get("model") or self.names.get("serial"))

    @property
    def is_built_in(self) -> bool:
        """Whether the lens is part of a camera: it names itself after it."""
        model = name_key(self.names.get("model"))
        after = any(key in model for camera in self.cameras if (key := name_key(camera.model)))
        return after and not self.names.get("serial")


def difference(lens: Identity, other: Identity) -> str | None:
    """Say why a photo, or another lens, cannot be, or need not be, of a lens; None where nothing says so.

    What both name of the lens must agree. Where only the other names its lens it is another one, unless the
    owner labelled the lens, or nothing at all is known of it. Where one names none, both must have been seen
    on one model of camera, of which a lens may be part, at about one focal length, but for compacts that
    zoom; and where none does, or a lens names itself after its camera, on one body.
    """
    for name, (key, words) in _NAMED.items():
        ours, theirs = lens.names.get(name), other.names.get(name)
        if ours and theirs and key(ours) != key(theirs):
            return words.format(theirs=theirs, ours=ours)
    nothing = not (lens.names or lens.cameras or lens.focals_mm)
    if other.names_lens and not (lens.names_lens or lens.names.get("label") or nothing):
        words = " ".join(other.names[name] for name in ("model", "serial") if other.names.get(name))
        return f"it names its lens, {words}, and the photos of the known lens name none"
    unnamed = not (lens.names_lens and other.names_lens)
    pairs = list(product(lens.cameras, other.cameras))
    alike = [(ours, theirs) for ours, theirs in pairs if ours.same_model(theirs)]
    if unnamed and pairs and not alike:
        return (
            f"it was taken with another camera, {_models(other)}, and the photos of the known lens with "
            f"{_models(lens)}, and not both name their lens"
        )
    built_in = other.is_built_in if other.names_lens else not lens.names_lens
    bodies = [{serial_key(pair[k].serial) for pair in alike if pair[k].serial} for k in (0, 1)]
    if built_in and all(bodies) and not bodies[0] & bodies[1]:
        return "it was taken with another copy of the camera, and nothing says that the lens is the same"
    focals = [*lens.focals_mm, *other.focals_mm]
    if unnamed and lens.focals_mm and other.focals_mm and not (alike and min(focals) < _COMPACT_MM):
        low, high = min(other.focals_mm), max(other.focals_mm)
        if low > SAME_FOCAL * max(lens.focals_mm) or high * SAME_FOCAL < min(lens.focals_mm):
            known = _span(lens.focals_mm)
            return f"it is of {_span(other.focals_mm)}, and the photos of the known lens of {known}"
    return None


def _models(it: Identity) -> str:
    return ", ".join(sorted({camera.model or "an unknown camera" for camera in it.cameras}))


def _span(focals_mm: Collection[float]) -> str:
    low, high = min(focals_mm), max(focals_mm)
    return f"{low:g} mm" if low == high else f"{low:g} to {high:g} mm"
