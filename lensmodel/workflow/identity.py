"""By what two photos are known to show the same copy of a lens."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from lensmodel.core.names import name_key, serial_key
from lensmodel.model.profile import Camera
from lensmodel.photo.values import PhotoMetadata


@dataclass(frozen=True, slots=True)
class Identity:
    """What a photo says of its lens and of its camera.

    Parameters
    ----------
    lens : mapping of str to str
        maker, model, serial, as far as they are known.
    camera : Camera or None
        The body; `None` where the photo does not name its model.
    """

    lens: Mapping[str, str] = field(default_factory=dict)
    camera: Camera | None = None

    @classmethod
    def of(cls, metadata: PhotoMetadata) -> Identity:
        """Take from a photo's metadata what tells of its lens and its camera."""
        lens = metadata.lens
        named = {"maker": lens.maker, "model": lens.model, "serial": lens.serial}
        camera = Camera(metadata.camera_maker, metadata.camera_model, metadata.body_serial)
        return cls({name: value for name, value in named.items() if value}, camera if camera.model else None)

    @property
    def names_lens(self) -> bool:
        """Whether there is more than a maker, which says nothing of the lens."""
        return _names_lens(self.lens)


def difference(known: Mapping[str, str], cameras: Iterable[Camera], identity: Identity) -> str | None:
    """Say why a photo cannot be, or need not be, of the lens of a profile.

    - What both name of the lens must agree.
    - A lens that is part of a camera, and names itself after it, is as unique as the body: the serials of
      both must agree.
    - Where the photo names no lens, its camera must be one that the profile's photos were taken with: the
      lens of a compact is part of it, and two models of camera have two lenses. On the same body an
      unnamed lens may be any that was screwed on; that is for the owner to know.
    - Where only the photo names its lens, its camera recorded more than for the profile's photos, so
      nothing says that they are of one lens, unless the owner gave the profile a label.

    Parameters
    ----------
    known : mapping of str to str
        Lens of the profile.
    cameras : iterable of Camera
        What its photos were taken with; none is known of older profiles.
    identity : Identity
        Of the photo.

    Returns
    -------
    str or None
        A clause that begins with "it"; `None` where nothing speaks against one lens.
    """
    for name, value in identity.lens.items():
        key = serial_key if name == "serial" else name_key
        if key(known.get(name, value)) != key(value):
            return (
                f"it was taken with another lens, {name} {value}, and the profile is of {name} {known[name]}"
            )
    bodies = list(cameras)
    if identity.names_lens and not _names_lens(known) and not known.get("label"):
        return f"it names its lens, {_lens_words(identity.lens)}, and the profile's photos name none"
    if identity.camera is None or not bodies:
        return None
    alike = [body for body in bodies if _same_model(body, identity.camera)]
    if not identity.names_lens and not alike:
        return (
            f"it names no lens and was taken with another camera, {_camera_words(identity.camera)}, "
            f"and the profile's photos with {', '.join(map(_camera_words, bodies))}"
        )
    built_in = not _names_lens(known) if not identity.names_lens else _is_built_in(identity)
    serials = {serial_key(body.serial) for body in alike if body.serial}
    serial = identity.camera.serial
    if built_in and serial and serials and serial_key(serial) not in serials:
        return (
            f"it was taken with another copy of the camera, serial {serial}, and nothing "
            "says that the lens is the same"
        )
    return None


def _names_lens(lens: Mapping[str, str]) -> bool:
    return bool(lens.get("model") or lens.get("serial"))


def _is_built_in(identity: Identity) -> bool:
    camera = "" if identity.camera is None else name_key(identity.camera.model)
    return bool(camera) and camera in name_key(identity.lens.get("model")) and not identity.lens.get("serial")


def _same_model(one: Camera, other: Camera) -> bool:
    # makers write their name into the model or not, and in more than one way; models are not shared
    a, b = name_key(one.model), name_key(other.model)
    return bool(a) and bool(b) and (a.endswith(b) or b.endswith(a))


def _camera_words(camera: Camera) -> str:
    return camera.model or "an unknown camera"


def _lens_words(lens: Mapping[str, str]) -> str:
    return " ".join(lens[name] for name in ("model", "serial") if lens.get(name))
