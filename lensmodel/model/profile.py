"""The portable lens profile: a zip of JSON and npy that opens anywhere and gives the same PSFs.

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
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError, LensModelError
from lensmodel.core.files import atomic
from lensmodel.core.psf import EncodedPatch, PsfSample
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model.answer import ModelSettings
from lensmodel.model.lens_model import LensModel

FORMAT = 2  # raised when samples of before mean nothing to the model any more
_MAX_BYTES = 1 << 30  # unpacked: against files made to fill the memory
_MAX_SAMPLES = 200_000  # some 700 photos of 96 patches in three colours (chosen: memory)
_MAX_SIDE = 255  # pixels: several times the widest kernels; larger files would fill the memory (chosen)
_KERNELS, _ENCODED = "kernels.npy", "encoded.npy"
_INFINITY = "infinity"  # a focus distance for which JSON has no number

_UNREADABLE = (
    OSError,
    ValueError,
    KeyError,
    EOFError,
    MemoryError,  # an array header may claim any size
    RecursionError,  # lists in lists in lists
    RuntimeError,  # encrypted, or packed by a method that zipfile does not know
    zipfile.BadZipFile,
    zlib.error,
    TypeError,  # JSON of another shape
)


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
    cameras = [asdict(camera) for camera in profile.cameras]
    document = {
        "format": FORMAT,
        "units": {"r": "half-diagonal", "phi": "radian, counter-clockwise from the right", "kernel": "pixel"},
        "lens": profile.lens,
        "photos": profile.photos,
        "cameras": [{key: text for key, text in of.items() if text is not None} for of in cameras],
        "model": asdict(profile.model.settings),
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
    except FileNotFoundError:
        raise
    except _UNREADABLE as error:
        raise InvalidInputError(f"{name} is no lens profile, or a damaged one; give another file") from error
    try:
        entries = document["samples"]
        fits = stack.ndim == 3 and len(entries) == len(stack) and _within_limits(*stack.shape[:2])
        if not fits or stack.dtype != np.float32:
            raise InvalidInputError(
                f"{name} holds {len(entries)} samples but kernels of shape {stack.shape}; "
                f"one is needed for each, of side {_MAX_SIDE} at most"
            )
        chosen = dict(document["model"])
        excluded = chosen.pop("excluded", ())  # photos that do not count, of earlier profiles
        samples = unpack_samples(PackedSamples(entries, stack, encoded))
        model = LensModel.fit([s for s in samples if s.photo not in excluded], ModelSettings(**chosen))
        cameras = (_texts(camera) for camera in document.get("cameras", []))
        return LensProfile(
            model,
            _texts(document["lens"]),
            _texts(document["photos"]),
            tuple(Camera(known.get("maker"), known.get("model"), known.get("serial")) for known in cameras),
        )
    except LensModelError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise InvalidInputError(f"{name} is damaged: {error}") from error


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


def entry_of(sample: PsfSample) -> dict[str, Any]:
    """Return the named fields of a sample: all of it but the kernel and the encoded patch."""
    settings = asdict(sample.settings)
    if settings["focus_m"] is not None and math.isinf(settings["focus_m"]):
        settings["focus_m"] = _INFINITY
    return {
        "size": sample.kernel.shape[0],
        "r": sample.position.r,
        "phi": sample.position.phi,
        "settings": settings,
        "weight": sample.weight,
        "photo": sample.photo,
        "pixel_pitch_um": sample.pixel_pitch_um,
        "half_diagonal_px": sample.half_diagonal_px,
        "estimator": sample.estimator,
        "error": sample.error,
    }


def sample_of(
    entry: Mapping[str, Any], kernel: NDArray[np.float32], encoded: EncodedPatch | None
) -> PsfSample:
    """Build the sample of which `entry_of` returned the fields."""
    settings = dict(entry["settings"])
    if settings.get("focus_m") == _INFINITY:
        settings["focus_m"] = math.inf
    return PsfSample(
        kernel=np.asarray(kernel, dtype=np.float64),
        position=FieldPosition(float(entry["r"]), float(entry["phi"])),
        settings=LensSettings(**settings),
        weight=float(entry["weight"]),
        photo=str(entry["photo"]),
        pixel_pitch_um=entry["pixel_pitch_um"],
        estimator=str(entry["estimator"]),
        encoded=encoded,
        error=entry["error"],
        half_diagonal_px=entry["half_diagonal_px"],
    )
