"""The portable lens profile: a zip of JSON and npy that opens anywhere and gives the same PSFs.

Layout of a `.lensprofile`, format 2::

    profile.json    format, lens, cameras, settings of the model, one entry for each sample
    kernels.npy     (n, k, k) float32, sum 1, centred, in the order of the entries
    encoded.npy     (m, bytes) uint8: what patches say without a kernel, see `EncodedPatch`

The model is built from them when the file is opened. Nothing in it can run code: no pickle,
sizes bounded before arrays are made.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError, LensModelError
from lensmodel.core.files import atomic
from lensmodel.model.answer import ModelSettings
from lensmodel.model.lens_model import LensModel
from lensmodel.model.samples import PackedSamples, pack_samples, unpack_samples

FORMAT = 2  # raised when samples of before mean nothing to the model any more
_MAX_BYTES = 1 << 30  # unpacked: against files made to fill the memory
_MAX_SAMPLES = 200_000  # some 700 photos of 96 patches in three colours (chosen: memory)
_MAX_SIDE = 255  # pixels: several times the widest kernels; larger files would fill the memory (chosen)
_KERNELS, _ENCODED = "kernels.npy", "encoded.npy"

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
    # texts: maker, model, serial, label; whatever is known
    lens: dict[str, str] = field(default_factory=dict)
    # file name of each photo by the id that samples carry
    photos: dict[str, str] = field(default_factory=dict)
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
        "cameras": [
            {key: text for key, text in asdict(camera).items() if text is not None}
            for camera in profile.cameras
        ],
        "model": asdict(profile.model.settings),
        "samples": packed.entries,
    }
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("profile.json", json.dumps(document, allow_nan=False))
        archive.writestr(_KERNELS, _saved(packed.kernels))
        archive.writestr(_ENCODED, _saved(packed.encoded))
        if _unpacked(archive) > _MAX_BYTES:
            raise InvalidInputError(f"a profile holds {_MAX_BYTES >> 20} MiB at most; save fewer samples")


def _saved(array: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


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
            if document["format"] == FORMAT:
                stack, encoded = (
                    np.asarray(np.load(io.BytesIO(archive.read(part)), allow_pickle=False))
                    for part in (_KERNELS, _ENCODED)
                )
    except FileNotFoundError:
        raise
    except _UNREADABLE as error:
        raise InvalidInputError(
            f"{name} is no lens profile; choose one whose name ends in .lensprofile"
        ) from error
    try:
        if document["format"] != FORMAT:
            raise InvalidInputError(
                f"{name} has profile format {document['format']}, this program reads {FORMAT}: its samples "
                "are not those of this program; calibrate again with the photos of the lens"
            )
        entries = document["samples"]
        fits = stack.ndim == 3 and len(entries) == len(stack) and _within_limits(*stack.shape[:2])
        if not fits or stack.dtype != np.float32:
            raise InvalidInputError(
                f"{name} holds {len(entries)} samples but kernels of shape {stack.shape}; "
                f"one is needed for each, of side {_MAX_SIDE} at most"
            )
        samples = unpack_samples(PackedSamples(entries, stack, encoded))
        model = LensModel.fit(samples, ModelSettings(**document["model"]))
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
