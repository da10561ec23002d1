"""The file that keeps a lens, and the form in which samples cross the service, to its tasks and tables.

A profile is a zip of JSON and npy that opens anywhere and gives the same PSFs. Layout, format 2::

    profile.json    format, lens, cameras, settings of the model, one entry for each sample
    kernels.npy     (n, k, k) float32, sum 1, centred, in the order of the entries
    encoded.npy     (m, bytes) uint8: what patches say without a kernel, see `EncodedPatch`

Nothing in it can run code: no pickle, sizes bounded before arrays are made.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError, LensModelError
from lensmodel.core.psf import EncodedPatch, PsfSample
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model.identity import Camera
from lensmodel.model.lens_model import LensModel

_FORMAT: Final = 2  # raised when samples of before mean nothing to the model any more
_MAX_BYTES: Final = 1 << 30  # unpacked: against files made to fill the memory
_MAX_SAMPLES: Final = 200_000  # some 700 photos of 96 patches in three colours (chosen: memory)
_MAX_SIDE: Final = 255  # pixels (chosen): several times the widest kernels; more would fill the memory
_MAX_NAME: Final = 200  # characters of a text
_KERNELS, _ENCODED = "kernels.npy", "encoded.npy"
_INFINITY: Final = "infinity"  # a focus distance for which JSON has no number


@dataclass(frozen=True, slots=True, eq=False)
class LensProfile:
    """What is kept of a lens; `lensmodel.lens.Lens` answers questions from it."""

    model: LensModel  # the function behind the answers
    names: Mapping[str, str] = field(default_factory=dict)  # what is known of maker, model, serial and label
    photos: Mapping[str, str] = field(default_factory=dict)  # file names by the id that samples carry
    cameras: tuple[Camera, ...] = ()  # what the photos were taken with, each once; empty where none says


def write_profile(file: IO[bytes], lens: LensProfile) -> None:
    """Write a lens to an open file."""
    samples = lens.model.samples
    count, side = len(samples), max(sample.kernel.shape[0] for sample in samples)
    if not _within_limits(count, side):
        raise InvalidInputError(
            f"a profile holds {_MAX_SAMPLES} samples of side {_MAX_SIDE}, not {count} of side {side}"
        )
    packed = pack_samples(samples)
    document = {
        "format": _FORMAT,
        "units": {"r": "half-diagonal", "phi": "radian, counter-clockwise from the right", "kernel": "pixel"},
        "lens": dict(lens.names),
        "photos": dict(lens.photos),
        "cameras": [{k: text for k, text in asdict(of).items() if text} for of in lens.cameras],
        "model": {"mode": lens.model.mode},
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


def read_profile(source: Path | str | IO[bytes], name: str) -> LensProfile:
    """Open a profile by its path or as an open file; errors call it `name`."""
    try:
        with zipfile.ZipFile(source) as archive:
            return _read(archive, name)
    except (FileNotFoundError, LensModelError):
        raise
    except Exception as error:  # zipfile, json and NumPy fail in a dozen ways on files made to do harm
        raise InvalidInputError(f"{name} is no lens profile, or a damaged one; give another file") from error


def _read(archive: zipfile.ZipFile, name: str) -> LensProfile:
    if _unpacked(archive) > _MAX_BYTES:
        raise InvalidInputError(f"{name} unpacks to more than {_MAX_BYTES >> 20} MiB; it is no lens profile")
    document = json.loads(archive.read("profile.json"))
    if document["format"] != _FORMAT:
        raise InvalidInputError(
            f"{name} has profile format {document['format']}, this program reads {_FORMAT}: its "
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
    excluded = document["model"].get("excluded", ())  # photos that earlier profiles leave out
    samples = [s for s in unpack_samples(PackedSamples(entries, stack, encoded)) if s.photo not in excluded]
    model = LensModel.fit(samples, document["model"].get("mode", "default"))
    cameras = tuple(Camera(**_texts(camera)) for camera in document.get("cameras", []))
    return LensProfile(model, _texts(document["lens"]), _texts(document["photos"]), cameras)


def _texts(values: dict[str, Any]) -> dict[str, str]:
    return {str(key)[:_MAX_NAME]: str(value)[:_MAX_NAME] for key, value in values.items()}


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
    # bounded: one long name would lengthen those of all samples in an array of them
    named |= {name: str(named[name])[:_MAX_NAME] for name in ("photo", "estimator")}
    values = np.asarray(kernel, dtype=np.float64)
    return PsfSample(values, place, LensSettings(**settings), encoded=encoded, **named)
