"""The portable lens profile, and whether a photo or another lens can be of the same lens.

A profile is a zip of JSON and npy that opens anywhere and gives the same PSFs.

Layout of a `.lensprofile`, format 2::

    profile.json    format, lens, cameras, settings of the model, one entry for each sample
    kernels.npy     (n, k, k) float32, sum 1, centred, in the order of the entries
    encoded.npy     (m, bytes) uint8: what patches say without a kernel, see `EncodedPatch`

Nothing in it can run code: no pickle, sizes bounded before arrays are made. Samples cross the service, to
its tasks and tables, in the same form.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import product
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError, LensModelError
from lensmodel.core.files import atomic
from lensmodel.core.names import name_key, serial_key
from lensmodel.core.psf import EncodedPatch, PsfSample
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model.lens_model import LensModel
from lensmodel.photo import PhotoMetadata

FORMAT = 2  # raised when samples of before mean nothing to the model any more
_MAX_BYTES = 1 << 30  # unpacked: against files made to fill the memory
_MAX_SAMPLES = 200_000  # some 700 photos of 96 patches in three colours (chosen: memory)
_MAX_SIDE = 255  # pixels: several times the widest kernels; larger files would fill the memory (chosen)
_KERNELS, _ENCODED = "kernels.npy", "encoded.npy"
_INFINITY = "infinity"  # a focus distance for which JSON has no number


@dataclass(frozen=True, slots=True)
class Camera:
    """A body that photos of a lens were taken with; the lens may be part of it."""

    maker: str | None = None  # as the photos say; None where they do not
    model: str | None = None
    serial: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class LensProfile:
    """A model with what is known of its lens and of the photos that it came from."""

    model: LensModel
    lens: dict[str, str] = field(default_factory=dict)  # maker, model, serial, label; whatever is known
    photos: dict[str, str] = field(default_factory=dict)  # file names by the id that samples carry
    cameras: tuple[Camera, ...] = ()  # what these were taken with, each once; empty where no photo says


def save_profile(path: Path | str, profile: LensProfile) -> None:
    """Write a profile; the file appears complete or not at all."""
    with atomic(Path(path)) as file:
        write_profile(file, profile)


def write_profile(file: IO[bytes], profile: LensProfile) -> None:
    """Write a profile to an open file."""
    samples = profile.model.samples
    side = max(sample.kernel.shape[0] for sample in samples)
    if not _within_limits(len(samples), side):
        raise InvalidInputError(
            f"a profile holds {_MAX_SAMPLES} samples of side {_MAX_SIDE}, not {len(samples)} of side {side}"
        )
    packed = pack_samples(samples)
    document = {
        "format": FORMAT,
        "units": {"r": "half-diagonal", "phi": "radian, counter-clockwise from the right", "kernel": "pixel"},
        "lens": profile.lens,
        "photos": profile.photos,
        "cameras": [{k: text for k, text in asdict(of).items() if text} for of in profile.cameras],
        "model": {"mode": profile.model.mode},
        "samples": packed.entries,
    }
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("profile.json", json.dumps(document, allow_nan=False))
        for name, array in ((_KERNELS, packed.kernels), (_ENCODED, packed.encoded)):
            buffer = io.BytesIO()
            np.save(buffer, array, allow_pickle=False)
            archive.writestr(name, buffer.getvalue())
        if _unpacked(archive) > _MAX_BYTES:
            raise InvalidInputError(f"a profile holds {_MAX_BYTES >> 20} MiB at most; save fewer samples")


def _within_limits(count: int, side: int) -> bool:
    return 0 < count <= _MAX_SAMPLES and side <= _MAX_SIDE


def _unpacked(archive: zipfile.ZipFile) -> int:
    return sum(entry.file_size for entry in archive.infolist())


def load_profile(path: Path | str) -> LensProfile:
    """Open a profile."""
    return read_profile(path, Path(path).name)


def read_profile(source: Path | str | IO[bytes], name: str) -> LensProfile:
    """Open a profile by its path or as an open file; errors call it `name`."""
    try:
        return _read(source, name)
    except (FileNotFoundError, LensModelError):
        raise
    except Exception as error:  # zipfile, json and NumPy fail in a dozen ways on files made to do harm
        raise InvalidInputError(f"{name} is no lens profile, or a damaged one; give another file") from error


def _read(source: Path | str | IO[bytes], name: str) -> LensProfile:
    with zipfile.ZipFile(source) as archive:
        if _unpacked(archive) > _MAX_BYTES:
            raise InvalidInputError(
                f"{name} unpacks to more than {_MAX_BYTES >> 20} MiB; it is no lens profile"
            )
        document = json.loads(archive.read("profile.json"))
        if document["format"] != FORMAT:
            raise InvalidInputError(
                f"{name} has profile format {document['format']}, this program reads {FORMAT}: its "
                "samples are not those of this program; calibrate again with the photos of the lens"
            )
        stack, encoded = (
            np.asarray(np.load(io.BytesIO(archive.read(part)), allow_pickle=False))
            for part in (_KERNELS, _ENCODED)
        )
    entries = document["samples"]
    fits = stack.ndim == 3 and len(entries) == len(stack) and _within_limits(*stack.shape[:2])
    if not fits or stack.dtype != np.float32:
        raise InvalidInputError(
            f"{name} holds {len(entries)} samples but kernels of shape {stack.shape}; "
            f"one is needed for each, of side {_MAX_SIDE} at most"
        )
    chosen = document["model"]
    excluded = chosen.get("excluded", ())  # photos that do not count, of earlier profiles
    samples = unpack_samples(PackedSamples(entries, stack, encoded))
    model = LensModel.fit([s for s in samples if s.photo not in excluded], chosen.get("mode", "default"))
    cameras = tuple(Camera(**_texts(camera)) for camera in document.get("cameras", []))
    return LensProfile(model, _texts(document["lens"]), _texts(document["photos"]), cameras)


def _texts(values: dict[str, Any]) -> dict[str, str]:
    return {str(key)[:200]: str(value)[:200] for key, value in values.items()}


@dataclass(frozen=True, slots=True, eq=False)
class PackedSamples:
    """Samples as JSON and arrays."""

    # `entry_of` each sample, and in `encoded` the row of its patch, which its channels share, or None
    entries: list[dict[str, Any]]
    kernels: NDArray[np.float32]  # (n, k, k), zeros around kernels that are smaller than the largest
    encoded: NDArray[np.uint8]  # (m, bytes), `EncodedPatch.to_bytes` of the patches


def pack_samples(samples: Sequence[PsfSample]) -> PackedSamples:
    """Turn samples into what `unpack_samples` reads."""
    side = max(sample.kernel.shape[0] for sample in samples)
    kernels = np.zeros((len(samples), side, side), dtype=np.float32)
    patches: dict[bytes, int] = {}
    entries = []
    for number, sample in enumerate(samples):
        kernels[number][_middle(side, sample.kernel.shape[0])] = sample.kernel
        row = None if sample.encoded is None else patches.setdefault(sample.encoded.to_bytes(), len(patches))
        entries.append({**entry_of(sample), "encoded": row})
    rows = [np.frombuffer(data, dtype=np.uint8) for data in patches]
    return PackedSamples(entries, kernels, np.stack(rows) if rows else np.empty((0, 0), dtype=np.uint8))


def unpack_samples(packed: PackedSamples) -> list[PsfSample]:
    """Build the samples that `pack_samples` was given."""
    if packed.encoded.ndim != 2 or packed.encoded.dtype != np.uint8:
        raise ValueError(f"encoded patches of shape {packed.encoded.shape}")
    patches = [EncodedPatch.from_bytes(row.tobytes()) for row in packed.encoded]
    side = packed.kernels.shape[1]
    samples = []
    for entry, kernel in zip(packed.entries, packed.kernels, strict=True):
        row = entry["encoded"]
        if not (row is None or (isinstance(row, int) and 0 <= row < len(patches))):
            raise ValueError(f"no encoded patch {row!r}, there are {len(patches)}")
        own = kernel[_middle(side, int(entry["size"]))]
        samples.append(sample_of(entry, own, None if row is None else patches[row]))
    return samples


def _middle(side: int, size: int) -> tuple[slice, slice]:
    """The middle `size` rows and columns of `side`."""
    margin, odd = divmod(side - size, 2)
    if not 0 < size <= side or odd:
        raise ValueError(f"kernels of side {size} in an array of side {side}")
    return slice(margin, margin + size), slice(margin, margin + size)


# Fields of a sample that its entry holds as they are
_NAMED_ALIKE: Final = ("weight", "photo", "pixel_pitch_um", "half_diagonal_px", "estimator", "error")


def entry_of(sample: PsfSample) -> dict[str, Any]:
    """Return the named fields of a sample: all of it but the kernel and the encoded patch."""
    settings = asdict(sample.settings)
    if settings["focus_m"] == math.inf:
        settings["focus_m"] = _INFINITY
    named = {name: getattr(sample, name) for name in _NAMED_ALIKE}
    return {"size": sample.kernel.shape[0], **asdict(sample.position), "settings": settings, **named}


def sample_of(
    entry: Mapping[str, Any], kernel: NDArray[np.float32], encoded: EncodedPatch | None
) -> PsfSample:
    """Build the sample of which `entry_of` returned the fields."""
    settings = dict(entry["settings"])
    if settings.get("focus_m") == _INFINITY:
        settings["focus_m"] = math.inf
    place = FieldPosition(float(entry["r"]), float(entry["phi"]))
    named = {name: entry[name] for name in _NAMED_ALIKE}
    named |= {name: str(named[name]) for name in ("photo", "estimator")}
    values = np.asarray(kernel, dtype=np.float64)
    return PsfSample(values, place, LensSettings(**settings), encoded=encoded, **named)


# --- which lens it is ----------------------------------------------------------------------------

SAME_FOCAL: Final = 1.19  # ratio of focal lengths that count as one: a quarter of an octave, as of the model
_COMPACT_MM: Final = (
    8.0  # focal lengths below are of compacts, whose zooms are one lens (chosen: of fisheyes)
)

_NAMED: Final[Mapping[str, tuple[Callable[[str | None], str], str]]] = {
    "serial": (serial_key, "its serial number is {theirs}, that of the lens {ours}"),
    "model": (name_key, "it is of the {theirs}, and the lens is the {ours}"),
    "maker": (name_key, "it is of a lens of {theirs}, and this one is of {ours}"),
}


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

    @classmethod
    def of_profile(cls, profile: LensProfile) -> Identity:
        """Take what a profile says of its lens and of the photos it was learned from."""
        focals = {sample.settings.focal_mm for sample in profile.model.samples}
        return cls(profile.lens, profile.cameras, [focal for focal in focals if focal])

    @property
    def names_lens(self) -> bool:
        """Whether there is more than a maker, which says nothing of the lens."""
        return bool(self.names.get("model") or self.names.get("serial"))

    @property
    def is_built_in(self) -> bool:
        """Whether the lens is part of a camera: it names itself after it."""
        model = name_key(self.names.get("model"))
        return not self.names.get("serial") and any(
            key in model for camera in self.cameras if (key := name_key(camera.model))
        )


def difference(lens: Identity, other: Identity) -> str | None:
    """Say why a photo, or another lens, cannot be, or need not be, of a lens; None where nothing says so.

    - What both name of the lens must agree.
    - Where only the other names its lens, its camera recorded more than for the photos of the lens, so
      nothing says that they are of one lens, unless the owner gave the lens a label. A lens of which nothing
      at all is known may be any.
    - Where one of them names no lens, its camera must be of a model that both were seen on: the lens of a
      compact is part of it, and two models of camera have two lenses. On the same body an unnamed lens may be
      any that was screwed on; its focal length tells that it was another one, but for compacts that zoom.
    - A lens that is part of a camera, and names itself after it or not at all, is as unique as the body: the
      serials of both must agree.
    """
    for name, (key, words) in _NAMED.items():
        ours, theirs = lens.names.get(name), other.names.get(name)
        if ours and theirs and key(ours) != key(theirs):
            return words.format(theirs=theirs, ours=ours)
    nothing = not (lens.names or lens.cameras or lens.focals_mm)
    if other.names_lens and not (lens.names_lens or lens.names.get("label") or nothing):
        words = " ".join(other.names[name] for name in ("model", "serial") if other.names.get(name))
        return f"it names its lens, {words}, and the photos of the known lens name none"
    pairs = list(product(lens.cameras, other.cameras))
    alike = [(ours, theirs) for ours, theirs in pairs if _same_model(ours, theirs)]
    unnamed = not (lens.names_lens and other.names_lens)
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


def _same_model(one: Camera, other: Camera) -> bool:
    # makers write their name into the model or not, and in more than one way; models are not shared
    a, b = name_key(one.model), name_key(other.model)
    return bool(a) and bool(b) and (a.endswith(b) or b.endswith(a))


def _models(it: Identity) -> str:
    return ", ".join(sorted({camera.model or "an unknown camera" for camera in it.cameras}))


def _span(focals_mm: Collection[float]) -> str:
    low, high = min(focals_mm), max(focals_mm)
    return f"{low:g} mm" if low == high else f"{low:g} to {high:g} mm"
